"""The program of a KoopmanMPC as C solves it, and why there may be none."""

from dataclasses import replace

from numpy.typing import ArrayLike

from koopmpc.control.plan.condensed import plan_condensed
from koopmpc.control.plan.condensed_program import CondensedProgram
from koopmpc.control.plan.task import ControlTask
from koopmpc.control.program import no_export, reference_table, refuse_time_limit
from koopmpc.control.solvers import FINISHER

_OTHER_SOLVER = (
    "The controller solves with OSQP; this C solves with DAQP, to rounding: inputs differ by OSQP's tolerance."
)
_BY_WEIGHTS = (
    "The controller solves a QP for each priority of its limits; this C solves one, in which a limit weighs 1,000 "
    "times as much as one of the priority below."
)


def publish_condensed(
    controller: object, task: ControlTask, program: CondensedProgram, reference: ArrayLike | None
) -> CondensedProgram:
    """Return the program from which C code is generated; DataError where there is no code for a part of it.

    C has one plan, solved by the finisher, in Riccati coordinates; weights stand for priorities.
    """
    if program.input_levels is not None and program.levels is None:
        raise no_export(
            controller,
            "only some of its inputs or steps are on levels, and this search has no C code",
            "one whose inputs are all on levels in all steps",
        )
    if program.plans is not None:
        raise no_export(
            controller, "its weights move in time, and its C holds one plan", "one without Cost(Q_rows=…, R_rows=…)"
        )
    if program.ball is not None:
        raise no_export(
            controller,
            "Clarabel solves its QP with a terminal ellipsoid",
            "one with a polytope, or without a terminal set",
        )
    rows, notes = reference_table(reference, program.nr), ()
    refuse_time_limit(task.time_limit, 'solver="daqp", settings={"iter_limit": 100}')
    if program.priority is not None:
        notes = (_BY_WEIGHTS,)
    elif task.solver == "osqp":
        notes = (_OTHER_SOLVER,)
    if notes or task.solver != FINISHER.name:
        program = plan_condensed(task.for_c(FINISHER.name))
    program = replace(program, controller=type(controller).__name__, reference=rows, notes=notes)
    _ = program.estimator, program.lifting  # these may be code that cannot be written in C
    return program
