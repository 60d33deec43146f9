# pyright: basic
"""KoopmanRegressor: a lifted linear model as a scikit-learn estimator."""

from typing import Any

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import DataError, install
from koopmpc.lifting.base import Lifting, check_lifting
from koopmpc.lifting.fourier import Fourier
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.models.moments.solve import RegressionRows, solve
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.shared.regression import compute_scale_factor

try:
    from sklearn.base import BaseEstimator, RegressorMixin
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError as error:
    raise ImportError(f"KoopmanRegressor needs scikit-learn, which is not installed: {install('sklearn')}") from error


class KoopmanRegressor(RegressorMixin, BaseEstimator):
    """y = W [ψ(x) u] by ridge regression, rows of X being [x u]; with y = x⁺ it is the next state of z⁺ = A z + B u.

    `fit` takes pairs of a row and its target, so that scikit-learn may shuffle rows; for a dynamic model y holds the
    next states. Cross-validate over episodes with ``GroupKFold``, where the group of a row is its episode. The score
    measures one-step forecasts; `koopmpc.select` measures forecasts of many steps.

    Parameters
    ----------
    degree
        Monomials up to this total degree; 1 is the state alone.
    harmonics
        Sines and cosines of the states up to this multiple; 0 for none.
    lifting
        ψ; it replaces degree and harmonics.
    alpha
        Ridge weight as in `edmd`; 0 cuts singular values below rounding.
    n_inputs
        Number of inputs, which are the last columns of X.
    dt
        Sample time of the predictor [s].

    Attributes
    ----------
    coef_
        (n_targets, nz + n_inputs), W.
    lifting_
        ψ, bound to the states.
    predictor_
        LinearPredictor with z⁺ = A z + B u; its C is fitted for the states that ψ lacks. It exists only if y has one
        column for each state, as next states have.
    n_features_in_
        Columns of X.

    References
    ----------
    Williams, Kevrekidis & Rowley, "A data-driven approximation of the Koopman operator", J. Nonlinear Sci. 25, 2015.
    """

    def __init__(
        self,
        degree: Any = 2,  # fit checks all parameters, as scikit-learn demands
        harmonics: Any = 0,
        lifting: Any = None,
        alpha: Any = 0.0,
        n_inputs: Any = 0,
        dt: Any = 1.0,
    ) -> None:
        self.degree = degree
        self.harmonics = harmonics
        self.lifting = lifting
        self.alpha = alpha
        self.n_inputs = n_inputs
        self.dt = dt

    def fit(self, X: Any, y: Any) -> "KoopmanRegressor":
        """Fit to rows [x u] and their targets y, (M,) or (M, n_targets); return self.

        Raises
        ------
        DataError
            alpha is negative, degree or harmonics is not a whole number, or no column is left for a state.
        """
        rows: Any
        targets: Any
        rows, targets = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        nu = checks.count(self.n_inputs, "n_inputs", 0)
        alpha = float(checks.array(self.alpha, "alpha", ()))
        if alpha < 0:
            raise DataError(f"alpha is {alpha:g}; it must be 0 or above")
        nx = rows.shape[1] - nu
        if nx < 1:
            raise DataError(f"X has {rows.shape[1]} columns and n_inputs is {nu}; at least one must be a state")
        named = getattr(self, "feature_names_in_", None)
        names = [f"x{i}" for i in range(nx)] + [f"u{i}" for i in range(nu)] if named is None else [*named]
        self.lifting_ = self._lifting().bind(names[:nx])
        Z, U = self.lifting_(rows[:, :nx]), rows[:, nx:]
        table = np.asarray(targets, dtype=np.float64).reshape(len(rows), -1)
        self.coef_ = self._solve(np.hstack([Z, U]), table, alpha)
        self._flat = np.ndim(targets) == 1
        vars(self).pop("predictor_", None)
        if table.shape[1] == nx:
            nz = self.lifting_.nz
            K = self._solve(np.hstack([Z, U]), self.lifting_(table), alpha)
            C = self._solve(Z, rows[:, :nx], 0.0)
            places = [self.lifting_.names.index(name) if name in self.lifting_.names else -1 for name in names[:nx]]
            for i, place in enumerate(places):
                if place >= 0:
                    C[i] = np.eye(nz)[place]
            self.predictor_ = LinearPredictor(
                *(K[:, :nz], K[:, nz:], C, self.lifting_, self.dt, names[:nx], names[nx:]),
                scale=compute_scale_factor(Z, len(Z)),
            )
        return self

    def predict(self, X: Any) -> np.ndarray:
        """Return the forecast W [ψ(x) u] for rows [x u], (M, n_targets) or (M,)."""
        check_is_fitted(self)
        rows: Any = validate_data(self, X, reset=False, dtype=np.float64)
        nx = rows.shape[1] - self.n_inputs
        targets = np.hstack([self.lifting_(rows[:, :nx]), rows[:, nx:]]) @ self.coef_.T
        return targets[:, 0] if self._flat else targets

    def __sklearn_tags__(self) -> Any:
        """Tell scikit-learn that y may have several columns."""
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    def _lifting(self) -> Lifting:
        if self.lifting is not None:
            return check_lifting(self.lifting)
        lifting: Lifting = State() + Constant()
        if checks.count(self.degree, "degree") > 1:
            lifting = lifting + Monomials(self.degree)
        if checks.count(self.harmonics, "harmonics", 0):
            lifting = lifting + Fourier(self.harmonics)
        return lifting

    def _solve(self, P: np.ndarray, T: np.ndarray, alpha: float) -> np.ndarray:
        rows = RegressionRows(P, T, np.zeros(T.shape[1]), len(P), self.lifting_.constant_index)
        return solve(rows, ridge=alpha).K.T
