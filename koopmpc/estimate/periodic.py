"""Periodic disturbances: their harmonics in the misfits of a model, learned in a run or found in logs."""

from typing import cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.special import fdtrc

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.estimate.observer import EstimatorProgram, Measured, StateModel
from koopmpc.models.predictors import LinearPredictor

PERIODS = 3.0  # harmonics are learned over the last so many periods
SHORTEST = 20.0  # and over at least so many steps
NO_CODE = "the estimator has a period, which the C code does not know; export one without a period"
_DENSITY = 8  # trial frequencies in each 1/T of the longest episode
_CHANCE = 1e-4  # a period is believed if noise shows as strong a line less often than this


def find_harmonics(period: float, dt: float, harmonics: int) -> Float[np.ndarray, " h"]:
    """Return the angles by which the harmonics of a period turn in a step [rad]: those below half a turn."""
    if period < 2 * dt * (1 - 1e-12):
        raise DataError(
            f"period is {period:g} s, less than two samples of {dt:g} s; pass a longer period, or sample faster"
        )
    turns = 2 * np.pi * dt / period * np.arange(1, harmonics + 1)
    return turns[turns <= np.pi * (1 + 1e-12)]


def make_regressor(turns: Float[np.ndarray, " h"], k: float) -> Float[np.ndarray, " n"]:
    """Return [1; cos k θ_1; sin k θ_1; …]."""
    return np.concatenate([[1.0], np.stack([np.cos(k * turns), np.sin(k * turns)], axis=1).ravel()])


class PeriodicObserver(Measured):
    """The observer of a `LiftedDisturbance` with a period: z = ψ(x) afresh, d_k = Θ [1; cos k θ_j; sin k θ_j].

    Recursive least squares of the misfits e = z − A z₋ − B u − E w with forgetting finds Θ. It starts as if one row of
    zeros had been seen, so that the first rows are not believed too much. The Constant and the past of a state have no
    disturbances.
    """

    _remembers = True

    def __init__(self, model: LinearPredictor | StateModel, turns: Float[np.ndarray, " h"]) -> None:
        super().__init__(model)
        self._turns, self._unknown = turns, np.where(self._known, 0.0, 1.0)
        self._forget = float(np.exp(-1 / max(PERIODS * 2 * np.pi / turns[0], SHORTEST)))
        self.reset()

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget the last state, the harmonics and the phase; x0 will come as the first measurement."""
        super().reset(x0)
        n = 1 + 2 * len(self._turns)
        self._theta: Float[np.ndarray, "n nz"] = np.zeros((n, self._model.nz))
        self._P: Float[np.ndarray, "n n"] = np.eye(n)
        self._k: int = 0
        self._stood_in = False

    def program(self) -> EstimatorProgram:
        """Raise the DataError that says why no C code can be generated."""
        raise DataError(NO_CODE)

    def forecast(self, steps: int) -> Float[np.ndarray, "steps nz"]:
        """Return the periodic part of d in the steps from now on; `d` is the constant part."""
        rows = np.stack([make_regressor(self._turns, self._k - 1 + i) for i in range(steps)])
        return rows[:, 1:] @ self._theta[1:]

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y, and learn from the misfit of the step that led here."""
        phi, known = make_regressor(self._turns, self._k - 1), self._known_z
        self.d[:] = phi @ self._theta
        super().observe(y, u, w)
        gate = self._gate
        assert gate is not None, "it remembers readings"
        if gate.lost:
            self._theta[:], self._P, known = 0.0, np.eye(len(self._P)), False
        gap = self._unknown * (self.z - self._expected)
        if known and not (gate.refused or self._stood_in or gate.opened) and gap.dot(gap) < HUGE**2:  # False for NaN
            self._learn(phi, gap)
        self._stood_in = gate.refused or self._bridged > 0  # the next reading is judged all the same
        self._k += 1
        self.d[:] = self._theta[0]
        return True

    def _learn(self, phi: Float[np.ndarray, " n"], gap: Float[np.ndarray, " nz"]) -> None:
        Pphi = self._P @ phi
        gain = Pphi / (self._forget + phi @ Pphi)
        self._theta += np.outer(gain, gap)
        P = (self._P - np.outer(gain, Pphi)) / self._forget
        self._P = 0.5 * (P + P.T)


def find_period(model: LinearPredictor, episodes: Episodes) -> float:
    """Return the period [s] of the strongest line in the one-step misfits x_{k+1} − C (A ψ(x_k) + B u_k + E w_k).

    Sinusoids of a grid of frequencies are fitted to the misfits of each episode by least squares, with a phase of its
    own, in units of the misfits' standard deviations. The grid ends at two samples and at the longest episode; the
    best one is refined between its neighbours. Errors do not repeat in white noise: a line is believed if it would
    occur there with a probability below 1e-4.

    Parameters
    ----------
    model
        A linear predictor without delays.
    episodes
        Logs, the longer the better: a period is resolved to about 1/(periods seen) of itself.

    Raises
    ------
    DataError
        No episode is long enough, the model has delays, or no line stands out.

    References
    ----------
    Lomb, "Least-squares frequency analysis of unequally spaced data", Astrophys. Space Sci. 39, 1976.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> model = km.LinearPredictor([[0.9]], [[0.2]], np.eye(1), km.State().bind(("x",)), 0.5, ("x",), ("u",))
    >>> rng, x = np.random.default_rng(0), [np.zeros(1)]
    >>> U = rng.standard_normal((400, 1))
    >>> for k, u in enumerate(U):
    ...     x.append(0.9 * x[-1] + 0.2 * u + 0.1 * np.sin(2 * np.pi * k * 0.5 / 12.3))
    >>> logs = km.Episodes([km.Episode(X=np.array(x), U=U)], dt=0.5, states=["x"], inputs=["u"])
    >>> round(km.estimate.find_period(model, logs), 2)
    12.3
    """
    checks.kind(model, "model", LinearPredictor, "fit one with km.edmd")
    data = episodes_of(episodes)
    if model.embedding is not None:
        raise DataError(
            "the model has delays; find the period with a model without them, such as km.edmd(data, State())"
        )
    misfits: list[np.ndarray] = []
    for e in data:
        z = np.asarray(model.lifting(e.X[:-1]))
        misfits.append(e.X[1:] - (z @ model.A.T + e.U @ model.B.T + e.W @ model.E.T) @ model.C.T)
    spread = np.concatenate([row - row.mean(axis=0) for row in misfits]).std(axis=0)
    longest = max(map(len, misfits))
    if longest < 8:
        raise DataError(f"the longest episode has {longest} steps; a period needs 8 or more")
    if not (spread > 0).any():
        raise DataError("the model fits these episodes exactly, so that no disturbance is left")
    rows = [((row - row.mean(axis=0)) / np.where(spread > 0, spread, 1.0))[:, spread > 0] for row in misfits]
    total = sum(float((row**2).sum()) for row in rows)

    def explain(turn: float) -> float:
        """Return the share of the misfits' squares that sinusoids of this angle a step explain."""
        explained = 0.0
        for row in rows:
            k = np.arange(len(row))
            basis = np.linalg.qr(np.stack([np.ones(len(k)), np.cos(turn * k), np.sin(turn * k)], axis=1))[0]
            explained += float(((basis.T @ row) ** 2).sum())
        return explained / total

    from scipy.optimize import minimize_scalar  # slow to import

    grid = 2 * np.pi * np.arange(_DENSITY, _DENSITY * longest // 2 + 1) / (_DENSITY * longest)
    values = np.array([explain(turn) for turn in grid])
    best, step = int(values.argmax()), grid[1] - grid[0]
    found = minimize_scalar(
        lambda turn: -explain(turn), bounds=(grid[best] - step, grid[best] + step), method="bounded",
        options={"xatol": 1e-9},
    )  # fmt: skip
    turn = float(np.real(cast("float", found.x)))
    count, free = sum(row.size for row in rows), 2 * sum(row.shape[1] for row in rows)
    share = explain(turn)
    chance = (
        len(grid)
        / _DENSITY
        * float(fdtrc(free, count - free, share / free * (count - free) / (1 - min(share, 1 - 1e-12))))
    )
    if chance > _CHANCE:
        raise DataError(
            f"no period stands out: the strongest line, of {2 * np.pi / turn * model.dt:.3g} s, explains {share:.1%} of"
            " the misfits, as noise may; pass longer logs, or give the period"
        )
    return 2 * np.pi / turn * model.dt
