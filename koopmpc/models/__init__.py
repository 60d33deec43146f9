"""From episodes to predictors: one regression a file, on second moments that they share."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.models.base import FitReport as FitReport
    from koopmpc.models.first_rows import estimate_start as estimate_start
    from koopmpc.models.fits.constrained import constrained_edmd as constrained_edmd
    from koopmpc.models.fits.eigenfunctions import eigenfunctions as eigenfunctions
    from koopmpc.models.fits.kernel import kernel_edmd as kernel_edmd
    from koopmpc.models.fits.kic import InputPredictor as InputPredictor
    from koopmpc.models.fits.kic import kic as kic
    from koopmpc.models.fits.prior import Combination as Combination
    from koopmpc.models.fits.prior import Dissipation as Dissipation
    from koopmpc.models.fits.prior import Prior as Prior
    from koopmpc.models.fits.refinement import refine as refine
    from koopmpc.models.fits.sparse import sparse_edmd as sparse_edmd
    from koopmpc.models.fits.stable import stable_edmd as stable_edmd
    from koopmpc.models.innovations import prediction_error as prediction_error
    from koopmpc.models.instruments import instrumental_edmd as instrumental_edmd
    from koopmpc.models.records.narx import narx as narx
    from koopmpc.models.records.state_space import neural_state_space as neural_state_space
    from koopmpc.models.records.state_space import polynomial_state_space as polynomial_state_space
    from koopmpc.models.records.subspace import subspace as subspace
    from koopmpc.models.regressor import KoopmanRegressor as KoopmanRegressor
    from koopmpc.models.unequal import unequal_rates as unequal_rates
else:
    __getattr__, __dir__, __all__ = attach(__name__)
