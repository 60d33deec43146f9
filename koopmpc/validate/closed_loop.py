"""Feedback in logs of closed loops: four tests for four questions.

- `feedback_share`: how much of u_k is a function of ψ(x_k), so that A and B cannot be separated? Also that of an input
  which is held until the states have followed it.
- `measure_feedback`: what do readings tell of u_k beyond past inputs, so that their noise comes back by the input?
- `find_feedback`: is the law near enough to exact to be a fault of the log? Both at once.
- `is_fed_back`: does u_{k+1} hold y_{k+1}, if input columns may be a row late? Past outputs and moves only, on unseen
  rows, by least absolute deviations, so that moves of a set point do not hide it.

`logs.timing` asks a fifth: whether an input acts within its own row, which feedback hides.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.base.text import to_percent
from koopmpc.data.delay import Delay, name_past
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.lifting.base import Lifting, strip_unit
from koopmpc.models.innovations import explain_by_readings
from koopmpc.models.moments.moments import Moments, both_sides
from koopmpc.models.moments.solve import column_norms, orthonormal_basis, project_onto
from koopmpc.models.records.narx import FOLDS
from koopmpc.validate.logs.log import Log, LogFault, fit_residuals
from koopmpc.validate.residuals import compute_moments
from koopmpc.validate.scoring import AnyPredictor


@dataclass(frozen=True)
class _Limits:
    """Limits beyond which an input counts as a feedback."""

    most_rows: int = 20_000  # rows on which outputs and past inputs are compared
    exact: float = 1e-9  # share of an input's energy below which its past determines it
    least_rows: int = 200  # a law is looked for only if the log has at least this many rows
    past: int = 10  # number of past inputs that may predict the next one
    feedback: float = 0.8  # an input is feedback if the state of the same row explains more than this share of it, and
    innovation: float = 0.02  # explains more than this share of the part that past inputs do not predict, and
    unpredicted: float = 1e-4  # past inputs leave more than this share of the input unpredicted
    predicted: float = 0.95  # inputs are fed back if outputs lower the error of their prediction below this share
    static: float = 0.1  # inputs are fed back if outputs of the same row leave less than this share of their moves open
    behind: int = 6  # rows of the past in the test for a late column
    passes: int = 6  # weighted least squares fits for least absolute deviations


_LIMITS = _Limits()


def feedback_share(
    episodes: Episodes | Source, lifting: Lifting | AnyPredictor, *, embedding: Delay | None = None
) -> Float[np.ndarray, " nu"]:
    """Return for each input the share R², 0 … 1, of its energy that a linear function of ψ(x) explains.

    At 1 the input was a feedback u = K ψ(x), and the data cannot separate A from B. If ψ contains a Constant, the
    energy is that around the mean; if ψ contains past inputs, only what they leave open counts, for a smooth input is
    no feedback. An input of few frequencies is near 1 in open loop too unless ψ contains two of its past rows for each
    of them: it excites too little to separate A from B, see `persistency`.

    Parameters
    ----------
    episodes
        Episodes with inputs, or a source of them; measured disturbances count as further inputs after u.
    lifting
        ψ; or a predictor, for its lifting and embedding.
    embedding
        The delay embedding that a lifting ψ acts on.

    Raises
    ------
    ShapeError, DataError
        The episodes and the predictor differ in states, inputs, disturbances or dt.
    """
    return explain_inputs(compute_moments(episodes, lifting, embedding=embedding))


def explain_inputs(total: Moments) -> Float[np.ndarray, " nu"]:
    """Return the result of `feedback_share` from moments, in the order of their inputs."""
    P, _, cut = both_sides(total)
    nz, nu = total.nz, len(total.inputs)
    names, constant = total.lifting.names, total.lifting.constant_index
    always = [] if constant is None else [constant]
    past = _name_past_inputs(total)
    known = [*always, *(i for i, name in enumerate(names) if name in past)]
    U = P[:, nz : nz + nu]
    moves = _residual_norms(U, P[:, always], cut) > cut * column_norms(U)
    variation = _residual_norms(U, P[:, known], cut)
    unexplained = _residual_norms(U, P[:, :nz], cut)
    varies = variation > cut * column_norms(U)
    rest = np.divide(unexplained**2, variation**2, out=1.0 * moves, where=varies)
    return 1.0 - rest


def explain_beyond_past(episodes: Episodes, predictor: AnyPredictor) -> Float[np.ndarray, " nu"]:
    """Return for each input the share R² that ψ explains of what its two rows before, and those of others, leave open.

    A slow input is not feedback: outputs that answer to it tell no more of the next row than its own past does. At 1
    where the past leaves less than a billionth, as a wave and an exact law do.
    """
    before, psi, u = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for episode in predictor.embed(episodes):
        U = episode.U[: _LIMITS.most_rows]
        before.append(np.hstack([U[1:-1], U[:-2], np.ones((max(len(U) - 2, 0), 1))]))
        psi.append(predictor.lifting(episode.X[2 : len(U)]))
        u.append(U[2:])
        if sum(map(len, u)) >= _LIMITS.most_rows:
            break
    past, targets = np.concatenate(before), np.concatenate(u)
    left = column_norms(targets - project_onto(past, targets))
    both = np.hstack([past, np.concatenate(psi)])
    rest = column_norms(targets - project_onto(both, targets))
    varies = left > np.sqrt(_LIMITS.exact) * column_norms(targets - targets.mean(axis=0))
    return np.where(varies, 1.0 - (rest / np.where(varies, left, 1.0)) ** 2, 1.0)


def _name_past_inputs(total: Moments) -> set[str]:
    """Return the names that past inputs have among the entries of ζ."""
    past = total.embedding
    if past is None or not past.inputs:
        return set()
    return {name_past(name, i) for i in range(1, past.steps + 1) for name in total.inputs}


def _residual_norms(
    U: Float[np.ndarray, "m nu"], columns: Float[np.ndarray, "m n"], cut: float
) -> Float[np.ndarray, " nu"]:
    """Return the norm of each column of U after projection onto the complement of the span of `columns`."""
    if columns.shape[1] == 0:
        return column_norms(U)
    basis = orthonormal_basis(columns, cut)
    return column_norms(U - basis @ (basis.T @ U))


def measure_feedback(episodes: Episodes) -> Float[np.ndarray, " nu"]:
    """Return the share of each input that readings explain, beyond what past inputs do: it is fed back.

    States also explain an input of an open loop that is held for some rows, for they followed it; its next move they do
    not know. 0 where there are too few rows to tell.
    """
    _, alone, both = explain_by_readings(episodes)
    return 1 - np.divide(both, alone, out=np.ones(len(alone)), where=alone > 0) ** 2


def find_feedback(log: Log) -> Iterator[LogFault]:
    """Find inputs u_k that follow from the state x_k of the same row.

    If the plant is much faster than the changes of the input, the state predicts a freely chosen input too. A feedback
    u = K x shows two further signs. x_k explains more of u_k than of u_{k−1}, which has already acted on the plant. And
    x_k explains a part of u_k that earlier inputs do not predict.
    """
    long, nu = [e for e in log.data if len(e) > 2 * _LIMITS.past], log.data.nu
    if not long or not nu:
        return
    now = np.concatenate([e.U[_LIMITS.past + 1 :] for e in long])
    past = np.concatenate([stack_past_inputs(e.U, _LIMITS.past, len(e), _LIMITS.past + 1)[:, nu:] for e in long])
    state = np.concatenate([e.X[_LIMITS.past + 1 : -1] for e in long])
    if len(now) < max(_LIMITS.least_rows, 4 * (past.shape[1] + state.shape[1])):
        return
    V = (now - log.input_center) / log.input_size
    history = (past - np.tile(log.input_center, _LIMITS.past)) / np.tile(log.input_size, _LIMITS.past)
    ones, Z = np.ones((len(V), 1)), (state - log.center) / log.size
    by_past = (fit_residuals(np.hstack([ones, history]), V) ** 2).mean(axis=0)
    by_both = (fit_residuals(np.hstack([ones, history, Z]), V) ** 2).mean(axis=0)
    targets = np.hstack([V, history[:, :nu]])  # u_k and u_{k−1}
    by_state, previous = np.split((fit_residuals(np.hstack([ones, Z]), targets) ** 2).mean(axis=0), 2)
    variance = np.maximum((V**2).mean(axis=0) - V.mean(axis=0) ** 2, 1e-300)
    for j in np.flatnonzero(variance > 1e-12):
        innovation = 1 - by_both[j] / max(by_past[j], 1e-300)
        exact = by_state[j] < 1e-8 * variance[j]
        explained = by_state[j] < (1 - _LIMITS.feedback) * variance[j] and by_state[j] < previous[j]
        if exact or (explained and innovation > _LIMITS.innovation and by_past[j] > _LIMITS.unpredicted * variance[j]):
            name = strip_unit(log.data.inputs[j])
            yield LogFault(
                "feedback",
                f"the states explain {to_percent(1 - by_state[j] / variance[j])} of {name}: it was a feedback, so the "
                "data cannot separate A from B",
                f"add noise to {name} while logging: km.Feedback(K, km.Noise(…))",
                (log.data.inputs[j],),
            )


def stack_past_inputs(U: np.ndarray, first: int, last: int, count: int) -> np.ndarray:
    """Return rows [u_k, u_{k−1}, …, u_{k−count+1}] for k = first + 1 … last − 1."""
    k = np.arange(first + 1, last)
    return np.hstack([U[k - lag] for lag in range(count)])


def is_fed_back(episodes: Episodes) -> bool:
    """Return whether an input may be a feedback of the outputs, so that nothing tells when it acts.

    Either past outputs predict u_{k+1} better than its own past does, on unseen rows; or most of its moves are a
    function of the outputs in the same rows. Both use least absolute deviations, so that a few moves of a set point do
    not hide it. Under feedback u_{k+1} holds y_{k+1}, and a model with the inputs moved up would seem to know y_{k+1}.
    """
    long = [e for e in episodes if len(e) > 4 * _LIMITS.behind]
    if not long:
        return True  # too short to tell
    past = np.concatenate(
        [np.hstack([e.U[_LIMITS.behind - i : len(e) - i] for i in range(1, _LIMITS.behind + 1)]) for e in long]
    )
    outputs = np.concatenate(
        [np.hstack([e.X[_LIMITS.behind - i : len(e) - i] for i in range(1, _LIMITS.behind + 1)]) for e in long]
    )
    now = np.concatenate([e.U[_LIMITS.behind :] for e in long])
    move = np.concatenate([np.diff(e.U, axis=0) for e in long])
    same = np.concatenate([np.hstack([np.diff(e.X[:-1], axis=0), e.X[1:-1]]) for e in long])
    for target, step in zip(now.T, move.T, strict=True):
        own, both = _miss(past, target), _miss(np.hstack([past, outputs]), target)
        cap = 5 * float(np.median(own))
        if np.minimum(both, cap).mean() < _LIMITS.predicted * np.minimum(own, cap).mean():
            return True
        moving = step != 0
        if moving.any() and np.median(_miss(same[moving], step[moving])) < _LIMITS.static * np.median(
            np.abs(step[moving])
        ):
            return True
    return False


def _miss(P: Float[np.ndarray, "M n"], target: Float[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """Return |t − [1, P] k| on each quarter of the rows, k by least absolute deviations over the others."""
    A = np.hstack([np.ones((len(P), 1)), P])
    fold, missed = np.arange(len(A)) * FOLDS // len(A), np.empty(len(A))
    for out in range(FOLDS):
        rows = fold != out
        weight = np.ones(int(rows.sum()))
        k = np.zeros(A.shape[1])
        for _ in range(_LIMITS.passes):  # least squares with weights 1 / |residual|
            k = np.linalg.lstsq(A[rows] * weight[:, None], target[rows] * weight, rcond=None)[0]
            gap = np.abs(target[rows] - A[rows] @ k)
            weight = 1 / np.sqrt(np.maximum(gap, max(float(np.median(gap)), 1e-12)))
        missed[~rows] = np.abs(target[~rows] - A[~rows] @ k)
    return missed
