"""Constrained: the deviation from the unconstrained plan that meets the limits; hard rows first, soft where need be.

Slack variables with their large weights make a QP slow for a first-order method. Where the QP with all rows hard has
a solution whose multipliers stay below the linear slack weights, that solution is the soft QP's too (the penalty is
exact), and most steps end there. Otherwise the soft QP is solved.

Kerrigan & Maciejowski, "Soft constraints and exact penalty functions in model predictive control", 2000.
"""

from collections.abc import Mapping
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.control.limits import Box
from koopmpc.control.move import Status
from koopmpc.control.program import Program
from koopmpc.control.solvers.base import QPSolution
from koopmpc.control.solvers.choose import SOFT_SETTINGS
from koopmpc.control.solvers.choose import solver as named


class Answer(NamedTuple):
    """w of the deviation D w, how it was found, and whether a limit gave way."""

    w: Float[np.ndarray, " nw"]
    status: Status
    iterations: int
    gave_way: bool


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

    def solve(self, v: Float[np.ndarray, " nv"], room: Box | None, nw: int, deadline: float | None) -> Answer:
        """Return the least deviation from the plan v.

        Parameters
        ----------
        room
            How far each input is from its limits, lower and upper, where a hard rate limits it: where the two
            exclude each other the input limit wins.
        nw
            Entries of w.
        deadline
            The time by `perf_counter` at which the answer is due.
        """
        found, conflict = self._hard.solve(v, room, deadline)
        iterations = found.iterations
        if self._soft is None:
            return Answer(found.v[:nw], found.status, iterations, conflict)
        solved = found.status is Status.OPTIMAL
        if solved and (np.abs(found.y) <= self._hard.program.most).all():
            self._soft.warm = False
            return Answer(found.v[:nw], Status.OPTIMAL, iterations, conflict)
        if not solved:
            self._hard.warm = False
        found, conflict = self._soft.solve(v, room, deadline)
        gave_way = conflict or bool((found.v[nw:] > self._soft.program.allowance).any())
        return Answer(found.v[:nw], found.status, iterations + found.iterations, gave_way)


class Solve:
    """One QP, its solver, and the last solution, which the next solve starts from moved on by one step."""

    def __init__(self, program: Program, solver: str, settings: Mapping[str, Any]) -> None:
        self.program, self.warm = program, False
        self._solver = named(solver)(program.qp, settings)
        self._primal = np.zeros(len(program.qp.q) + 1)  # one more, always zero, for the shift
        self._dual = np.zeros(len(program.low) + 1)

    def adopt(self, program: Program) -> None:
        """Go on with new matrices of the same size."""
        self.program = program
        self._solver.adopt(program.qp)

    def reset(self) -> None:
        """Forget what earlier solves left behind in the solver."""
        self._solver.reset()

    def solve(
        self, v: Float[np.ndarray, " nv"], room: Box | None, deadline: float | None
    ) -> tuple[QPSolution, bool]:
        """Return the solution, and whether the input limits are out of the hard rates' reach."""
        program, conflict = self.program, False
        low, high = program.low.copy(), program.high.copy()
        if room is not None:
            rows, which = program.rates
            lowest, highest = np.minimum(low[rows], room.high[which]), np.maximum(high[rows], room.low[which])
            conflict = bool((lowest < low[rows] - 1e-9).any() or (highest > high[rows] + 1e-9).any())
            low[rows], high[rows] = lowest, highest
        moved = v[program.source]
        low[: len(moved)] -= moved
        high[: len(moved)] -= moved
        self._solver.update(low, high)
        if self.warm:
            start = self._primal[program.shift_primal], self._dual[program.shift_dual]
        else:
            start = np.zeros(len(program.shift_primal)), np.zeros(len(program.shift_dual))
        left = None if deadline is None else deadline - perf_counter()
        found = self._solver.solve(*start, time_limit=left)
        self.warm = found.status is Status.OPTIMAL
        if self.warm:
            self._primal[:-1], self._dual[:-1] = found.v, found.y
        return found, conflict
