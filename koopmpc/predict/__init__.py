"""Lifted predictors and their spectrum."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.predict.base import FitReport as FitReport
else:
    __getattr__, __dir__, __all__ = attach(__name__)
