"""Which limits a Gauss–Newton step to an equilibrium holds: those that it breaks come, those that pull it back go."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.ask.limits import Interval

RANK = 1e-12  # singular values below this share of the largest are rounding; ipopt meets all others too
BENT = 0.25  # a step is shorter where the cost bends by more than this share beyond its Gauss–Newton part
LEAST = 0.05  # shortest length of such a step, 1 being the longest


class GaussNewtonStep(NamedTuple):
    """A Gauss–Newton step on s = (x, u) by sizes: `back` to the conditions E s = …, `along` them to the row.

    The conditions are those of an equilibrium and of the limits `held`. `values` are [u; g] by sizes, `limited` their
    slopes, `gain` is the pseudo-inverse of E, and W s + … the residuals, which are `left` before the step.
    """

    back: Float[np.ndarray, " n"]
    along: Float[np.ndarray, " n"]
    E: Float[np.ndarray, "m n"]
    missed: Float[np.ndarray, " m"]
    gain: Float[np.ndarray, "n m"]
    free: int  # directions in which an equilibrium may move
    held: Int[np.ndarray, " nh"]
    values: Float[np.ndarray, " nl"]
    limited: Float[np.ndarray, "nl n"]
    W: Float[np.ndarray, "nw n"]
    left: Float[np.ndarray, " nw"]

    def multipliers(self, step: Float[np.ndarray, " n"], active: Int[np.ndarray, " nl"]) -> Float[np.ndarray, " nh"]:
        """Return the multipliers of the limits held, positive where a limit holds the row back."""
        pull = self.gain.T @ (self.W.T @ (self.left - self.W @ step))
        return active[self.held] * pull[len(self.E) - len(self.held) :]


def exchange_limits(
    step: GaussNewtonStep,
    whole: Float[np.ndarray, " n"],
    active: Int[np.ndarray, " nl"],
    limits: Interval,
    *,
    careful: bool,
) -> tuple[Int[np.ndarray, " nl"], float] | None:
    """Return the limits active after a step, and the share of it to take; None where a corner has no way out.

    At a corner nothing is free to move. For the new limit another one gives way: the one whose multiplier would
    change its sign first.
    """
    multipliers, after = step.multipliers(whole, active), active.copy()
    if len(multipliers) and multipliers.min() < -1e-9 * np.abs(multipliers).max():
        after[step.held[multipliers.argmin()]] = 0
        return after, 1.0
    hit, share = _find_hit(step.values, step.limited @ whole, limits, active, careful=careful)
    if not hit:
        return after, 1.0
    if careful and not step.free:
        toward = step.gain.T @ (np.sign(hit) * step.limited[abs(hit) - 1])
        push = active[step.held] * toward[len(toward) - len(step.held) :]
        if not (push > RANK).any():
            return None
        shares = np.maximum(multipliers, 0.0) / np.where(push > RANK, push, np.nan)
        after[step.held[np.nanargmin(shares)]] = 0
    after[abs(hit) - 1] = np.sign(hit)
    return after, share


def invert(E: Float[np.ndarray, "m n"]) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n k"]]:
    """Return the pseudo-inverse of E, and a basis of its null space."""
    left, sigma, right = np.linalg.svd(E)
    rank = int((sigma > RANK * max(float(sigma[0]), 1e-300)).sum())
    return right[:rank].T @ (left[:, :rank].T / sigma[:rank, None]), right[rank:].T


def find_length(last: tuple[np.ndarray, np.ndarray] | None, now: Float[np.ndarray, " n"]) -> float:
    """Return the length of a Gauss–Newton step: below 1 where the cost bent more than it knows along the last one.

    `last` are the step that was taken and the whole one. From that to `now` it has changed by as much as its slope
    along the one that was taken tells.

    References
    ----------
    Barzilai & Borwein, "Two-point step size gradient methods", IMA J. Numer. Anal. 8, 1988.
    """
    if last is None:
        return 1.0
    taken, whole = last
    bend, size = float(taken @ (whole - now)), float(taken @ taken)
    return max(size / bend, LEAST) if bend > (1 + BENT) * size else 1.0


def _find_hit(
    values: Float[np.ndarray, " nl"],
    moved: Float[np.ndarray, " nl"],
    limits: Interval,
    active: Int[np.ndarray, " nl"],
    *,
    careful: bool,
) -> tuple[int, float]:
    """Return the limit that a step breaks first, i + 1 if it is an upper one, else −i − 1, and the share up to it.

    (0, 1) where it breaks none. If not `careful`, or where values are outside already, the one that is broken most, and
    the whole step.
    """
    low, high = limits
    over, under, rounding = values + moved - high, low - values - moved, 1e-9 * (1 + np.abs(values))
    past = np.where(active == 0, np.maximum(over, under) - rounding, -np.inf)
    broken = np.flatnonzero(past > 0)
    if not len(broken):
        return 0, 1.0
    ends = np.where(over[broken] > under[broken], high[broken], low[broken])
    room = np.where(over[broken] > under[broken], ends - values[broken], values[broken] - ends)
    if not careful or (room < -rounding[broken]).any():
        i, share = int(broken[past[broken].argmax()]), 1.0
    else:
        shares = np.maximum(room, 0.0) / np.abs(moved[broken])
        i, share = int(broken[shares.argmin()]), float(shares.min())
    return (i + 1 if over[i] > under[i] else -i - 1), share
