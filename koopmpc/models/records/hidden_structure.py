"""The sizes of models with a hidden state, their errors on unseen rows, and whether their free runs stay near them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.base.values import Value
from koopmpc.data.episodes import Episodes
from koopmpc.models.base import FitReport
from koopmpc.models.records.conversion import SignalUnits, cut_segments
from koopmpc.models.records.free_run import HELD, spread_pieces
from koopmpc.models.records.hidden import (
    HiddenModel,
    join_segments,
    simulate_hidden,
    start_states,
)
from koopmpc.models.records.narx import choose_simplest
from koopmpc.models.records.structure import HORIZON, average_errors
from koopmpc.models.records.unseen import UNSEEN, average_gaps

RESTS = 10  # rows at the least or the largest reading, at least, that make it a rail
FAR = 10.0  # ranges of the data that a free run from other states may leave, at most
_STARTS = 8  # rows of each record at which it begins


@dataclass(frozen=True, eq=False)
class HiddenStructure(Value):
    """The sizes of a polynomial state-space model, and its errors on unseen rows."""

    # order of the hidden state, and total degree of the polynomials
    order: int
    degree: int
    # past rows from which the state begins, and steps of the segments that the fit forecasts; 0 where `subspace` is
    # taken as it is
    delays: int
    horizon: int
    # (2, ny) the least and the largest reading of each sensor; None where none saturates
    rails: Float[np.ndarray, "2 ny"] | None
    # (blocks,) errors in spreads of free runs and forecasts on the last quarter of each record
    errors: Float[np.ndarray, " blocks"]
    calm: bool  # it stays within three times the range of the data, in free run over each record twice
    parameters: int  # number of coefficients
    neurons: int = 0  # number of neurons in the dynamics
    start: int = 0  # which of the starts for neurons it was

    @property
    def error(self) -> float:
        """Geometric mean of the errors of the blocks."""
        return average_errors(self.errors)

    @property
    def is_nonlinear(self) -> bool:
        """Whether the state has products or neurons."""
        return self.degree > 1 or self.neurons > 0

    def describe(self) -> str:
        """Return a sentence on the model and its error."""
        kind = f"polynomials of degree {self.degree}" if self.degree > 1 else "linear dynamics"
        kind += f" and {self.neurons} neuron{'s' * (self.neurons != 1)}" if self.neurons else ""
        how = f"fitted to forecasts of {self.horizon} steps" if self.horizon else "by a subspace method"
        return (
            f"a hidden state of order {self.order} with {kind}, which begins with {self.delays} past rows, {how}; on "
            f"unseen rows, in free run and in forecasts, it errs by {self.error:.3g} spreads"
        )


def choose_hidden(found: Sequence[HiddenStructure]) -> HiddenStructure:
    """Return the structure of the fewest coefficients within one standard error of the best; a calm one if any is."""
    return choose_simplest([s for s in found if s.calm] or found, lambda s: (s.parameters, s.error))


def find_rails(episodes: Episodes) -> Float[np.ndarray, "2 ny"] | None:
    """Return the rails of sensors that rest at their least or largest reading; None where none does.

    A rail shows in at least ten rows, and at least a quarter of them follow each other.
    """
    rails = np.vstack([np.full(episodes.nx, -np.inf), np.full(episodes.nx, np.inf)])
    Y = np.concatenate([e.X for e in episodes])
    for i, column in enumerate(Y.T):
        for side, value in enumerate((column.min(), column.max())):
            at = column == value
            if at.sum() >= RESTS and (at[1:] & at[:-1]).sum() >= at.sum() / 4 and not at.all():
                rails[side, i] = value
    return rails if np.isfinite(rails).any() else None


def thin_records(episodes: Episodes, most: int, piece: int) -> Episodes:
    """Return the records; of more than `most` rows, evenly spread pieces of `piece` rows."""
    short = sum(map(len, episodes)) <= most
    return episodes if short else episodes.with_episodes(spread_pieces(episodes, most, piece))


def is_calm_hidden(
    model: HiddenModel, data: Episodes, units: SignalUnits, delays: int, *, anywhere: bool = False
) -> bool:
    """Return whether a model stays within three times the range of the data, run over each record twice.

    With `anywhere` it must also stay within ten ranges where inputs follow states that they did not follow in the data:
    each record runs once over with all its inputs, from eight of its rows.
    """
    X = (np.concatenate([e.X for e in data]) - units.mean[: units.ny]) / units.scale[: units.ny]
    reach, low, high = HELD * np.abs(X).max(axis=0), X.min(axis=0), X.max(axis=0)
    for e in data:
        if len(e) <= delays:
            continue
        part = join_segments(cut_segments(data.with_episodes([e]), units, delays, len(e) - delays, 1))
        out = simulate_hidden(model, part.points, np.concatenate([part.inputs, part.inputs]))
        if not (np.abs(out) < reach).all():
            return False
    for e in data if anywhere else ():
        if len(e) <= delays + _STARTS:
            continue
        points = join_segments(cut_segments(data.with_episodes([e]), units, delays, 1, (len(e) - delays) // _STARTS))
        inputs = units.apply(e)[1]
        out = simulate_hidden(model, points.points, np.repeat(inputs[:, None], len(points.points), axis=1))
        if not ((out > low - FAR * (high - low)) & (out < high + FAR * (high - low))).all():
            return False
    return True


def measure_hidden(
    model: HiddenModel, data: Episodes, units: SignalUnits, delays: int, ahead: int = HORIZON
) -> Float[np.ndarray, " blocks"]:
    """Return errors on four parts of the last quarters, in spreads: of free runs and forecasts, geometric means."""
    free: list[np.ndarray] = []
    short: list[np.ndarray] = []
    for e in data:
        one, spans = data.with_episodes([e]), [(round((1 - UNSEEN) * len(e)), len(e))]
        ((a, b),) = spans
        for horizon, gaps in ((b - max(a, delays), free), (ahead, short)):
            if b - max(a, delays) < max(horizon, 2):
                continue
            part = join_segments(cut_segments(one, units, delays, horizon, horizon, spans))
            out = simulate_hidden(model, part.points, part.inputs)
            if units.rails is not None:
                out = np.clip(out, *units.rails)
            gaps.append((out - part.outputs).transpose(1, 0, 2).reshape(-1, units.ny))
    return average_gaps(free, short)


def report_fit(structure: HiddenStructure, found: HiddenModel, units: SignalUnits, data: Episodes) -> FitReport:
    """Return the report of a fit."""
    part = join_segments(cut_segments(data, units, structure.delays, 1, 1))
    size = units.scale[: units.ny]
    gap = simulate_hidden(found, part.points, part.inputs)[0] - part.outputs[0]
    return FitReport(
        method="neural_state_space" if structure.neurons else "polynomial_state_space",
        route=f"simulation error over segments of {structure.horizon} steps",
        samples=part.points.shape[0],
        condition=float(np.linalg.cond(start_states(found, part.points))),
        rank=found.E.shape[1],
        columns=found.E.shape[1],
        ridge=0.0,
        residual=size * np.sqrt(np.mean(gap**2, axis=0)),
        state_residual=np.zeros(units.ny),
        changes=(structure.describe(),),
    )
