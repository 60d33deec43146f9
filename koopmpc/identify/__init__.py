"""From episodes to predictors: one regression a file, on second moments that they share."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.identify.constrained.prior import Combination as Combination
    from koopmpc.identify.constrained.prior import Dissipation as Dissipation
    from koopmpc.identify.fits.kic import InputPredictor as InputPredictor
    from koopmpc.identify.fits.kic import kic as kic
else:
    __getattr__, __dir__, __all__ = attach(__name__)
