"""LQR, Koopman MPC, bilinear and nonlinear MPC."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.control.kinds import BenchEntry as BenchEntry
    from koopmpc.control.kinds import ControllerKind as ControllerKind
    from koopmpc.control.kinds import list_kinds as list_kinds
    from koopmpc.control.kinds import register_controller as register_controller
    from koopmpc.control.kinds.eigenfunction_lqr import EigenfunctionLQR as EigenfunctionLQR
    from koopmpc.control.kinds.pid import PID as PID
    from koopmpc.control.kinds.pid import PIDOptions as PIDOptions
    from koopmpc.control.move import Controller as Controller
    from koopmpc.control.move import Fallback as Fallback
    from koopmpc.control.move import Fallible as Fallible
    from koopmpc.control.move import Plan as Plan
    from koopmpc.control.nonlinear.shooting import NLP as NLP
    from koopmpc.control.nonlinear.staged_program import StagedProgram as StagedProgram
    from koopmpc.control.plan.condensed_program import CondensedProgram as CondensedProgram
    from koopmpc.control.program import Program as Program
    from koopmpc.control.program import SavedController as SavedController
    from koopmpc.control.riccati import Gain as Gain
    from koopmpc.control.step.feedback import FeedbackProgram as FeedbackProgram
else:
    __getattr__, __dir__, __all__ = attach(
        __name__,
        moved={"Adaptive": "supervise", "Guarded": "supervise", "Monitor": "supervise", "Station": "supervise"},
    )
