"""What watches a controller: whether its model knows the step, what it learns meanwhile, who takes over."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.supervise.adaptive import Adaptive as Adaptive
    from koopmpc.supervise.guarded import Guarded as Guarded
    from koopmpc.supervise.monitor import Monitor as Monitor
    from koopmpc.supervise.station import Station as Station
else:
    __getattr__, __dir__, __all__ = attach(__name__)
