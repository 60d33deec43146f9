"""Constrained: the deviation from the unconstrained plan that meets the limits; hard rows first, soft where need be.

Slack variables with their large weights make a QP slow for a first-order method. Where the QP with all rows hard has
a solution whose multipliers stay below the linear slack weights, that solution is the soft QP's too (the penalty is
exact), and most steps end there. Otherwise the soft QP is solved.

Kerrigan & Maciejowski, "Soft constraints and exact penalty functions in model predictive control", 2000.
"""

from collections.abc import Mapping
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.limits import Box
from koopmpc.control.move import Status
from koopmpc.control.program import Program
from koopmpc.control.solvers.base import QPSolution
from koopmpc.control.solvers.choose import SOFT_SETTINGS
from koopmpc.control.solvers.choose import solver as named

# What a solve is given less from now on after it was late, and more after it was not [s]: one of ten will be late.
_LONGER, _SHORTER = 18e-6, 2e-6
_AFTER = 5e-5  # what a step does after its solve [s]


class Constrained:
    """The QPs of a step, which share the plan that they start from and differ in their rows.

    Parameters
    ----------
    hard, soft
        All rows hard; and soft where the limits say so, None where none is.
    solver
        Name of the solver of both.
    settings
        The solver's own settings, for both.
    """

    def __init__(
        self, hard: Program, soft: Program | None, solver: str, settings: Mapping[str, Any] | None
    ) -> None:
        named(solver)
        if settings is not None:
            checks.kind(
                settings, "settings", Mapping, 'pass the solver\'s own by name, for example {"max_iter": 100}'
            )
        self._hard = Solve(hard, solver, settings or {})
        self._soft = (
            None if soft is None else Solve(soft, solver, {**SOFT_SETTINGS[solver], **(settings or {})})
        )

    def adopt(self, hard: Program, soft: Program | None) -> None:
        """Go on with new matrices of the same size; the warm starts are kept."""
        self._hard.adopt(hard)
        if self._soft is not None and soft is not None:
            self._soft.adopt(soft)

    def cool(self) -> None:
        """Forget the warm starts."""
        self._hard.warm = False
        if self._soft is not None:
            self._soft.warm = False

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        self.cool()
        for solve in (self._hard, self._soft):
            if solve is not None:
                solve.reset()

    def solve(
        self, v: Float[np.ndarray, " nv"], room: Box | None, deadline: float | None
    ) -> tuple[QPSolution, float]:
        """Return the least deviation from the plan v, w of D w, and how far a soft limit gave way, 0 where none did.

        Parameters
        ----------
        room
            How far each input is from its limits, lower and upper, where a hard rate limits it: where the two
            exclude each other the input limit wins.
        deadline
            The time by `perf_counter` at which the answer is due.
        """
        found, conflict = self._hard.solve(v, room, deadline)
        if self._soft is None or found.status is Status.TIME_LIMIT:
            return found, conflict
        iterations = found.iterations
        if found.status is Status.OPTIMAL and (np.abs(found.y) <= self._hard.program.most).all():
            self._soft.warm = False
            return found, conflict
        found, conflict = self._soft.solve(v, room, deadline)
        nw = self._hard.size
        program, slacks = self._soft.program, found.v[nw:]
        given = slacks > program.allowance
        gave_way = max(conflict, float((slacks * program.slack_unit)[given].max(initial=0.0)))
        found.v, found.iterations = found.v[:nw], iterations + found.iterations
        return found, gave_way


class Solve:
    """One QP, its solver, and the last solution, which the next solve starts from moved on by one step.

    A solver looks at the clock only now and then: it gets the time until the deadline less what earlier solves took
    too long, and half of it at least.
    """

    def __init__(self, program: Program, solver: str, settings: Mapping[str, Any]) -> None:
        self.program, self.warm = program, False
        self._solver = named(solver)(program.qp, settings)
        self.size = n = len(program.qp.q)
        m = len(program.low)
        self._primal, self._dual = np.zeros(n + 1), np.zeros(m + 1)  # one more, always zero, for the shift
        self._cold = np.zeros(n), np.zeros(m)
        self._moved = np.zeros(m)  # rows of slacks stay
        self._tail = 0.0  # by how much solves outlast the time they are given [s]

    def adopt(self, program: Program) -> None:
        """Go on with new matrices of the same size."""
        self.program = program
        self._solver.adopt(program.qp)

    def reset(self) -> None:
        """Forget what earlier solves left behind in the solver."""
        self._solver.reset()

    def solve(
        self, v: Float[np.ndarray, " nv"], room: Box | None, deadline: float | None
    ) -> tuple[QPSolution, float]:
        """Return the solution, and how far the input limits are out of the hard rates' reach."""
        program, solver, conflict = self.program, self._solver, 0.0
        moved = self._moved
        np.multiply(v[program.source], program.scale, out=moved[: len(program.source)])
        if room is None:
            solver.shift(moved)
        else:
            low, high = program.low.copy(), program.high.copy()
            rows, which = program.rates
            scale = program.scale[rows]
            lowest = np.minimum(low[rows], room.high[which] * scale)
            highest = np.maximum(high[rows], room.low[which] * scale)
            below, above = lowest < low[rows], highest > high[rows]  # never where there is no limit
            past = np.where(below, low[rows], 0.0) - np.where(below, lowest, 0.0)
            past += np.where(above, highest, 0.0) - np.where(above, high[rows], 0.0)
            conflict = float((past / scale)[past > 1e-9].max(initial=0.0))
            low[rows], high[rows] = lowest, highest
            solver.update(low - moved, high - moved)
        start = self._cold
        if self.warm and not solver.goes_on:
            start = self._primal[program.shift_primal], self._dual[program.shift_dual]
        if deadline is None:
            found = solver.solve(*start)
        else:
            left = deadline - perf_counter()
            found = solver.solve(*start, time_limit=left - min(self._tail, left / 2))
            if found.status is Status.TIME_LIMIT:
                late = perf_counter() > deadline - _AFTER
                self._tail = max(self._tail + (_LONGER if late else -_SHORTER), 0.0)
        self.warm = found.status is Status.OPTIMAL
        if self.warm and not solver.goes_on:
            self._primal[:-1], self._dual[:-1] = found.v, found.y
        return found, conflict
