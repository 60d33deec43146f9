"""Monitor: the region of a model's data and its errors there, to ask at each step whether the loop is inside both."""

import ctypes
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.base import InitialCondition
from koopmpc.control.nonlinear.learned_map import LearnedMap
from koopmpc.control.watching import StepMonitor, register_monitor
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.errors import DataError
from koopmpc.estimate.observer import StateModel
from koopmpc.lifting.base import Lifting, buffer_lifting
from koopmpc.plants.routines import find_compiler, find_private_cache, load_library
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.supervise.quick_look import CODE, FITS, INSIDE, QuickLook
from koopmpc.validate.scoring import embed_episodes, forecast_errors
from koopmpc.values import Viewing

_THIN = 1e-9  # share of the widest direction of the data below which a direction counts as this wide
_EXACT = 1e-9  # share of a state's size that a prediction may always be off


@dataclass(frozen=True, eq=False)
class Monitor(StepMonitor):
    """‖L [ψ(x); u]‖² ≤ 1 where the data were, and ‖W (x⁺ − x̂⁺)‖² ≤ 1 where the model predicts as it did there.

    ‖L v‖² is the leverage vᵀ (VᵀV)⁻¹ v of v = [ψ(x); u] over the rows V of the data, divided by its `level` quantile
    among them; ‖W e‖² is the squared one-step error in units of its covariance, divided by the conformal quantile of
    the same level. On new data like these a step is outside of either with a probability of about 1 − level. Make one
    by `Monitor.of`.

    Attributes
    ----------
    leverage
        (nz + nu, nz + nu) L.
    band
        (nx, nx) W.
    level
        Share of the data that is inside.
    lifting
        ψ, bound.
    """

    leverage: Float[np.ndarray, "n n"]
    band: Float[np.ndarray, "nx nx"]
    level: float
    lifting: Lifting

    @classmethod
    def of(cls, model: LinearPredictor | BilinearPredictor, data: Episodes, *, level: float = 0.99) -> "Monitor":
        """Return the monitor of a model and its data.

        Parameters
        ----------
        model
            The predictor of the controller.
        data
            The episodes that it was fitted to. Where the fit is close, pass held-out episodes: on its own data the
            errors are too small.
        level
            Share of these data that counts as known, in each of the two checks.

        Raises
        ------
        DataError
            The data are of another plant, or have fewer than 1 / (1 − level) rows; the level is not inside (0, 1).
        """
        level = checks.positive(level, "level")
        if level >= 1:
            raise DataError(f"level is {level:g}; it must lie between 0 and 1, 0.99 calls 1 % of the data unknown")
        points = embed_episodes(model, episodes_of(data), 1)
        V = np.concatenate([np.hstack([model.lifting(e.X[:-1]), e.U[:, : model.nu]]) for e in points])
        starts = [np.arange(len(e)) for e in points]
        E = np.concatenate([gap[0] for gap, _ in forecast_errors(model, points, starts, 1)])
        X = np.concatenate([e.X[:, : model.nx] for e in points])
        rank = int(np.ceil((len(V) + 1) * level - 1e-9))
        if rank > len(V):
            raise DataError(
                f"the data have {len(V)} rows, at least {int(np.ceil(level / (1 - level) - 1e-9))} are needed for a "
                f"level of {level:g}; pass more data, or a lower level"
            )
        return cls(_bounds(V, 0.0, V, rank), _bounds(E, _EXACT, X, rank), level, model.lifting)

    def watch(self, model: LinearPredictor | StateModel, latency: int) -> "Watch":
        """Return the watch of one closed loop, whose inputs act `latency` steps late."""
        return Watch(self, model, latency)


def _bounds(
    rows: Float[np.ndarray, "M n"], share: float, of: Float[np.ndarray, "K n"], rank: int
) -> Float[np.ndarray, "n n"]:
    """Return G with ‖G v‖² = 1 for the rank-th smallest of the rows, and ≤ 1 for this share of a column of `of`."""
    floor = share * np.sqrt((of**2).mean(axis=0))
    norm = np.sqrt((rows**2).mean(axis=0) + floor**2)
    norm = np.where(norm > 0, norm, 1.0)
    scaled = rows / norm
    values, Q = np.linalg.eigh(scaled.T @ scaled / len(rows) + np.diag((floor / norm) ** 2))
    G = (Q / np.sqrt(np.maximum(values, _THIN * values.max()))).T / norm  # mean ‖G v‖² = n
    bound = max(np.sort(((rows @ G.T) ** 2).sum(axis=1))[rank - 1], ((G * floor) ** 2).sum(axis=0).max())
    return G / np.sqrt(bound) if bound > 0 else G


def make_monitor(given: object, model: object) -> Monitor:
    """Return the monitor that a controller's argument ``monitor=`` stands for, made of the data where it is Episodes.

    Raises
    ------
    DataError
        The controller's model was not fitted to data, or the monitor is of another lifting.
    """
    if not isinstance(model, LinearPredictor | BilinearPredictor):
        raise DataError("a monitor compares with data, and this controller's model is not learned; leave out monitor=")
    monitor = Monitor.of(model, given) if isinstance(given, Episodes) else given
    checks.kind(monitor, "monitor", Monitor, "make one by km.supervise.Monitor.of(model, data), or pass the data")
    monitor = cast("Monitor", monitor)
    if monitor.lifting != model.lifting or len(monitor.leverage) != model.nz + model.nu:
        raise DataError("the monitor is of another lifting than the controller's model; make one of this model")
    return monitor


register_monitor(make_monitor)


@cache
def load_look() -> Callable[[ctypes.c_void_p], int] | None:
    """Return the machine code, compiled once for each user; None without a compiler."""
    try:
        command = find_compiler()
        if command is None:
            return None
        library = load_library(CODE, command, find_private_cache())
    except (OSError, subprocess.SubprocessError):
        return None
    # a call that keeps the interpreter's lock is faster
    return ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(("koopmpc_look", library))


class Watch(Viewing):
    """The monitor in one closed loop: whether the last step was `inside` the data, and whether the prediction `fits`.

    The state is compared with its prediction from the step before, with the input that the plant got, the measured
    disturbances and the estimated one.

    Parameters
    ----------
    monitor
        The region and the band.
    model
        The model that predicts.
    latency
        Steps until an input acts; the prediction that is compared is that of the plan's start.
    """

    _VIEWS = ("_halves", "_error", "_reach", "_quick", "_code")

    def __init__(self, monitor: Monitor, model: LinearPredictor | StateModel, latency: int) -> None:
        self.monitor, self._latency = monitor, latency
        self._n = len(monitor.leverage)
        self._nu = self._n - monitor.lifting.nz
        self._psi = None if isinstance(model, LinearPredictor) else buffer_lifting(monitor.lifting)
        self._lay_out(model, 0)
        self.reset()

    def _lay_out(self, model: LinearPredictor | StateModel, driven: int) -> None:
        """Make the rows [ψ(x); u; d] of two steps in turn, so that nothing is moved, with `driven` entries of d."""
        n, nx, width = self._n, len(self.monitor.band), self._n + driven
        self._rows, self._found = np.zeros(2 * width), np.zeros(nx + n)
        self._matrices = np.zeros((2, nx + n, 2 * width))  # of the steps at which the first and the second half is new
        self._quick: QuickLook | None = None
        self._last, self._begun = np.zeros(width), np.zeros(1, dtype=np.int64)
        self._matrices[0, nx:, :n] = self._matrices[1, nx:, width : width + n] = self.monitor.leverage
        self.update(model)
        self._see()

    def _see(self) -> None:
        """Make the views; see `Viewing`."""
        n, nx, width = self._n, len(self.monitor.band), len(self._rows) // 2
        nz = n - self._nu
        halves = [np.split(self._rows[low : low + width], [nz, n]) for low in (0, width)]
        self._halves = [(*halves[new], *halves[1 - new][:2], self._matrices[new]) for new in (0, 1)]
        self._error, self._reach = self._found[:nx], self._found[nx:]
        self._quick = None  # it points into the arrays of one loop, which the next step shows
        plain = isinstance(self._model, LinearPredictor) and not self._model.nw
        self._code = load_look() if plain else None  # here, for a compiler takes longer than a step

    def update(self, model: LinearPredictor | StateModel) -> None:
        """Compare with the predictions of another model from now on; region and band stay."""
        self._model, W = model, self.monitor.band
        if isinstance(model, LinearPredictor):
            nx, n, nz, width = len(W), self._n, model.nz, len(self._rows) // 2
            C = W @ model.C
            for new, low, last in ((0, 0, width), (1, width, 0)):  # where the step and the one before it are
                self._matrices[new, :nx, last : last + n] = np.hstack([C @ model.A, C @ model.B])
                self._matrices[new, :nx, low : low + nz] = -C
                if width > n:
                    self._matrices[new, :nx, last + n : last + width] = C
            self._pushed = C @ model.E
            if self._quick is not None:
                self._quick.update(*self._split_error(model, width > n))
        learned = model.model if isinstance(model, LearnedMap) and not model.scheduled else None
        self._gain: Float[np.ndarray, "nx m"] | None = None
        if isinstance(learned, BilinearPredictor):  # its C and its ψ give the prediction without a call of its map
            C = W @ learned.C
            self._gain = np.hstack([C @ learned.A, C @ learned.B, *(C @ N for N in learned.N)])
            self._lifted = np.zeros(self._gain.shape[1])
        self._extra: Float[np.ndarray, " nx"] | None = None

    def _split_error(
        self, model: LinearPredictor, driven: bool
    ) -> tuple[Float[np.ndarray, "nx width"], Float[np.ndarray, "nx nz"]]:
        """Return W C [A B I] of the step before, the last block where d is estimated, and W C of the step now."""
        C = self.monitor.band @ model.C
        return np.hstack([C @ model.A, C @ model.B, C][: 2 + driven]), C

    def reset(self) -> None:
        """Forget the step before: the first step of a run has no prediction to be compared with."""
        self._begun[:] = 0
        self._new, self._first, self._fast, self.inside, self.fits = 0, True, False, True, True
        self._rows[:] = 0.0
        self._extra = None
        self._old: tuple[np.ndarray, ...] | None = None

    def look(self, start: InitialCondition, u: Float[np.ndarray, " nu"], applied: ArrayLike | None) -> bool:
        """Return whether the step that starts here, with input u, is known."""
        quick = self._quick
        if quick is not None:
            if applied is not None and not self._latency:
                quick.acted[:] = applied
            quick.u[:] = u
            found = quick.look()
            self.inside, self.fits = found & INSIDE != 0, found & FITS != 0
            return self.inside and self.fits
        self._new = 1 - self._new
        z, now, d, before, acted, matrix = self._halves[self._new]
        if applied is not None and not self._latency:
            acted[:] = applied
        if self._fast:  # most steps: a linear model, no measured disturbance, and the state as foretold
            z[:] = start.z
            now[:] = u
            if d.size:
                d[:] = start.d
            found = self._found
            matrix.dot(self._rows, found)
            if found.dot(found) <= 1.0:  # both checks at once
                self.inside = self.fits = True
                return True
            reach, error = self._reach, self._error
            self.inside, self.fits = bool(reach.dot(reach) <= 1.0), bool(error.dot(error) <= 1.0)
            return self.inside and self.fits
        psi, extra = self._psi, self._extra
        if psi is None:
            if start.d.size != d.size:  # the first step of a loop with an estimator
                self._lay_out(self._model, start.d.size)
                z, now, d, before, acted, matrix = self._halves[self._new]
            model, code = self._model, self._code
            if code is not None and isinstance(model, LinearPredictor):
                error = self._split_error(model, start.d.size > 0)
                self._quick = QuickLook(code, self.monitor.leverage, *error, start.z, start.d, self._last, self._begun)
                return self.look(start, u, applied)
            z[:], d[:] = start.z, start.d
        else:
            psi.arguments[0][:] = start.z
            psi.evaluate()
            z[:] = psi.results[0]
        now[:] = u
        matrix.dot(self._rows, self._found)
        reach, error = self._reach, self._error
        self.inside = bool(reach.dot(reach) <= 1.0)
        if extra is not None and psi is None:
            error += extra
        self.fits = self._first or bool(error.dot(error) <= 1.0)
        if psi is not None and not self._first:
            self.fits = self._matches_prediction(start, before, acted)
        self._first, self._fast = False, psi is None and not start.W.size  # the second step is as all after it
        if psi is not None:
            self._keep_step(start)
        elif start.W.size:
            self._extra = self._pushed @ start.W[0]
        return self.inside and self.fits

    def _keep_step(self, start: InitialCondition) -> None:
        """Keep what predicts the next state by a nonlinear model."""
        model, drive = self._model, start.drive.size > 0
        w = start.W[0] if start.W.size else np.zeros(0)
        d = start.d if start.d.size else np.zeros(len(start.z))
        if self._gain is None:
            self._old = start.z.copy(), w.copy(), d.copy()
        elif drive and isinstance(model, LearnedMap):
            self._extra = self.monitor.band @ (model.E @ w + d)[: len(self.monitor.band)]

    def _matches_prediction(
        self, start: InitialCondition, before: Float[np.ndarray, " nz"], acted: Float[np.ndarray, " nu"]
    ) -> bool:
        """Return whether the state is the one that a nonlinear model predicted from the step before."""
        model, W, gain = self._model, self.monitor.band, self._gain
        if gain is not None:
            nz, nu, lifted = len(before), len(acted), self._lifted
            lifted[:nz], lifted[nz : nz + nu] = before, acted
            np.multiply(acted[:, None], before, out=lifted[nz + nu :].reshape(nu, nz))
            error = gain.dot(lifted)
            error -= W.dot(start.z[: len(W)])
            if self._extra is not None:
                error += self._extra
        elif self._old is None or isinstance(model, LinearPredictor):
            return True
        else:
            z, w, d = self._old
            error = W @ (model.advance(z, acted, w, d) - start.z)[: len(W)]
        return bool(error.dot(error) <= 1.0)
