"""What a report shows of logs after they are gone: some of their rows, what was repaired, and forecasts beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from koopmpc.base.values import Value
from koopmpc.data.episodes import Episodes
from koopmpc.validate.bands import Forecast
from koopmpc.validate.logs.log import Place

MOST = 4000  # rows that are kept for a picture


@dataclass(frozen=True, eq=False)
class LogExcerpt(Value):
    """Rows of logs for a picture, one log after the other, and marks where they were repaired.

    Attributes
    ----------
    time
        (n,) time of each row on an axis on which the logs follow one another [s].
    values
        (n, nx + nu + nw) states, inputs and measured disturbances; a row of NaN stands between two logs.
    starts
        (E,) where each log begins on that axis [s].
    left_out, doubtful
        (m, 2) spans of rows that no model learned from, and of rows that a check suspects and that were kept [s].
    replaced
        (r, 4) measurements that were replaced: time, column of `values`, what was measured, what stands there now.
    names
        Names of the columns.
    nx, nu
        Number of states and inputs among them.
    """

    time: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n c"]
    starts: Float[np.ndarray, " E"]
    left_out: Float[np.ndarray, "a 2"]
    doubtful: Float[np.ndarray, "b 2"]
    replaced: Float[np.ndarray, "r 4"]
    names: tuple[str, ...]
    nx: int
    nu: int


@dataclass(frozen=True, eq=False)
class LogSummary(Value):
    """The logs of a design, what was done to them, and the chosen model's forecasts of rows that it did not learn.

    Attributes
    ----------
    excerpt
        Rows for pictures.
    about
        Sizes, sample time, names and ranges, in lines.
    notes
        How the logs were read and repaired, in sentences.
    verdict, findings
        The verdict on the model, or why there is none; and what speaks against it, in sentences.
    forecasts
        Forecasts of held-out rows, with a band.
    error, plain
        (horizon, nx) root-mean-square errors of the model and of x⁺ = A x + B u + c; without rows where not judged.
    title
        The chosen controller in words.
    advice
        What limits the closed loop, and which data would help, in sentences.
    choice
        The leaderboard in lines.
    goal
        The goal file.
    certified
        What came of the certificate, in a sentence; empty where none was asked for.
    """

    _FORMER: ClassVar[Mapping[str, str]] = {"plan": ""}

    excerpt: LogExcerpt
    about: str
    notes: tuple[str, ...]
    verdict: str
    findings: tuple[str, ...]
    forecasts: tuple[Forecast, ...]
    error: Float[np.ndarray, "h nx"]
    plain: Float[np.ndarray, "h nx"]
    title: str
    advice: tuple[str, ...]
    choice: str
    goal: str
    certified: str = ""


def excerpt_logs(
    raw: Episodes,
    pieces: Episodes | None = None,
    origins: Sequence[Place] = (),
    doubtful: Sequence[Place] = (),
    unwrapped: Sequence[str] = (),
) -> LogExcerpt:
    """Return the rows of logs for a picture, with marks where what a model learned from differs from them.

    Parameters
    ----------
    raw
        The logs as they were read.
    pieces
        What a model learned from, some states may be left out; None if nothing is known of it.
    origins
        Place in `raw` of each piece.
    doubtful
        Places that a check suspects.
    unwrapped
        States that were unwrapped, whose values differ without a fault.
    """
    names = (*raw.states, *raw.inputs, *raw.disturbances)
    apart = -(-sum(len(episode) + 1 for episode in raw) // MOST)
    times: list[Float[np.ndarray, " k"]] = []
    rows: list[Float[np.ndarray, "k c"]] = []
    spans: list[tuple[float, float]] = []
    doubts: list[tuple[float, float]] = []
    replaced: list[tuple[float, float, float, float]] = []
    starts: list[float] = []
    begin, half = 0.0, 0.5 * raw.dt
    for e, episode in enumerate(raw):
        t = begin + raw.dt * np.arange(len(episode) + 1)
        starts.append(begin)
        driven = np.hstack([episode.U, episode.W])
        table = np.hstack([episode.X, np.vstack([driven, driven[-1:]])])
        kept = np.full(len(t), pieces is None)
        drawn = np.arange(len(t)) % apart == 0
        for place, piece in zip(origins, pieces or (), strict=False):
            if place.episode != e or pieces is None:
                continue
            kept[place.first : place.first + len(piece) + 1] = True
            for i, name in enumerate(pieces.states):
                column = raw.states.index(name)
                was = episode.X[place.first : place.first + len(piece) + 1, column]
                for k in np.flatnonzero(was != piece.X[:, i]) if name not in unwrapped else ():
                    row = place.first + int(k)
                    drawn[row] = True
                    replaced.append((float(t[row]), float(column), float(was[k]), float(piece.X[k, i])))
        out = np.flatnonzero(np.diff(np.concatenate([[True], kept, [True]])))
        spans += [(float(t[a]) - half, float(t[b - 1]) + half) for a, b in zip(out[::2], out[1::2], strict=True)]
        doubts += [(float(t[p.first]) - half, float(t[p.last - 1]) + half) for p in doubtful if p.episode == e]
        drawn |= ~kept & (np.arange(len(t)) % max(apart // 4, 1) == 0)
        times += [t[drawn], t[-1:] + half]
        rows += [table[drawn], np.full((1, table.shape[1]), np.nan)]
        begin = float(t[-1]) + raw.dt

    def stack(values: Sequence[tuple[float, ...]], width: int) -> Float[np.ndarray, "m w"]:
        return np.array(values, dtype=np.float64).reshape(-1, width)

    return LogExcerpt(
        time=np.concatenate(times),
        values=np.concatenate(rows),
        starts=np.array(starts),
        left_out=stack(spans, 2),
        doubtful=stack(doubts, 2),
        replaced=stack(sorted(set(replaced)), 4),
        names=names,
        nx=raw.nx,
        nu=raw.nu,
    )
