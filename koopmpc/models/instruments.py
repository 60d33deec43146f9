"""Identification under feedback: regression with the set point as instrument, for logs whose measurements are noisy."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.lifting.base import Lifting
from koopmpc.models.moments.read import second_moments
from koopmpc.models.moments.solve import (
    RegressionRows,
    column_norms,
    orthonormal_basis,
    rounding_cutoff,
    scale_to_unit_norm,
    scaled_rank,
    solve,
)
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.shared.regression import build_predictor, build_regression

WEAK = 10.0  # warn below this F of the first stage: the estimate leans towards least squares (Staiger & Stock 1997)
CHANCE = 2.0  # refuse below this F: instruments that have no effect on the plant reach about 1


def instrumental_edmd(
    episodes: Episodes,
    lifting: Lifting,
    instruments: Sequence[ArrayLike],
    *,
    lags: int = 12,
    level: float | None = None,
) -> LinearPredictor:
    """Fit z⁺ = A z + B u by two-stage least squares, with the set point of a closed loop as instrument.

    Under feedback, noise of the measurement enters both the regressors p = [ψ(x) u] and ψ(x⁺), and least squares is
    biased. The first stage regresses p on q = [r_k … r_{k−lags+1}], the second ψ(x⁺) on the result:
    K = (PᵀΠP)⁻¹ PᵀΠ T with Π = Q (QᵀQ)⁻¹Qᵀ. A Constant in ψ and measured disturbances count among q. Both stages are
    solved on the moments of [p q ψ(x⁺)]. The estimate is consistent if ψ is affine in x and r does not depend on the
    noise. Its variance is larger than that of `edmd`: with a measured state and process noise alone use `edmd`.

    Parameters
    ----------
    episodes
        Logs of the closed loop, with inputs.
    lifting
        ψ; ``km.State() + km.Constant()`` for x⁺ = A x + B u + c.
    instruments
        Set point or added test signal of each episode, in its order: (T, nr) or (T + 1, nr), where row k acts on u_k.
    lags
        Rows of the set point in q; the first lags − 1 steps of each episode are left out.
    level
        Return least squares unless the test of Hausman finds it biased at this level, 0.01 say; by default never.

    Raises
    ------
    DataError
        The data have no inputs, an episode is shorter than `lags`, or the instruments do not move the loop enough
        to separate A from B: the set point is constant and no test signal is added.
    ShapeError
        `instruments` does not have one array an episode, of one row a step.

    Warns
    -----
    FitWarning
        The instruments are weak: F of the first stage is below 10.

    References
    ----------
    Söderström & Stoica, "Instrumental variable methods for system identification", Springer 1983; Van den Hof &
    Schrama, "An indirect method for transfer function estimation from closed loop data", Automatica 29, 1993;
    Staiger & Stock, "Instrumental variables regression with weak instruments", Econometrica 65, 1997;
    Hausman, "Specification tests in econometrics", Econometrica 46, 1978.
    """
    episodes = episodes_of(episodes)
    if not episodes.nu:
        raise DataError("the episodes have no inputs; fit them with edmd")
    lags = checks.count(lags, "lags")
    later, joined = _attach_lagged_rows(episodes, instruments, lags)
    plain = second_moments(later.driven(), lifting, route="qr")
    regression = build_regression(plain, "instrumental_edmd", disturbances=later.disturbances)
    total = second_moments(joined.driven(), lifting, route="qr")
    nz, columns = regression.lifting.nz, total.columns
    regressors = columns.regressors[: regression.columns]
    constant = regression.lifting.constant_index
    known = [columns.regressors[nz + episodes.nu :], np.array([] if constant is None else [constant], dtype=np.intp)]
    stage = total.rows(np.concatenate(known), np.concatenate([regressors, columns.targets[:nz]]))
    basis = orthonormal_basis(scale_to_unit_norm(stage.P), rounding_cutoff(stage))
    both = basis.T @ stage.T  # coordinates of Π [P T]
    explained, target = both[:, : len(regressors)], both[:, len(regressors) :]
    strength = _measure_strength(regression.rows, explained)
    if strength < CHANCE:
        raise DataError(
            "not identifiable from these logs: the instruments move the regressors no more than chance would (F of the "
            f"first stage is {strength:.2g}, at least {CHANCE:.0f} expected); move the set point, or add a test signal "
            "to u"
        )
    weak = (
        f"the instruments are weak (F of the first stage is {strength:.2g}, {WEAK:.0f} expected); move the set point "
        "more, or log longer"
    )
    size = column_norms(explained)
    K = np.linalg.lstsq(explained / size, target)[0] / size[:, None]
    if level is not None:
        plain_fit = solve(regression.rows.keep_targets(nz)).K
        chance = _compare(regression.rows, explained, K - plain_fit, plain_fit)
        if chance > checks.positive(level, "level"):
            rule = f"least squares, not found biased by the instruments (chance {chance:.2g})"
            return build_predictor(regression, plain_fit, rule=rule)
    return build_predictor(
        regression,
        K,
        rule=f"two-stage least squares, {lags} lags of the instruments, F = {strength:.3g}",
        doubts=(weak,) if strength < WEAK else (),
    )


def check_instruments(episodes: Episodes, instruments: Sequence[ArrayLike]) -> list[Float[np.ndarray, "rows nr"]]:
    """Return the signals with T + 1 rows each, the last one repeated where it is missing."""
    checks.members(instruments, "instruments", ("__len__", "__iter__"), "pass one array an episode")
    if len(instruments) != len(episodes):
        raise ShapeError(f"instruments has {len(instruments)} arrays for {len(episodes)} episodes; pass one an episode")
    found: list[np.ndarray] = []
    for i, (e, signal) in enumerate(zip(episodes, instruments, strict=True)):
        R = checks.array(signal, f"instruments[{i}]", (None, None))
        if len(R) not in (len(e), len(e) + 1):
            raise ShapeError(
                f"instruments[{i}] has {len(R)} rows for {len(e)} steps; pass one a step, row k beside u_k"
            )
        found.append(R if len(R) == len(e) + 1 else np.vstack([R, R[-1:]]))
    return found


def _attach_lagged_rows(episodes: Episodes, instruments: Sequence[ArrayLike], lags: int) -> tuple[Episodes, Episodes]:
    """Return the episodes without their first lags − 1 steps, and the same with lagged instruments beside W."""
    later: list[Episode] = []
    joined: list[Episode] = []
    for i, (e, R) in enumerate(zip(episodes, check_instruments(episodes, instruments), strict=True)):
        if len(e) < lags:
            raise DataError(
                f"episode {i} has {len(e)} steps, fewer than lags = {lags}; pass fewer lags, or longer logs"
            )
        cut = e.cut(lags - 1, len(e))
        past = [R[lags - 1 - lag : len(e) - lag] for lag in range(lags)]
        later.append(cut)
        joined.append(Episode(X=cut.X, U=cut.U, W=np.hstack([cut.W, *past])))
    return episodes.with_episodes(later), Episodes(joined, episodes.dt, episodes.states, episodes.inputs)


def _measure_strength(rows: RegressionRows, explained: Float[np.ndarray, "q n"]) -> float:
    """Return F of the regressors' direction that the instruments explain least; 0 where they cannot explain it.

    F = ρ²/(1 − ρ²) · (M − q)/q with ρ the smallest canonical correlation of regressors and instruments.
    """
    rank, n = explained.shape
    if scaled_rank(rows, rows.P)[0] < n or rank < n:
        return 0.0
    size = column_norms(rows.P)
    root = np.asarray(np.linalg.qr(rows.P / size, mode="r"), dtype=np.float64)
    rho = np.linalg.svd(np.linalg.solve(root.T, np.transpose(explained / size)), compute_uv=False)[-1]
    share = min(float(rho) ** 2, 1.0)
    return np.inf if share == 1.0 else share / (1 - share) * max(rows.samples - rank, 1) / rank


def _compare(
    rows: RegressionRows,
    explained: Float[np.ndarray, "q n"],
    difference: Float[np.ndarray, "n nz"],
    K: Float[np.ndarray, "n nz"],
) -> float:
    """Return the chance of so large a difference from least squares K if K has no bias (Hausman 1978).

    dᵀ((PᵀΠP)⁻¹ − (PᵀP)⁻¹)⁺d / σ² is χ² with n degrees of freedom; the least of all targets, times their number.
    """
    size = column_norms(rows.P)
    inner, outer = explained / size, rows.P / size
    spread = np.linalg.inv(inner.T @ inner) - np.linalg.inv(outer.T @ outer)
    noise = rows.residual(np.arange(len(K.T)), K) ** 2
    d = difference * size[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.sum(d * (np.linalg.pinv(spread, rcond=1e-10) @ d), axis=0) / noise
    chances = np.asarray(chdtrc(len(K), np.nan_to_num(value)), dtype=np.float64)
    return min(1.0, len(K.T) * float(np.min(chances)))
