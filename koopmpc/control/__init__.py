"""LQR, Koopman MPC, bilinear and nonlinear MPC."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.control.adaptive import Adaptive as Adaptive
    from koopmpc.control.adaptive import Guarded as Guarded
    from koopmpc.control.monitor import Monitor as Monitor
    from koopmpc.control.move import Controller as Controller
    from koopmpc.control.move import Fallback as Fallback
    from koopmpc.control.move import Fallible as Fallible
    from koopmpc.control.move import Plan as Plan
    from koopmpc.control.nonlinear.eigenfunction_lqr import EigenfunctionLQR as EigenfunctionLQR
    from koopmpc.control.riccati import Gain as Gain
    from koopmpc.control.saved import SavedController as SavedController
else:
    __getattr__, __dir__, __all__ = attach(__name__)
