"""LiftedKalman: a Kalman filter on [z; d], from some measured observables, which may be late or missing at times.

This file finds its matrices; `KalmanFilter` filters with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import exp, log
from typing import Literal, cast

import numpy as np
import scipy.linalg
from jaxtyping import Complex, Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ObservableError, ShapeError
from koopmpc.base.values import Value
from koopmpc.estimate.disturbance import GAIN
from koopmpc.estimate.filter import Augmented, FilterModel, KalmanFilter, PeriodicFilter, find_kalman_gain
from koopmpc.estimate.observer import StateModel
from koopmpc.estimate.periodic import find_harmonics
from koopmpc.lifting.base import Lifting, strip_unit
from koopmpc.models.predictors import LinearPredictor

PROCESS = 1e-4  # default variance of the process noise, in the model's units
NOISE = 1e-4  # default variance of the measurement noise, in the model's units
DRIFTS = 10.0 ** np.arange(
    -8.0, 1.0
)  # candidate variances of d's random walk; the smallest one that settles in time is used
SLOWEST = -1 / log(1 - GAIN)  # steps that d takes to settle, at most: those of a mean of this gain
LEAST = 1e-8  # variance of the noise if a fit leaves no residual
NOT_TOGETHER = "feedthrough and measured disturbances do not go together; fit the model without W"
TOLERANCE = 1e-6  # singular values below this share of the largest, or of |λ|; |λ| as near to 1 does not die out


UnseenMode = tuple[complex, Complex[np.ndarray, " n"]]
"""A mode that y does not show: λ, and its direction s, of length 1."""


def find_unseen_mode(F: Float[np.ndarray, "n n"], M: Float[np.ndarray, "ny n"]) -> UnseenMode | None:
    """Return a mode with |λ| ≥ 1 for which [F − λ I; M] has less than full rank; None where (F, M) is detectable.

    For F = [A, B_d; 0, I] and M = [C, C_d], λ = 1 is the rank condition on [A − I, B_d; C, C_d]. Rows of M are
    scaled to length 1, so that units of y do not decide.

    References
    ----------
    Pannocchia & Rawlings, "Disturbance models for offset-free model-predictive control", AIChE Journal 49, 2003.
    """
    scaled = M / np.maximum(np.linalg.norm(M, axis=1, keepdims=True), 1e-300)
    for value in np.linalg.eigvals(F):
        if abs(value) < 1 - TOLERANCE:
            continue
        sigma, right = np.linalg.svd(np.vstack([F - value * np.eye(len(F)), scaled]))[1:]
        if sigma[-1] < TOLERANCE * max(sigma[0], abs(value)):
            return complex(value), np.conj(np.asarray(right[-1], complex))
    return None


@dataclass(frozen=True, eq=False)
class LiftedKalman(Value):
    """Stationary Kalman filter on s = [z; d]: z⁺ = A z + B u + E w + B_d d, d⁺ = d, y = H z + C_d d.

    z is never lifted afresh. There is one disturbance for each measurement, so that at rest the filter explains y
    exactly. The loop has no offset if all tracked outputs are measured, and if there are no more of them than inputs.
    The Constant is known, and not estimated. A state's reading at a rail of its sensor, which the model's `Delay` has,
    corrects nothing where the prediction lies at it or beyond. A y that is far from its prediction is refused, for at
    most six steps in sequence: the filter only predicts.

    Parameters
    ----------
    outputs
        The entries of y: names of observables, with or without unit, or a matrix H (ny, nz).
    disturbance
        "input": the first nu outputs are explained by disturbances of the inputs (B_d = B), each further one by
        an offset of its own. "output": every output has an offset of its own (C_d = I); not for a plant that
        integrates, or is unstable with an observable that drifts: those offsets cannot be told from its motion.
    process, drift, noise
        Covariances of a step of z (without the Constant), of a step of d, and of y; a scalar or a vector is a
        diagonal. Only their ratios matter. More `drift` learns disturbances faster, more `noise` trusts y less, and
        much `process` gives misfits to slow modes of z, which then return slowly. By default `process` and `noise`
        are standard deviations of 0.01, in units of the model: of the root mean squares of its lifted data, a
        disturbance of an input in that which moves z by as much in one step. An output that is a state of a fitted
        model has the noise of the fit's residuals. A model that was given has units of one. The default `drift` is the
        least, up to a standard deviation of 1, with which the error of d falls to exp(−4), 2 %, within the horizon, and
        within the 38 steps of a mean with gain 0.1: a faster filter would take more noise and more of what the
        model misses in a transient for disturbances.
    delay
        y is `delay` steps old; what followed is predicted from the inputs that acted since.
    period, harmonics
        Of disturbances that repeat themselves [s], as in `LiftedDisturbance`: each is a constant and harmonics.
    patience
        How many samples in a row without any measurement are bridged by prediction; after them the state is unknown.
    feedthrough
        The plant has y = h(x, u), and the model is one of log rows y_k = h(x_k, u_k), whose inputs were moved one row
        up (`input_lead` 1). A controller reads y before it chooses u_k, so the reading is h(x_k, u_{k−1}), which is
        H (A z + B u_{k−1}) + C_d d. A plan then weighs and limits h(x_k, u_k) first, and row k + 1 of a moving
        reference belongs to it. Where y are the states, a run whose x0 is not given begins at rest at its first
        reading. Not with `period`.

    Raises
    ------
    DataError
        A setting is out of range; when a controller is built, the disturbance is not detectable.
    ObservableError
        When a controller is built, the lifting lacks an output.

    References
    ----------
    Pannocchia & Rawlings, "Disturbance models for offset-free model-predictive control", AIChE Journal 49, 2003;
    Maeder, Borrelli & Morari, "Linear offset-free model predictive control", Automatica 45, 2009.
    """

    outputs: str | Sequence[str] | ArrayLike
    disturbance: Literal["input", "output"] = "input"
    process: ArrayLike | None = None
    drift: ArrayLike | None = None
    noise: ArrayLike | None = None
    delay: int = 0
    patience: int = 10
    period: float | None = None
    harmonics: int = 3
    feedthrough: bool = False

    def __post_init__(self) -> None:
        given = self.outputs
        if isinstance(given, str):
            object.__setattr__(self, "outputs", (given,))
        elif isinstance(given, Sequence) and given and all(isinstance(name, str) for name in given):
            object.__setattr__(self, "outputs", tuple(given))
        else:
            object.__setattr__(self, "outputs", checks.array(cast("ArrayLike", given), "outputs", (None, None)))
        if not checks.among(self.disturbance, ("input", "output")):
            raise DataError(f'disturbance is {self.disturbance!r}; pass "input" or "output"')
        for name in ("process", "drift", "noise"):
            if getattr(self, name) is None:
                continue
            stored = checks.array(getattr(self, name), name)
            checks.weight(stored, name, definite=True)
            object.__setattr__(self, name, stored)
        checks.count(self.delay, "delay", 0)
        checks.count(self.patience, "patience", 0)
        checks.count(self.harmonics, "harmonics")
        if self.period is not None:
            checks.positive(self.period, "period", "s")
        checks.kind(self.feedthrough, "feedthrough", (bool, np.bool_), "pass True or False")
        if self.feedthrough and self.period is not None:
            raise DataError("feedthrough and a period do not go together; leave one of them out")

    def start(self, model: LinearPredictor | StateModel, horizon: int) -> KalmanFilter:
        """Return the observer of one controller with plans of this many steps.

        Raises
        ------
        DataError
            The model is no linear predictor; or the disturbance, or the state, is not detectable from the outputs.
        ObservableError, ShapeError
            The lifting lacks an output; H has another width than z.
        """
        if not isinstance(model, LinearPredictor):
            raise DataError(
                "LiftedKalman filters the lifted state of a linear predictor, and this controller plans in the state "
                "itself; pass a LiftedDisturbance"
            )
        kind = KalmanFilter if self.period is None else PeriodicFilter
        return kind(partial(self._model, min(horizon / 4, SLOWEST)), model, self.delay, self.patience)

    def _model(self, settling: float, predictor: LinearPredictor) -> FilterModel:
        """Return the filter's matrices for a predictor, or say why there are none; `settling` in steps."""
        nz, nu = predictor.nz, predictor.nu
        if self.feedthrough and predictor.nw:
            raise DataError(NOT_TOGETHER)
        H = self._matrix(predictor)
        ny, constant = len(H), predictor.lifting.constant_index
        kept = np.array([i for i in range(nz) if i != constant], dtype=np.intp)
        if np.linalg.matrix_rank(H[:, kept]) < ny:
            raise DataError("outputs depend on each other (or on the Constant alone); name each one once")
        if self.disturbance == "output":
            Bd, Cd = np.zeros((nz, ny)), np.eye(ny)
        elif ny < nu:
            raise DataError(
                f"{ny} outputs cannot tell the disturbances of {nu} inputs apart; measure at least {nu}, or use "
                'disturbance="output"'
            )
        else:
            Bd, Cd = np.hstack([predictor.B, np.zeros((nz, ny - nu))]), np.eye(ny, ny)
            Cd[:nu] = 0.0
        model = Augmented(predictor, kept, H, Bd, Cd)
        if self.feedthrough:
            model.read_before()
        unit, y_unit = _sizes(predictor, kept, H, Cd)
        size, y_size = (unit, y_unit) if predictor.scale is not None else _balance(model.F, model.M, len(kept))
        F, M = model.F * size / size[:, None], model.M * size / y_size[:, None]
        lost = find_unseen_mode(F, M)
        if lost is not None:
            raise DataError(self._words(predictor, model, lost))
        n, units = len(kept), np.outer(size, size)
        process = (
            PROCESS * np.diag(unit[:n] ** 2) if self.process is None else checks.weight(self.process, "process", n)
        )
        R = np.diag(_noise(predictor, H, y_unit)) if self.noise is None else checks.weight(self.noise, "noise", ny)
        process, R_scaled = process / units[:n, :n], R / np.outer(y_size, y_size)
        if self.drift is None:
            drift = np.diag(_settling(F, M, process, R_scaled, settling))
        else:
            drift = checks.weight(self.drift, "drift", ny) / units[n:, n:]
        if self.period is not None:
            turns = find_harmonics(self.period, predictor.dt, self.harmonics)
            model = Augmented(predictor, kept, H, Bd, Cd, turns)
            own = np.concatenate([size[:n], np.tile(size[n:], 1 + 2 * len(turns))])
            F, M, units = model.F * own / own[:, None], model.M * own / y_size[:, None], np.outer(own, own)
            lost = find_unseen_mode(F, M)
            if lost is not None:
                raise DataError(
                    f"a disturbance of period {self.period:g} s cannot be told from a mode of the model at the same"
                    " frequency; measure more, or pass another period or fewer harmonics"
                )
            drift = np.kron(np.eye(1 + 2 * len(turns)), drift)
        P = _stationary(F, M, scipy.linalg.block_diag(process, drift), R_scaled) * units
        if self.feedthrough:
            model.hold_input()
            P = scipy.linalg.block_diag(P, np.zeros((nu, nu)))
        return model, P, R

    def _matrix(self, predictor: LinearPredictor) -> Float[np.ndarray, "ny nz"]:
        if isinstance(self.outputs, tuple):
            return np.eye(predictor.nz)[_places(predictor.lifting, cast("tuple[str, ...]", self.outputs))]
        H = cast("Float[np.ndarray, 'ny nz']", self.outputs)
        if H.shape[1] != predictor.nz or not len(H):
            raise ShapeError(f"outputs has shape {H.shape}, expected (ny, {predictor.nz}), one column an observable")
        return H

    def _words(self, predictor: LinearPredictor, model: Augmented, lost: UnseenMode) -> str:
        """Return the message on a mode that y does not show, and what to do."""
        ny, nu = len(model.M), predictor.nu
        names = predictor.lifting.names
        labels = [f"{names[int(i)]!r}" for i in model.kept]
        outputs = self.outputs if isinstance(self.outputs, tuple) else tuple(f"row {i}" for i in range(ny))
        first = 0 if self.disturbance == "output" else nu
        labels += [f"a disturbance of input {name!r}" for name in predictor.inputs[:first]]
        labels += [f"an offset of output {name!r}" for name in outputs[first:]]
        value, direction = lost
        size = np.abs(direction)
        largest = [int(i) for i in np.argsort(-size, kind="stable")[:4] if size[i] > 0.1 * size.max()]
        moved = ", ".join(labels[i] for i in largest)
        other = "input" if self.disturbance == "output" else "output"
        written = f"{value.real:.4g}" if value.imag == 0 else f"{value:.4g}"
        return (
            f"not detectable from {', '.join(str(name) for name in outputs)}: with λ = {written}, {moved} can move "
            f"without a trace in y; measure one of them, drop it from the lifting, or use disturbance={other!r}"
        )


def _sizes(
    predictor: LinearPredictor,
    kept: Int[np.ndarray, " n"],
    H: Float[np.ndarray, "ny nz"],
    Cd: Float[np.ndarray, "ny nd"],
) -> tuple[Float[np.ndarray, " nzd"], Float[np.ndarray, " ny"]]:
    """Return the units of [z; d] and of y: root mean squares of the data that a model was fitted to, or ones."""
    ny = len(H)
    if predictor.scale is None:
        return np.ones(len(kept) + ny), np.ones(ny)
    z = np.linalg.norm(predictor.scale, axis=0)[kept]
    y = np.linalg.norm(predictor.scale @ H.T, axis=0)
    d = y.copy()  # an offset has the unit of its output
    for i in np.flatnonzero(~Cd.any(axis=0)):
        moved = float(np.linalg.norm(predictor.B[kept, i] / z))
        d[i] = 1.0 / moved if moved > 0 else 1.0
    return np.concatenate([z, d]), y


def _balance(
    F: Float[np.ndarray, "n n"], M: Float[np.ndarray, "ny n"], nz: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " ny"]]:
    """Return units of [z; d] and of y in which a given model's rows and columns are alike, so that ranks are clear."""
    z = np.asarray(scipy.linalg.matrix_balance(F[:nz, :nz], permute=False, separate=True)[1][0])
    y = np.linalg.norm(M[:, :nz] * z, axis=1)
    pushed = np.linalg.norm(F[:nz, nz:] / z[:, None], axis=0)  # an offset of y pushes no z, and has the unit of y
    offset = np.where(np.abs(M[:, nz:]) > 0, y[:, None], 0.0).max(axis=0)
    d = np.where(pushed > 0, 1.0 / np.where(pushed > 0, pushed, 1.0), np.where(offset > 0, offset, 1.0))
    return np.concatenate([z, d]), y


def _noise(
    predictor: LinearPredictor, H: Float[np.ndarray, "ny nz"], size: Float[np.ndarray, " ny"]
) -> Float[np.ndarray, " ny"]:
    """Return the variances of y: the fit's residuals where an output is a state, else a share of its size."""
    variance = NOISE * size**2
    if predictor.report is not None and predictor.scale is not None:
        residual = predictor.report.residual
        for i, row in enumerate(H):
            found = np.flatnonzero((row == predictor.C).all(axis=1))
            if len(found):
                variance[i] = max(float(residual[found[0]]) ** 2, LEAST * size[i] ** 2)
    return variance


def _settling(
    F: Float[np.ndarray, "n n"],
    M: Float[np.ndarray, "ny n"],
    process: Float[np.ndarray, "nz nz"],
    R: Float[np.ndarray, "ny ny"],
    steps: float,
) -> Float[np.ndarray, " nd"]:
    """Return the least drift of each d with which its error falls to exp(−4) in four times so many steps.

    In the filters that are tried all of d has the same drift. Where none is enough, the drift is taken with which the
    error falls most.
    """
    nz, nd, whole = len(process), len(F) - len(process), int(np.ceil(4 * steps))
    left = np.empty((len(DRIFTS), nd))
    known, drifting = np.zeros_like(F), np.diag(np.repeat([0.0, 1.0], [nz, nd]))
    known[:nz, :nz] = process
    for row, drift in zip(left, DRIFTS, strict=True):
        P = _stationary(F, M, known + drift * drifting, R)
        K = find_kalman_gain(P, M, R)
        row[:] = np.abs(np.linalg.matrix_power(F - F @ K @ M, whole).diagonal()[nz:])
    enough = left <= exp(-whole / steps)
    return DRIFTS[np.where(enough.any(axis=0), enough.argmax(axis=0), left.argmin(axis=0))]


def _stationary(
    F: Float[np.ndarray, "n n"],
    M: Float[np.ndarray, "ny n"],
    Q: Float[np.ndarray, "n n"],
    R: Float[np.ndarray, "ny ny"],
) -> Float[np.ndarray, "n n"]:
    """Return P = F (P − P Mᵀ(M P Mᵀ + R)⁻¹ M P) Fᵀ + Q, the covariance before a measurement."""
    try:
        P = np.asarray(scipy.linalg.solve_discrete_are(F.T, M.T, Q, R))
    except ValueError as error:  # SciPy's own where the pencil is too far from triangular, and LinAlgError
        raise DataError(
            f"no stationary filter was found ({error}); the disturbance is hardly detectable: measure more, or drop "
            "observables"
        ) from error
    return 0.5 * (P + P.T)


def _places(lifting: Lifting, names: tuple[str, ...]) -> list[int]:
    """Return the indices of observables by name, with or without the unit."""
    place = {strip_unit(name): i for i, name in enumerate(lifting.names)}
    place |= {name: i for i, name in enumerate(lifting.names)}
    for name in names:
        if name not in place:
            raise ObservableError(
                f"the lifting lacks {name!r}; add it to the lifting: it holds {', '.join(lifting.names)}"
            )
    return [place[name] for name in names]
