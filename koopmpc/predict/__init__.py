"""Lifted predictors and their spectrum."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.predict.base import FitReport as FitReport
    from koopmpc.predict.predictors import from_peer as from_peer
else:
    __getattr__, __dir__, __all__ = attach(__name__)
