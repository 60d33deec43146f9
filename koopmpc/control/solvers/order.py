"""The QP solvers by name: which answers first, and which finishes what it leaves unsolved.

To add a solver, write a subclass of `QPSolver` in a file of its own in this folder, and name it in `SOLVERS` here.
Nothing else names solvers: `KoopmanMPC` asks `order_solvers`. If the solver comes with a package of its own,
pyproject.toml names that package, and an import contract gives it its one door.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.control.solvers.base import QPSolver, SolverTurn, StepQP
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.solvers.osqp import OSQP
from koopmpc.control.solvers.piqp import PIQP, has_piqp

SOLVERS: dict[str, type[QPSolver]] = {"osqp": OSQP, "daqp": DAQP, "piqp": PIQP}

FINISHER = DAQP  # solves to rounding what an inexact solver leaves, the targets of references, and the QPs of C code

# The solver of "auto". `python -m tests.speed.first_solver` measures it, and docs/research.md has the table. DAQP won
# the ten tasks, the random loops and all sizes up to N 200 and nu 4. OSQP won loops with limits of inputs alone, 400
# inputs and more in a plan, and more than two thirds of them at a limit, by up to 2.8; with few DAQP won by up to 46.
FIRST = "daqp"

# The solver of "auto" for a long plan with hard limits alone, if it is installed: the time of PIQP grows with N, that
# of DAQP with N³ where as many rows act. `python -m tests.speed.first_solver --parts long` measures it.
SPARSE = "piqp"
LONG = 300  # steps from which on a plan is long
WIDE = 60  # a plan is long only from so many steps on for each entry of a stage's state


def order_solvers(solver: str, settings: Mapping[str, Any]) -> list[SolverTurn]:
    """Return the solver of this name, for "auto" that of the rule, and behind it the one that finishes what it leaves.

    That is DAQP, of which a second one would find no more where the first has no settings of its own. Settings that
    the solver of the rule does not have name the solver that has them all.
    """
    first = solver
    if checks.among(solver, ("auto",)):
        able = [name for name in (FIRST, *SOLVERS) if not settings or set(settings) <= SOLVERS[name].setting_names()]
        first = able[0] if able else FIRST
    if not checks.among(first, SOLVERS):
        raise DataError(f"solver is {solver!r}; there are 'auto', {', '.join(map(repr, SOLVERS))}")
    kind = SOLVERS[first]
    turns = [SolverTurn(kind, {**kind.impatient, **settings})]
    if first == FINISHER.name and not settings:
        return turns
    return [*turns, SolverTurn(SOLVERS[FINISHER.name], {})]


def add_sparse(turns: list[SolverTurn], qp: StepQP) -> list[SolverTurn]:
    """Return the solvers of a step where none was named: the sparse one solves long plans with hard limits alone."""
    stages, hard = qp.stages, bool(np.isinf(qp.softness.linear).all())
    if stages is None or not hard or max(LONG, WIDE * len(stages.A)) > stages.N or not has_piqp():
        return turns
    return [SolverTurn(SOLVERS[SPARSE], {}), *turns]


def exact_turn(turns: list[SolverTurn]) -> SolverTurn:
    """Return the turn of the exact solver, which the search over levels and the order of priorities need."""
    if not turns[0].solver.exact:
        raise DataError(
            f'solver is {turns[0].solver.name!r}; inputs on levels and priorities of limits need "daqp", or "auto"'
        )
    return turns[0]
