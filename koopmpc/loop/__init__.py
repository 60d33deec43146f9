"""The closed loop: simulate, realtime, Run, metrics, faults."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.loop.adaptive import Adaptive as Adaptive
    from koopmpc.loop.guarded import Guarded as Guarded
    from koopmpc.loop.metrics import Metrics as Metrics
    from koopmpc.loop.monitor import Monitor as Monitor
    from koopmpc.loop.realtime import Paced as Paced
    from koopmpc.loop.realtime import in_real_time as in_real_time
    from koopmpc.loop.rows import Plans as Plans
    from koopmpc.loop.rows import Step as Step
    from koopmpc.loop.simulate import LoopOptions as LoopOptions
    from koopmpc.loop.station import Station as Station
else:
    __getattr__, __dir__, __all__ = attach(__name__)
