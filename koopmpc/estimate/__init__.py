"""Where the lifted state is, and what disturbs it."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.estimate.observer import Estimator as Estimator
else:
    __getattr__, __dir__, __all__ = attach(__name__)
