"""Observables ψ(x).

All families are imported here: a file or a task that holds a lifting names its class, which must be known by then.
A new family is added here.
"""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach
from koopmpc.lifting import composed as composed
from koopmpc.lifting import fourier as fourier
from koopmpc.lifting import neurons as neurons
from koopmpc.lifting import radial as radial
from koopmpc.lifting import state as state

if TYPE_CHECKING:
    from koopmpc.lifting.composed import Projected as Projected
    from koopmpc.lifting.composed import Saturated as Saturated
    from koopmpc.lifting.composed import Standardized as Standardized
    from koopmpc.lifting.network import ONNX as ONNX
    from koopmpc.lifting.neurons import Neurons as Neurons
else:
    __getattr__, __dir__, __all__ = attach(__name__)
