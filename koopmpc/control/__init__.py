"""LQR, Koopman MPC, bilinear and nonlinear MPC."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.control.adaptive import Adaptive as Adaptive
    from koopmpc.control.adaptive import Guarded as Guarded
    from koopmpc.control.base import SavedController as SavedController
    from koopmpc.control.lqr import EigenfunctionLQR as EigenfunctionLQR
    from koopmpc.control.monitor import Monitor as Monitor
    from koopmpc.control.move import Controller as Controller
    from koopmpc.control.move import Fallback as Fallback
    from koopmpc.control.move import Fallible as Fallible
    from koopmpc.control.move import Plan as Plan
    from koopmpc.control.riccati import Gain as Gain
else:
    __getattr__, __dir__, __all__ = attach(__name__)
