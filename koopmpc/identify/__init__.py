"""From episodes to predictors: one regression a file, on second moments that they share."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.identify.first_rows import estimate_start as estimate_start
    from koopmpc.identify.fits.constrained import constrained_edmd as constrained_edmd
    from koopmpc.identify.fits.eigenfunctions import eigenfunctions as eigenfunctions
    from koopmpc.identify.fits.kernel import kernel_edmd as kernel_edmd
    from koopmpc.identify.fits.kic import InputPredictor as InputPredictor
    from koopmpc.identify.fits.kic import kic as kic
    from koopmpc.identify.fits.prior import Combination as Combination
    from koopmpc.identify.fits.prior import Dissipation as Dissipation
    from koopmpc.identify.fits.prior import Prior as Prior
    from koopmpc.identify.fits.refinement import refine as refine
    from koopmpc.identify.fits.sparse import sparse_edmd as sparse_edmd
    from koopmpc.identify.fits.stable import stable_edmd as stable_edmd
    from koopmpc.identify.innovations import prediction_error as prediction_error
    from koopmpc.identify.instruments import instrumental_edmd as instrumental_edmd
    from koopmpc.identify.records.narx import narx as narx
    from koopmpc.identify.records.state_space import neural_state_space as neural_state_space
    from koopmpc.identify.records.state_space import polynomial_state_space as polynomial_state_space
    from koopmpc.identify.records.subspace import subspace as subspace
    from koopmpc.identify.regressor import KoopmanRegressor as KoopmanRegressor
    from koopmpc.identify.unequal import unequal_rates as unequal_rates
else:
    __getattr__, __dir__, __all__ = attach(__name__)
