"""subspace: a linear model with a hidden state of least order, which is a linear function of the past rows."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Unpack

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError, KoopmpcError
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.composed import Projected
from koopmpc.lifting.state import Constant, State
from koopmpc.models.moments.moments import Moments
from koopmpc.models.moments.read import ReadOptions, second_moments
from koopmpc.models.moments.solve import RegressionRows, column_norms, solve
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.records.narx import check_list, is_worse, source_episodes
from koopmpc.models.records.structure import EXACT, find_forecast_horizon
from koopmpc.models.records.unseen import cut_quarter, measure_forecasts
from koopmpc.models.shared.regression import Regression, build_predictor, build_regression

DELAYS = (4, 8, 12)  # numbers of past rows that are tried
ORDERS = (1, 2, 3, 4, 5, 6, 8)  # orders of the hidden state that are tried
_PRESENT = 1e-2  # weight of C z = y beside A z = s, which alone decides where A is invertible
_FAST = 0.98  # take the realisation with feedthrough if it lowers the error of one step below this share
_RESOLVED = 1e-10  # a direction of the past that explains less than this share of the forecasts is rounding error


def subspace(
    episodes: Episodes | Source,
    order: int | Sequence[int] = ORDERS,
    *,
    delays: int | Sequence[int] = DELAYS,
    **options: Unpack[ReadOptions],
) -> LinearPredictor:
    """Fit z⁺ = A z + B u + b, y = C z + c with a hidden state z = T ζ of least order, balanced, from outputs alone.

    ζ_k = [y_k, u_{k−1}, y_{k−1}, …] holds the past rows. One regression of y_{k+1} on ζ_k and u_k, the high-order ARX
    model, gives the forecasts of p further outputs without input, M ζ_k. Its singular value decomposition, weighted by
    the covariance of ζ and by the outputs' standard deviations, M Σ^½ = U S Vᵀ, gives the state s_k = S^{−½} Uᵀ M ζ_k:
    what of the past counts for the future. In it, the covariance of the state and the observability Gramian over p
    steps are both S. Least squares of s_{k+1} and y_{k+1} on [s_k, u_k] gives A, C and B; s = A z and C z ≈ y give z.

    All sums come from one pass over the data: the moments of ζ_k, u_k and ζ_{k+1} hold all block Hankel sums. The
    regression leaves future inputs out, so the fit is consistent under feedback. There, N4SID is biased.

    The result has the embedding Delay(p) and the lifting [T ζ, 1]: controllers, C code and files take it as any other
    linear model. `refine` improves it on forecasts of many steps.

    Parameters
    ----------
    episodes
        Records of one plant: outputs as states.
    order
        Order of the hidden state, or several to try.
    delays
        Number p of past rows, or several to try. Of several orders and numbers the smallest order within one standard
        error of the least error is taken: in free run and in short forecasts on the last quarter of each record,
        which a first fit does not see. All rows then fit the model.
    **options
        ``weights``, ``workers``, ``scheduler`` and ``progress`` of the last fit, as in `km.moments.second_moments`.

    Raises
    ------
    DataError
        The records are too short for the past rows; no output moves; a stream is read twice; there are measured
        disturbances.

    References
    ----------
    Jansson, "Subspace identification and ARX modeling", IFAC SYSID 2003; Chiuso, "The role of vector autoregressive
    modeling in predictor-based subspace identification", Automatica 43, 2007.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> u, y, hidden = np.random.default_rng(0).uniform(-1, 1, 400), np.zeros(401), 0.0
    >>> for k in range(400):
    ...     y[k + 1] = 0.7 * y[k] + 0.5 * hidden
    ...     hidden = 0.9 * hidden + u[k]
    >>> data = km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 0.1, ["y"], ["u"])
    >>> model = km.identify.subspace(data)
    >>> model.nz  # two hidden coordinates, and the constant
    3
    >>> model.eigenvalues.real.round(6).tolist()
    [1.0, 0.9, 0.7]
    """
    source = source_of(episodes)
    if source.disturbances:
        raise DataError("the data have measured disturbances, which subspace does not know; pass them as inputs")
    orders, pasts = check_list(order, 1), check_list(delays, 1)
    if len(orders) * len(pasts) > 1:
        orders, pasts = choose_sizes(source_episodes(source), orders, pasts)[:2]
    return build_realisation(compute_block_moments(source, pasts[0], **options), orders[0])


def compute_block_moments(source: Episodes | Source, delays: int, **options: Unpack[ReadOptions]) -> Moments:
    """Return the moments of [ζ_k, 1, u_k, ζ_{k+1}, 1], which hold all block Hankel sums of `delays` past rows."""
    whole = source_of(source)
    delay = Delay(delays).match(whole.states, whole.inputs)
    return second_moments(whole, State() + Constant(), embedding=delay, **options)


def build_realisation(total: Moments, order: int) -> LinearPredictor:
    """Return the model of this order on the moments of `compute_block_moments`; of less where the past tells less."""
    regression = build_regression(total, "subspace")
    rows, n, nx = regression.rows, regression.lifting.nz - 1, len(regression.states)
    centred = rows.subtract_means()
    zeta, ahead = centred.P[:, :n], centred.T[:, :n]
    size = np.sqrt((np.sum(ahead[:, :nx] ** 2, axis=0) + centred.rest[:nx]) / rows.samples)
    if not size.any():
        raise DataError("no output moves in these records, so nothing can be learned; pass a record in which they do")
    size = np.where(size > 0, size, 1.0)
    state = _find_state(regression, zeta, order, size)
    plain = _build_model(regression, _realise(regression, state, size))
    assert plain.report is not None, "it was fitted"
    if order > nx and not (plain.report.residual <= EXACT * size).all():
        fast = _build_model(regression, _realise_with_outputs(regression, state[: order - nx], size))
        assert fast.report is not None, "it was fitted"
        if np.prod(fast.report.residual / size) < _FAST**nx * np.prod(plain.report.residual / size):
            return fast
    return plain


class Realisation(NamedTuple):
    """z⁺ = A z + B u, y = C z and z = T ζ, all as deviations from the means."""

    A: Float[np.ndarray, "n n"]
    B: Float[np.ndarray, "n nu"]
    C: Float[np.ndarray, "nx n"]
    T: Float[np.ndarray, "n nzeta"]


def _fit_transition(regression: Regression, state: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "mny mnu"]:
    """Return K of [s⁺; y⁺] = K [s; u], s = S ζ."""
    centred, n, nx = regression.rows.subtract_means(), regression.lifting.nz - 1, len(regression.states)
    zeta, u, ahead = centred.P[:, :n], centred.P[:, n + 1 :], centred.T[:, :n]
    s, s_next = zeta @ state.T, ahead @ state.T
    return np.linalg.lstsq(np.hstack([s, u]), np.hstack([s_next, ahead[:, :nx]]), rcond=None)[0].T


def _realise(regression: Regression, state: Float[np.ndarray, "m n"], size: Float[np.ndarray, " nx"]) -> Realisation:
    """Return the realisation with s = A z: forecasts are s⁺ = A s + A B u and y⁺ = C s + C B u."""
    m, nx = len(state), len(size)
    K = _fit_transition(regression, state)
    A, C = K[:m, :m], K[m:, :m]
    both = np.vstack([A, C / size[:, None]])
    B = np.linalg.lstsq(both, np.vstack([K[:m, m:], K[m:, m:] / size[:, None]]), rcond=None)[0]
    weighed = np.vstack([A, _PRESENT * C / size[:, None]])
    present = _PRESENT * np.eye(nx, state.shape[1]) / size[:, None]
    T = np.linalg.lstsq(weighed, np.vstack([state, present]), rcond=None)[0]
    return Realisation(A, B, C, T)


def _realise_with_outputs(
    regression: Regression, state: Float[np.ndarray, "m n"], size: Float[np.ndarray, " nx"]
) -> Realisation:
    """Return the realisation z = [s; y]: y⁺ = C s + D u with any D, for inputs that act at once and leave no trace.

    There A of the other realisation is singular, and s = A z has lost what u does.
    """
    m, nx = len(state), len(size)
    K = _fit_transition(regression, state)
    A = np.hstack([K[:, :m], np.zeros((m + nx, nx))])
    return Realisation(A, K[:, m:], np.eye(nx, m + nx, m), np.vstack([state, np.eye(nx, state.shape[1])]))


def _find_state(
    regression: Regression, zeta: Float[np.ndarray, "m n"], order: int, size: Float[np.ndarray, " nx"]
) -> Float[np.ndarray, "order n"]:
    """Return the rows S^{−½} Uᵀ M of the balanced state that forecasts without input need."""
    assert regression.embedding is not None, "ζ holds the past"
    n, nx, nu, delays = zeta.shape[1], len(size), len(regression.inputs), regression.embedding.steps
    Phi = np.zeros((n, n))  # ζ⁺ = Φ ζ without input
    Phi[:nx] = solve(regression.rows).K[:n, :nx].T
    Phi[nx + nu :, : n - nx - nu] = np.eye(n - nx - nu)
    forecasts, ahead = list[np.ndarray](), np.eye(nx, n)
    for _ in range(delays):
        ahead = ahead @ Phi
        forecasts.append(ahead / size[:, None])
    M = np.vstack(forecasts)
    R = np.asarray(np.linalg.qr(zeta / np.sqrt(regression.rows.samples), mode="r"), dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        weighted = M @ R.T
    if not np.isfinite(weighted).all():
        raise DataError(f"the ARX model of {delays} past rows overflows within {delays} steps; pass fewer delays")
    U, S, _ = np.linalg.svd(weighted, full_matrices=False)
    count = min(order, int(np.sum(_RESOLVED * S.max(initial=0.0) < S)))
    if not count:
        raise DataError("nothing in the past rows tells the outputs that follow; pass a record in which they move")
    return (U[:, :count] / np.sqrt(S[:count])).T @ M


def _build_model(regression: Regression, found: Realisation) -> LinearPredictor:
    """Return the predictor on [T ζ, 1], and its report."""
    rows, n = regression.rows, regression.lifting.nz - 1
    A, B, C, T = found
    m, nu = B.shape
    ones = rows.P[:, n]
    mean = ones @ rows.P / (ones @ ones)
    z, u, y = T @ mean[:n], mean[n + 1 :], mean[: len(C)]
    z_next = T @ (ones @ rows.T[:, :n] / (ones @ ones))
    transition = np.block([[A, (z_next - A @ z - B @ u)[:, None]], [np.zeros((1, m)), np.ones((1, 1))]])
    output = np.hstack([C, (y - C @ z)[:, None]])
    Z = np.hstack([rows.P[:, :n] @ T.T, ones[:, None]])
    driven = np.vstack([B, np.zeros((1, nu))])

    gap = rows.P[:, : len(C)] - Z @ output.T
    norms = column_norms(Z)
    assert regression.embedding is not None
    lifting = (Projected(State(), np.ascontiguousarray(T.T)) + Constant()).bind(regression.embedding.names)
    realised = replace(
        regression,
        rows=RegressionRows(np.hstack([Z, rows.P[:, n + 1 :]]), rows.T, rows.rest, rows.samples),
        lifting=lifting,
        C=output,
        state_residual=np.sqrt(np.sum(gap**2, axis=0) / rows.samples),
    )
    return build_predictor(
        realised,
        np.vstack([transition.T, driven.T]),
        rule=f"a state of order {m} from {regression.embedding.steps} past rows",
        rank=m + 1 + nu,
        condition=float(np.linalg.cond(Z / np.where(norms > 0, norms, 1.0))),
    )


def choose_sizes(
    episodes: Episodes, orders: Sequence[int] = ORDERS, pasts: Sequence[int] = DELAYS
) -> tuple[list[int], list[int], Float[np.ndarray, " blocks"]]:
    """Return the smallest order, and its past rows, whose error on the last quarter is like the least; its errors."""
    (learned, spans), horizon = cut_quarter(episodes), find_forecast_horizon(episodes)
    tried: list[tuple[int, int, Float[np.ndarray, " blocks"]]] = []
    for delays in pasts:
        try:
            total = compute_block_moments(learned, delays)
            found = {order: build_realisation(total, order) for order in orders}
            tried += [(m, delays, measure_forecasts(one, episodes, spans, horizon)) for m, one in found.items()]
        except KoopmpcError:  # too short for so many past rows
            continue
    if not tried:
        raise DataError(f"the records are too short for {pasts[0]} past rows; pass fewer delays, or longer records")
    least = min(tried, key=lambda one: float(np.log(one[2]).mean()))[2]
    near = [one for one in tried if not is_worse(one[2], least)]
    order, delays, errors = min(near, key=lambda one: one[:2])
    return [order], [delays], errors
