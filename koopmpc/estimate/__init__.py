"""Observers: the lifted state now, and the disturbance that acts on it."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.estimate.observer import Estimator as Estimator
    from koopmpc.estimate.periodic import find_period as find_period
else:
    __getattr__, __dir__, __all__ = attach(__name__)
