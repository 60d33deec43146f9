"""ReadingGate: a reading far from its prediction is not used; the prediction stands in for a few steps."""

from collections.abc import Callable
from functools import cache

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.checks import HUGE
from koopmpc.interrupts import raise_swallowed
from koopmpc.plants.graph import Graph
from koopmpc.plants.routines import bind_interpreter
from koopmpc.values import Viewing

# A reading is refused if an innovation exceeds this many times the running 0.9 quantile of its size. Of Gaussian
# innovations the bound is about ten standard deviations: where the running quantile rests it is above 1.64.
BEYOND = 5.0
BRIDGED = 5  # refused readings in sequence for which a prediction stands in; the next one is used, an absurd one
LONG = 10  # only after so many
FEW = 10  # the bound counts once so many innovations of a run have come; before,
ABSURD = 1e4  # a reading, or a prediction, is absurd if off by this many times all that its output has shown
RISE = 1.4  # an innovation above the running quantile multiplies it by this,
FALL = RISE ** (-1 / 9)  # and one below it by this: nine of ten are below where the quantile rests
WIDEN = 4.0  # while all readings are used, the quantile follows the last innovation by at most this factor a step,
NARROW = 0.7  # and downwards by this one
LEAST = 0.01  # the quantile counts as at least this share of the largest step that the output has made
ROUNDING = 1e-9  # and as this share of the reading's and the prediction's size: what is smaller is rounding
SUSPECTS = 2  # the first readings, and those after a reading that leaps, may be left behind so many times
LEAP = 10.0  # with `leaps`: a reading leaps if it and its misfit are beyond so many largest steps
LEAPS = 6  # the first readings before one that leaps may be left behind so many times
FADING = 0.8  # what a predicted step allows fades by this factor a step

_NO_W = np.zeros(0)


@cache
@raise_swallowed()
def gate_function(ny: int, leaps: bool = False) -> ca.Function:
    """Return (y, prediction, memory) → [whether y is refused; 1 if the gate has opened, 2 if all is lost; the memory].

    y is refused if |yᵢ − ŷᵢ| > 5 qᵢ + ρ Sᵢ for any of its entries. qᵢ is the running 0.9 quantile of |yᵢ − ŷᵢ|, and
    counts and goes on as at least 0.01 Sᵢ and 1e-9 of yᵢ and ŷᵢ, so that rounding decides nothing. Sᵢ is the largest
    step of this output that was used. ρ is the largest predicted step of all outputs, each in units of its S, and fades
    by 0.8 a step: in a transient a model may err by as much as the outputs move. After five refused readings in
    sequence the gate opens, and all readings are used until one is inside the bound. Before the tenth reading only one
    is refused that is off by 1e4 times all that its output has shown, |last| + max(q, S); the bound counts from there.
    Such a reading opens the gate after ten refused ones only. Without a prediction it is refused if it is so far from
    the last one that was used. Entries that are NaN are not judged.

    Among the first readings, and while the gate is open, a wild one may be used. Where a prediction is then off by more
    than 1e4 (S + |y|), and y itself is not absurd, the estimate is lost: the observer starts again from y. A plant that
    does not move, whatever is predicted, looks alike. After the first readings this is done once, if an output has
    moved or a wild reading was left behind, and again when an absurd reading was used. It is done wherever an output
    falls to a tenth of its last used value, but not to zero. Once wild readings were left behind, S is forgotten too.

    Several wild ones in a row hide each other so. While the gate is open, an output may fall to less than 1e-4 of its
    last used value, but not to zero. If its prediction is off by more than 1e4 times what it falls to, the readings
    before were wild: the observer starts again from y, and S is forgotten. This is done twice, and twice again after a
    reading off by 1e4 times all that its output had shown was used.

    With `leaps`, where a disturbance is learned or a filter reads all states, smaller ones are left behind too. While
    the gate is open, a reading leaps if |y − last| and |y − ŷ| are both beyond 10 times the largest step, used or
    predicted. An absurd one does not, nor the fifth or a later one before any step. The observer starts again from y,
    up to six times.

    The memory is q, S, the predicted steps, the last used values, a count, whether the observer has started again
    since, and how often it has left wild readings behind. Below a count of 10 the gate is open, and 10 less the count
    are the least number of readings until it may close; from 10 on the refused ones are added.
    """
    y, predicted, memory = (ca.SX.sym(name, n) for name, n in (("y", ny), ("predicted", ny), ("memory", 4 * ny + 3)))
    ends = [0, ny, 2 * ny, 3 * ny, 4 * ny, 4 * ny + 1, 4 * ny + 2, 4 * ny + 3]
    quantile, largest, ahead, last, count, restarted, left = ca.vertsplit(memory, ends)
    known, foreseen = ca.fabs(y) < HUGE, ca.fabs(predicted) < HUGE  # False for NaN
    came = ca.logic_and(known, foreseen)
    error = ca.if_else(came, ca.fabs(y - predicted), 0)
    ahead_new = ca.fmax(ca.if_else(ca.logic_and(came, count > 0), ca.fabs(predicted - last), 0), FADING * ahead)
    size = ca.fmax(largest, ahead_new)
    moving = ca.fmax(size, ca.if_else(came, ROUNDING * ca.fmin(ca.fabs(predicted), ca.fabs(last)), 0))
    share = ca.mmax(ahead_new / ca.if_else(moving > 0, moving, 1))
    least = ca.fmax(LEAST * largest, ca.if_else(came, ROUNDING * ca.fmin(ca.fabs(predicted), ca.fabs(y)), 0))
    wide = ca.fmax(quantile, least)
    inside = error <= BEYOND * wide + share * size
    judged, good, closed = ca.mmax(came), ca.mmin(inside), count >= FEW
    shown = ca.fmax(quantile, size) + ca.fabs(last)
    jump = ca.if_else(foreseen, error, ca.if_else(known, ca.fabs(y - last), 0))
    leapt = ca.mmax(ca.logic_and(shown > 0, jump > ABSURD * shown))
    far = ca.logic_and(leapt, count > 1)
    moved = ca.logic_or(largest > 0, left > 0)  # leaving wild readings behind forgets S
    dropped = ca.logic_and(ca.logic_and(known, y != 0), ca.fabs(last) > LEAP * (largest + ca.fabs(y)))
    may_restart = ca.logic_or(ca.logic_or(count <= 2, ca.mmax(dropped)), ca.logic_and(moved, ca.logic_not(restarted)))
    astray = ca.logic_and(error > ABSURD * (largest + ca.fabs(y)), may_restart)
    fell = ca.logic_and(ca.logic_and(known, y != 0), ca.fabs(last) > ABSURD * ca.fabs(y))
    missed = ca.if_else(foreseen, error > ABSURD * ca.fabs(y), 1)
    suspected, apart = ca.mmax(ca.logic_and(fell, missed)), ca.SX(0)
    if leaps:
        ahead_first = ca.if_else(came, ca.fabs(predicted - last), 0)
        rounded = ca.if_else(came, ROUNDING * ca.fmax(ca.fabs(last), ca.fmax(ca.fabs(predicted), ca.fabs(y))), 0)
        steps, way = ca.fmax(size, ahead_first), ca.if_else(came, ca.fmin(error, ca.fabs(y - last)), 0)
        leap = ca.logic_and(ca.logic_and(steps > rounded, way > LEAP * steps), ca.logic_or(largest > 0, count <= 2))
        apart = ca.logic_and(ca.mmax(leap), ca.logic_not(far))
        suspected = ca.logic_or(suspected, apart)
    back = ca.logic_and(suspected, ca.logic_and(left < (LEAPS if leaps else SUSPECTS), ca.logic_not(closed)))
    away = ca.mmax(ca.logic_and(known, ca.fabs(y - last) > ABSURD * shown))  # else the prediction is absurd, not y
    lost = ca.logic_or(ca.logic_and(ca.mmax(astray), ca.logic_not(ca.logic_and(far, away))), back)
    absurd = ca.logic_and(far, ca.logic_not(ca.logic_and(judged, closed)))
    wild = ca.logic_and(ca.logic_and(judged, closed), ca.logic_not(good))
    patient = count < FEW + ca.if_else(far, LONG, BRIDGED)
    refused = ca.logic_and(ca.logic_and(ca.logic_or(wild, absurd), patient), ca.logic_not(lost))
    opened = ca.logic_and(wild, ca.logic_not(refused))
    used = ca.if_else(refused, predicted, y)
    learned = ca.logic_and(came, ca.logic_not(refused))
    follows = ca.if_else(wide > 0, ca.fmin(ca.fmax(error, NARROW * wide), WIDEN * wide), error)
    tracks = wide * ca.if_else(error > wide, RISE, FALL)
    step = ca.if_else(ca.logic_and(ca.logic_and(learned, inside), count > 0), ca.fabs(y - last), 0)
    waited = ca.if_else(count < FEW - 1, count + 1, ca.if_else(good, FEW, FEW - 1))
    counted = ca.if_else(refused, ca.fmax(count, FEW) + 1, ca.if_else(opened, FEW - 1, ca.if_else(closed, FEW, waited)))
    after = ca.vertcat(
        ca.if_else(learned, ca.if_else(ca.logic_and(closed, good), tracks, follows), quantile),
        ca.fmax(largest, step),
        ahead_new,
        ca.if_else(ca.fabs(used) < HUGE, used, last),
        ca.if_else(ca.logic_or(judged, refused), counted, count),
        ca.logic_and(restarted, ca.logic_or(ca.logic_not(far), refused)),
        ca.if_else(ca.logic_and(leapt, ca.logic_not(refused)), 0, left),
    )
    none = ca.SX(ny, 1)
    first = ca.vertcat(none, ca.if_else(ca.logic_or(back, left > 0), none, largest), none, ca.if_else(known, y, last))
    anew = ca.vertcat(first, ca.fmin(count, 2 - apart) + 1, ca.logic_and(count > 2, ca.logic_not(back)), left + back)
    result = ca.vertcat(refused, ca.if_else(lost, 2, opened), ca.if_else(lost, anew, after))
    return ca.Function("gate", [y, predicted, memory], [ca.densify(result)], {"cse": True})


def gate_graph(ny: int, leaps: bool = False) -> Graph:
    """Return `gate_function` as data, for a Program."""
    return Graph.trace(gate_function(ny, leaps))


class ReadingGate(Viewing):
    """The gate of one closed loop; see `gate_function` for its rule, and `choose` for measured disturbances.

    Attributes
    ----------
    refused
        Whether the last reading was refused.
    opened
        Whether the last reading is used though it is beyond the bound, after refused ones.
    lost
        Whether the last prediction was absurd, so that the observer starts again from the reading.
    w
        The measured disturbance of the last prediction that was chosen; empty before.

    Parameters
    ----------
    ny
        Number of entries of a reading.
    leaps
        Whether a leap among the first readings starts the observer again, see `gate_function`.
    """

    _VIEWS = ("_y", "_predicted", "_after", "_evaluate", "_buffer")

    def __init__(self, ny: int, leaps: bool = False) -> None:
        self._ny, self._function = ny, gate_function(ny, leaps)
        self.w: Float[np.ndarray, " nw"] = _NO_W
        self._doubted = 0  # wild w in sequence
        self._memory = np.zeros(self._function.numel_in(2))
        self._see()
        self.reset()

    def _see(self) -> None:
        """Make the arrays of the function, and the call on them; see `Viewing`."""
        self._y, self._predicted, self._after = np.zeros(self._ny), np.zeros(self._ny), np.zeros(len(self._memory) + 2)
        arguments = self._y, self._predicted, self._memory
        self._evaluate, self._buffer = bind_interpreter(self._function, arguments, (self._after,))

    def reset(self) -> None:
        """Forget all readings."""
        self._memory[:] = 0.0
        self.refused = self.opened = self.lost = False
        self.w, self._doubted = _NO_W, 0

    def choose(
        self,
        y: Float[np.ndarray, " ny"],
        w: Float[np.ndarray, " nw"],
        predict: Callable[[Float[np.ndarray, " nw"]], Float[np.ndarray, " ny"]],
    ) -> Float[np.ndarray, " ny"]:
        """Return what this w predicts, or where it is wild what the last w that was used predicts.

        w is wild if its prediction, as a reading, would be refused beside that of the last one, and y would not. A step
        of w that the reading shows is used at once: no w is doubted while all |yᵢ − ŷᵢ| ≤ 5 qᵢ, see `gate_function`.
        After five wild ones in sequence w is used whatever it predicts.

        Parameters
        ----------
        predict
            w → the predicted reading. The last call is that of the prediction that is returned.
        """
        predicted, last = predict(w), self.w if self.w.size else np.zeros(len(w))
        if not self._agrees(y, predicted) and self._doubted < BRIDGED and (w != last).any():
            predicted = predicted.copy()
            expected = predict(last).copy()
            moved = np.where(np.abs(y) < HUGE, predicted, expected)
            if self._is_beyond(moved, expected) and not self._is_beyond(y, expected):
                self._doubted += 1
                self.w = last
                return expected
            predicted = predict(w)
        self.w, self._doubted = w.copy(), 0
        return predicted

    def _agrees(self, y: Float[np.ndarray, " ny"], predicted: Float[np.ndarray, " ny"]) -> bool:
        """Return whether y is as near to this prediction as readings that are not refused are to theirs at rest."""
        quantiles = self._memory[: self._ny].tolist()
        for measured, foreseen, q in zip(y.tolist(), predicted.tolist(), quantiles, strict=True):
            if abs(measured - foreseen) > BEYOND * q:  # False for NaN
                return False
        return True

    def _is_beyond(self, y: Float[np.ndarray, " ny"], predicted: Float[np.ndarray, " ny"]) -> bool:
        """Return whether y would be refused, or would start the observer again."""
        self._y[:], self._predicted[:] = y, predicted
        self._evaluate()
        return bool(self._after[0] or self._after[1] == 2)

    @property
    def stand_in(self) -> Float[np.ndarray, " nw"] | None:
        """The last w that was used, if the last one was wild."""
        return self.w if self._doubted else None

    def judge(self, y: Float[np.ndarray, " ny"], predicted: Float[np.ndarray, " ny"]) -> bool:
        """Return whether y is refused; a NaN in `predicted` says that this entry was not predicted."""
        after = self._after
        self._y[:], self._predicted[:] = y, predicted
        self._evaluate()
        self._memory[:] = after[2:]
        self.refused, self.opened, self.lost = bool(after[0]), after[1] == 1, after[1] == 2
        return self.refused
