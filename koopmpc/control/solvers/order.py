"""The QP solvers by name: which answers first, which finishes what another leaves, which is asked last.

To add a solver, write a subclass of `QPSolver` in a file of its own in this folder, and name it in `SOLVERS` here.
Nothing else names solvers: `KoopmanMPC` asks `order_solvers`. If the solver comes with a package of its own,
pyproject.toml names that package, and an import contract gives it its one door.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from koopmpc import checks
from koopmpc.control.solvers.base import QPSolver, SolverTurn, StepQP
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.solvers.osqp import OSQP
from koopmpc.control.solvers.piqp import PIQP
from koopmpc.errors import DataError

SOLVERS: dict[str, type[QPSolver]] = {"osqp": OSQP, "daqp": DAQP, "piqp": PIQP}

FINISHER = DAQP  # solves to rounding what an inexact solver leaves, the targets of references, and the QPs of C code
RESCUER = "osqp"  # answers where the finisher has none; it is set up when it is first asked

# The rule of solver="auto": the solver that is asked first. `python -m tests.speed.first_solver` measures it, and
# docs/research.md has the table: the time of steps with a QP, OSQP first over DAQP first, by size and structure.
# DAQP won the ten tasks, the random loops and all sizes up to N 200 and nu 4. OSQP won loops with limits of inputs
# alone, n ≥ 400 and more than two thirds of the planned inputs at a limit, by up to 2.8; with few of them at a limit
# DAQP won the same sizes by up to 46. How many there will be is not known when a controller is built: one row for all.
FIRST = "daqp"

# Where a plan is long, its stages are small, and all its limits are hard, the first solver gets few iterations; then
# the stages are solved as they are, sparse. The time of PIQP grows with N, that of DAQP with N³ where as many rows act.
# `python -m tests.speed.first_solver --parts long` measures it; docs/research.md has the table.
SPARSE = "piqp"
LONG = 300  # steps from which on it is faster, first steps from nothing and later ones
WIDE = 60  # and so many steps for each entry of a stage's state, of which its time is a power of 1.2 to 2
PLANNED = 1000  # or so many planned inputs: 8 over 200 steps took half of the time, 4 over 150 steps 2.5 times as long
PATIENCE = 20  # iterations that the first solver gets there


def order_solvers(solver: str, settings: Mapping[str, Any]) -> list[SolverTurn]:
    """Return the solvers in the order in which a step asks them: the given one first, for "auto" that of the rule.

    Settings that the solver of the rule does not have name the solver that has them all. A first solver that is not
    exact has its `impatient` settings, and the finisher after it.

    Raises
    ------
    DataError
        There is no such solver.
    """
    first = solver
    if checks.among(solver, ("auto",)):
        able = [name for name in (FIRST, *SOLVERS) if not settings or set(settings) <= SOLVERS[name].setting_names()]
        first = able[0] if able else FIRST
    if not checks.among(first, SOLVERS):
        raise DataError(f"solver is {solver!r}; there are 'auto', {', '.join(map(repr, SOLVERS))}")
    kind = SOLVERS[first]
    turns = [SolverTurn(kind, {**kind.impatient, **settings})]
    if not kind.exact:
        turns.append(SolverTurn(SOLVERS[FINISHER.name], {}))
    return [*turns, SolverTurn(SOLVERS[RESCUER], {}, late=True)]


def add_sparse(turns: list[SolverTurn], qp: StepQP) -> list[SolverTurn]:
    """Return the solvers of a step where none was named: for a long plan of small stages the sparse one is second."""
    stages, hard = qp.stages, bool(np.isinf(qp.softness.linear).all())
    if stages is None or not hard:
        return turns
    n, nu = stages.B.shape
    if max(LONG, WIDE * n) > stages.N and stages.N * nu < PLANNED:
        return turns
    first = turns[0]
    sparse = SolverTurn(SOLVERS[SPARSE], {})
    return [first._replace(patience=PATIENCE), sparse, first._replace(late=True), *turns[1:]]


def exact_turn(turns: list[SolverTurn]) -> SolverTurn:
    """Return the turn of the exact solver, which the search over levels and the order of priorities need.

    Raises
    ------
    DataError
        A solver was chosen that is not exact.
    """
    if not turns[0].solver.exact:
        raise DataError(
            f'solver is {turns[0].solver.name!r}; inputs on levels and priorities of limits need "daqp", or "auto"'
        )
    return turns[0]
