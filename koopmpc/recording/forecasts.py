"""Forecasts and errors as series over the time ahead."""
# pyright: basic

from typing import Any

import numpy as np

from koopmpc.predict.forecast import Forecast
from koopmpc.predict.score import Score
from koopmpc.recording.glyphs import drawable
from koopmpc.recording.scene import Color
from koopmpc.recording.styles import PALETTE

_TRUTH: Color = (225, 228, 232)
_PREDICTED = PALETTE[0]
_BAND: Color = (70, 125, 185)


class Series:
    """One entity: rows of several curves at steps of dt, with names, colours and widths."""

    def __init__(
        self, values: np.ndarray, first: int, dt: float, curves: list[tuple[str, Color, float]]
    ) -> None:
        self.values, self.first, self.dt, self.curves = values, first, dt, curves

    def send(self, rec: Any, entity: str, *, steps: bool = False) -> None:
        """Write the style and the columns."""
        import rerun as rr

        names, colors, widths = (list(part) for part in zip(*self.curves, strict=True))
        more: dict[str, Any] = {"interpolation_mode": "StepAfter"} if steps else {}
        drawn = [drawable(name) for name in names]
        rec.log(entity, rr.SeriesLines(names=drawn, colors=colors, widths=widths, **more), static=True)
        k = self.first + np.arange(len(self.values))
        nanoseconds = np.rint(k * self.dt * 1e9).astype("timedelta64[ns]")
        columns = rr.Scalars.columns(scalars=self.values.ravel()).partition([len(names)] * len(k))
        rec.send_columns(
            entity,
            [rr.TimeColumn("step", sequence=k), rr.TimeColumn("sim_time", duration=nanoseconds)],
            columns,
        )


def forecast_series(ahead: Forecast, i: int) -> Series:
    """Return truth, prediction and, where it is finite, the band of the i-th state."""
    curves = [("truth", _TRUTH, 2.0), ("prediction", _PREDICTED, 2.0)]
    columns = [ahead.truth[:, i], ahead.predicted[:, i]]
    known = np.isfinite(ahead.predicted[:, i])
    if ahead.band and np.isfinite(ahead.low[known, i]).all() and np.isfinite(ahead.high[known, i]).all():
        curves += [(f"{ahead.band}, low", _BAND, 1.0), (f"{ahead.band}, high", _BAND, 1.0)]
        columns += [ahead.low[:, i], ahead.high[:, i]]
    return Series(np.column_stack(columns), 0, ahead.dt, curves)


def input_series(ahead: Forecast) -> Series:
    """Return the inputs of the forecast, each held for a step."""
    curves = [(name, PALETTE[(1 + j) % len(PALETTE)], 2.0) for j, name in enumerate(ahead.inputs)]
    return Series(ahead.U, 0, ahead.dt, curves)


def error_series(score: Score, i: int, dt: float) -> Series:
    """Return the root-mean-square error of the i-th state and the 5 and 95 % quantiles of its errors."""
    values = np.column_stack([score.rmse[:, i], score.low[:, i], score.high[:, i]])
    curves = [
        ("RMSE", _PREDICTED, 2.5),
        ("5 % of the errors", _BAND, 1.0),
        ("95 % of the errors", _BAND, 1.0),
    ]
    return Series(values, 1, dt, curves)
