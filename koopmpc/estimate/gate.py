"""ReadingGate: a reading far from its prediction is not used; the prediction stands in for a few steps."""

from collections.abc import Callable
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base.checks import HUGE
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Viewing
from koopmpc.plants.graph import Graph
from koopmpc.plants.routines import bind_interpreter

BEYOND = 8.0  # a reading is refused if its innovation exceeds so many standard deviations: χ² = 64
REFUSALS = 6  # refused readings in sequence for which a prediction stands in; so many have to agree before one is wild
BRIDGED = 5  # missed readings in sequence, or doubted disturbances, for which a prediction stands in
SURE = 2  # readings have to agree before an absurd one is refused
LEAP = 10.0  # until readings agree, the observer starts again from one that leaps by so many largest steps
ABSURD = 1e4  # or by so many, where not all states are measured; a reading is absurd if off by so many times all shown
WEIGHT = 0.1  # weight of the newest square of an innovation in the running S
NARROW = 0.7  # until readings agree, the standard deviation falls to the last innovation by this factor a step
LEAST = 0.01  # the standard deviation counts as at least this share of the largest step that the output has made
ROUNDING = 1e-9  # and as this share of the reading's and the prediction's size: what is smaller is rounding
FADING = 0.8  # what a predicted step allows fades by this factor a step

_NO_W = np.zeros(0)


@cache
@raise_swallowed()
def gate_function(ny: int, leaps: bool = False) -> ca.Function:
    """Return (y, prediction, memory) → [whether y is refused; 1 if the gate has opened, 2 if all is lost; the memory].

    y is refused if (|ν| − ρ s)²/S > χ² for any of its innovations ν = y − ŷ. S = n σ²: σ² is the running mean of ν²,
    and n the readings since one was used. s is the largest step of this output that was used, ρ the largest predicted
    step of all outputs in units of their s, which fades by 0.8 a step: in a transient a model may err by as much as the
    outputs move. σ counts as at least 0.01 s, and as 1e-9 of y and ŷ, so that rounding decides nothing. After six
    refused readings in sequence the next one is used, and σ is its innovation. Entries that are NaN are not judged.

    At the start, and after a reading that was used so, nobody knows whether y or ŷ is wild, until six readings agreed
    with their predictions. Until then one is refused only after two that agreed, if it is absurd: |y − last| and |ν|
    are beyond 1e4 times all that its output has shown. A reading leaps if both are beyond 10 times the largest step,
    used or predicted, without `leaps` beyond 1e4 times. Then what came before was wild, or this reading is, and the
    next one will leap back: the observer starts again from y, at most twelve times until readings agree. So it does
    where |ν| > 1e4 (s + |y|), or where an output falls to less than 1e-4 of its last value and of ν, though not to
    zero.

    The memory is σ, s, the predicted steps, the last used values, how many readings agreed, how many were refused or
    leapt in sequence, and whether one has come.
    """
    y, predicted, memory = (ca.SX.sym(name, n) for name, n in (("y", ny), ("predicted", ny), ("memory", 4 * ny + 3)))
    ends = [0, ny, 2 * ny, 3 * ny, 4 * ny, 4 * ny + 1, 4 * ny + 2, 4 * ny + 3]
    sigma, largest, ahead, last, agreed, denied, begun = ca.vertsplit(memory, ends)
    known = ca.fabs(y) < HUGE
    came = ca.logic_and(known, ca.fabs(predicted) < HUGE)  # False for NaN
    innovation = ca.if_else(came, ca.fabs(y - predicted), 0)
    ahead_new = ca.fmax(ca.if_else(ca.logic_and(came, begun), ca.fabs(predicted - last), 0), FADING * ahead)
    least = ca.fmin(ca.fabs(last), ca.fmin(ca.fabs(predicted), ca.fabs(y)))
    rounding = ca.if_else(came, ROUNDING * least, 0)
    step = ca.fmax(largest, ahead_new)
    moving = ca.fmax(step, rounding)
    transient = ca.mmax(ahead_new / ca.if_else(moving > 0, moving, 1)) * step
    wide = ca.fmax(sigma, ca.fmax(LEAST * largest, rounding))
    judged, sure, patient = ca.mmax(came), agreed >= REFUSALS, denied < REFUSALS
    good = ca.mmin(innovation <= BEYOND * wide * ca.sqrt(1 + ca.if_else(sure, denied, 0)) + transient)
    moved = ca.if_else(came, ca.fabs(y - last), 0)
    leapt = ca.logic_and(step > rounding, ca.fmin(innovation, moved) > (LEAP if leaps else ABSURD) * step)
    shown = step + ca.fabs(last)
    beyond = ca.logic_and(shown > 0, ca.fmin(innovation, moved) > ABSURD * shown)
    absurd = ca.logic_and(agreed >= SURE, ca.mmax(beyond))
    wild = ca.logic_and(ca.logic_or(ca.logic_and(judged, sure), absurd), ca.logic_not(good))
    missed = ca.fmax(innovation / ABSURD - largest, ca.fmin(innovation, ca.fabs(last)) / ABSURD)
    fell = ca.logic_and(ca.mmax(ca.logic_and(y != 0, missed > ca.fabs(y))), ca.logic_or(ca.logic_not(sure), wild))
    leaps_off = ca.logic_and(ca.mmax(leapt), ca.logic_not(ca.logic_or(sure, absurd)))
    lost = ca.logic_and(ca.logic_or(leaps_off, fell), denied < 2 * REFUSALS)
    refused, opened = ca.logic_and(wild, patient), ca.logic_and(wild, ca.logic_not(patient))
    learned = ca.logic_and(came, ca.logic_not(refused))
    share = ca.fmin(innovation / ca.if_else(wide > 0, wide, 1), 1 / ROUNDING)  # no square overflows a float
    running = wide * ca.sqrt(1 + WEIGHT * (share**2 - 1))
    sigma_new = ca.if_else(ca.logic_and(sure, good), running, ca.fmax(innovation, NARROW * wide))
    used = ca.if_else(refused, predicted, y)
    agreed_new = ca.if_else(opened, 0, ca.fmin(agreed + ca.logic_and(judged, ca.logic_not(refused)), REFUSALS))
    after = ca.vertcat(
        ca.if_else(learned, sigma_new, sigma),
        ca.if_else(ca.logic_and(ca.logic_and(learned, begun), ca.logic_not(opened)), ca.fmax(largest, moved), largest),
        ahead_new,
        ca.if_else(ca.fabs(used) < HUGE, used, last),
        agreed_new,
        ca.if_else(refused, denied + 1, ca.if_else(ca.logic_or(opened, agreed_new >= REFUSALS), 0, denied)),
        ca.logic_or(begun, ca.mmax(known)),
    )
    anew = ca.vertcat(ca.SX(3 * ny, 1), ca.if_else(known, y, last), 0, denied + 1, 1)
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
        of w that the reading shows is used at once: no w is doubted while all |yᵢ − ŷᵢ| ≤ 8 σᵢ, see `gate_function`.
        After five wild ones in sequence w is used whatever it predicts. The last call of `predict` is that of the
        prediction that is returned.
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
        deviations = self._memory[: self._ny].tolist()
        pairs = zip(y.tolist(), predicted.tolist(), deviations, strict=True)
        return not any(abs(measured - foreseen) > BEYOND * sigma for measured, foreseen, sigma in pairs)  # NaN agrees

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


class Gated:
    """An observer with a gate of readings; None where it remembers no reading."""

    _gate: Any

    @property
    def refused(self) -> bool:
        """Whether the last y was refused, and its prediction stood in."""
        return self._gate is not None and self._gate.refused

    @property
    def stand_in_w(self) -> Float[np.ndarray, " nw"] | None:
        """The w to plan with, if the last one was wild."""
        return None if self._gate is None else self._gate.stand_in
