"""OnlineEDMD, a recursive EDMD that learns while the plant runs, and the gate that keeps outliers from it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.lifting.base import Lifting, buffer_lifting, check_lifting
from koopmpc.models.fits.outliers import OutlierGate, ShadowModel
from koopmpc.models.moments.doubts import find_doubts
from koopmpc.models.moments.moments import Moments
from koopmpc.models.moments.rows import ForgettingMemory, WindowMemory, row_columns
from koopmpc.models.moments.solve import Ridge, check_ridge, describe_solve, solve
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.shared.regression import build_predictor, build_regression

_BLOCK = 32  # rows that the factor absorbs at once


class OnlineEDMD:
    """Recursive least squares ψ(x⁺) = A ψ(x) + B u + E w over all pairs so far, weighted by forgetting^age.

    It keeps the triangular factor of the rows [ψ(x) u w ψ(x⁺)], never a covariance. Updates are orthogonal
    transformations, so errors do not grow with their number. With a window it is the fit of the last `window` pairs.
    With neither forgetting nor a window it is the batch fit.

    With forgetting, outliers are counted in `outliers` and not learned: one bad reading would be remembered for
    thousands of pairs. A pair is an outlier if its innovation, ψ(x⁺) less its forecast, is above 30 times the spread of
    the innovations so far. Before the first forecasts, it is one if a value is above 1000 times the size of its
    observable. Outliers widen the spread, so a changed plant is learned after a few pairs. A memory of less than four
    pairs a regressor looks for no outliers.

    Readings that stay bad for longer are learned, and spoil the model until the memory forgets them. If they are so
    large that it never would, a second memory, begun after them, replaces it after ten to twenty times 1 / (1 − λ)
    pairs.

    There is no embedding, because no past steps are kept. A model with delays learns from points ζ as states:
    ``OnlineEDMD.start(Delay(2)(episodes), lifting)``, then ``learn(zeta, u, zeta_next)``.

    Parameters
    ----------
    lifting
        ψ: R^nx → R^nz.
    dt
        Sample time [s].
    states, inputs, disturbances
        Names with units.
    forgetting
        λ in (0, 1]; the memory is about 1 / (1 − λ) pairs.
    window
        Number of pairs in the fit; None for all.
    ridge
        Tikhonov weight as in `edmd`; "gcv" chooses it for each predictor.
    keep
        In (0, 1): forgetting stops when the information along a direction falls to this share of its maximum, so that a
        plant at rest does not lose its model. Pass a smaller `keep` if later signals are more than 1/√keep times
        smaller than the first.

    Raises
    ------
    DataError
        forgetting lies outside (0, 1], or both forgetting and a window are passed.

    References
    ----------
    Sayed & Kailath, "A state-space approach to adaptive RLS filtering", IEEE Signal Process. Mag. 11, 1994 (square
    roots); Golub & Van Loan, "Matrix Computations", 4th ed., sec. 6.5.
    """

    def __init__(
        self,
        lifting: Lifting,
        *,
        dt: float,
        states: Sequence[str],
        inputs: Sequence[str] = (),
        disturbances: Sequence[str] = (),
        forgetting: float = 1.0,
        window: int | None = None,
        ridge: Ridge = 0.0,
        keep: float = 1e-6,
    ) -> None:
        self._lifting = check_lifting(lifting).bind(checks.texts(states, "states"))
        self._full = row_columns(self._lifting, (), bilinear=False).full
        self._psi, self._pair = buffer_lifting(self._full), np.empty((2, self._full.nz))  # for single pairs
        self._inputs = checks.texts(inputs, "inputs")
        self._disturbances = checks.texts(disturbances, "disturbances")
        self._dt = checks.positive(dt, "dt", "s")
        self._ridge: Ridge = check_ridge(ridge)
        factor = checks.positive(forgetting, "forgetting")
        if factor > 1:
            raise DataError(f"forgetting is {factor:g}; it must lie in (0, 1], 1 forgets nothing")
        least = float(checks.array(keep, "keep", ()))
        if not 0 < least < 1:
            raise DataError(f"keep is {least:g}; it must lie between 0 and 1")
        nz, nf = self._lifting.nz, len(self._inputs) + len(self._disturbances)
        self._n, width = nz + nf, nf + 2 * self._full.nz
        self._memory: ForgettingMemory | WindowMemory
        if window is None:
            self._forgetting = width, self._n, factor, least
            self._memory = ForgettingMemory(*self._forgetting)
        elif factor < 1:
            raise DataError(f"window is {window} and forgetting {factor:g}; choose one of them")
        else:
            self._memory = WindowMemory(width, checks.count(window, "window"), max(_BLOCK, width))
        self._rows = np.empty((_BLOCK if window is None else max(_BLOCK, width), width))
        self._waiting: int = 0
        long = factor < 1 and 1 / (1 - factor) >= 4 * self._n  # forecasts from a short memory cannot reveal outliers
        self._gate = OutlierGate(width, self._n, nz) if long else None
        self._shadow: ShadowModel | None = None
        self.pairs = self.outliers = 0

    @classmethod
    def start(
        cls,
        episodes: Episodes,
        lifting: Lifting,
        *,
        forgetting: float = 1.0,
        window: int | None = None,
        ridge: Ridge = 0.0,
        keep: float = 1e-6,
    ) -> "OnlineEDMD":
        """Return an OnlineEDMD with the names and dt of these episodes, after it has learned from them in order."""
        episodes = episodes_of(episodes)
        online = cls(
            lifting,
            dt=episodes.dt,
            states=episodes.states,
            inputs=episodes.inputs,
            disturbances=episodes.disturbances,
            forgetting=forgetting,
            window=window,
            ridge=ridge,
            keep=keep,
        )
        for episode in episodes:
            online.learn(episode.X[:-1], episode.U, episode.X[1:], episode.W)
        return online

    def check(self, model: LinearPredictor) -> None:
        """Check that a learned predictor can replace this model.

        Raises
        ------
        DataError
            The model has another lifting, dt, states, inputs or disturbances.
        """
        pairs = {
            "lifting": (self._lifting, model.lifting),
            "dt": (self._dt, model.dt),
            "inputs": (self._inputs, model.inputs),
            "disturbances": (self._disturbances, model.disturbances),
        }
        for name, (learned, expected) in pairs.items():
            if learned != expected:
                raise DataError(f"OnlineEDMD learns another {name} than the model's; start it with those of the model")

    def learn(self, x: ArrayLike, u: ArrayLike, x_next: ArrayLike, w: ArrayLike | None = None) -> None:
        """Learn from one pair, in which u and w lead from x to x_next, or from rows of pairs, the newest last.

        Parameters
        ----------
        x, x_next
            (nx,) or (M, nx).
        u
            (nu,) or (M, nu).
        w
            (nw,) or (M, nw), if the model has measured disturbances.

        Raises
        ------
        ShapeError, DataError
            The shapes do not fit together, or an array holds NaN or inf: leave such a sample out.
        """
        nx, nu, nw = len(self._full.bound_states), len(self._inputs), len(self._disturbances)
        now = checks.array(x, "x")
        single = now.ndim == 1
        lead = () if single else (len(now),)
        if now.shape != (*lead, nx):
            raise ShapeError(f"x has shape {now.shape}, expected ({nx},) or rows of {nx} states")
        forced = checks.array(u, "u", (*lead, nu))
        after = checks.array(x_next, "x_next", (*lead, nx))
        if w is None and nw:
            raise DataError(f"the model has {nw} measured disturbances; pass w")
        pushed = np.zeros((*lead, 0)) if w is None or not nw else checks.array(w, "w", (*lead, nw))
        count, nz = 1 if single else len(now), self._lifting.nz
        Z = self._lift(np.concatenate([now.reshape(count, nx), after.reshape(count, nx)]))
        parts = [Z[:count, :nz], forced.reshape(count, nu), pushed.reshape(count, nw), Z[:count, nz:], Z[count:]]
        before = self.outliers
        self._take(np.hstack(parts))
        self.pairs += count - (self.outliers - before)

    def _take(self, table: Float[np.ndarray, "M width"]) -> None:
        """Learn from rows [ψ(x) u w, states that ψ lacks, ψ(x⁺) …], a block at a time."""
        done, rows, gate = 0, self._rows, self._gate
        while done < len(table):
            take = min(len(table) - done, len(rows) - self._waiting)
            part = rows[self._waiting : self._waiting + take]
            part[:] = table[done : done + take]
            done += take
            learned = take if gate is None else gate.keep(part)
            self._waiting += learned
            self.outliers += take - learned
            if self._waiting == len(rows) and gate is not None and not gate.begun:
                self._waiting = gate.first(rows)
                self.outliers += len(rows) - self._waiting
            if self._waiting == len(rows):
                self._memory.push(rows)
                self._waiting = 0
                if gate is not None:
                    self._judge(gate)

    def _judge(self, gate: "OutlierGate") -> None:
        """Start a shadow model when signals have fallen; let it take over if it is better; update the forecasts."""
        if gate.fell:
            factor = self._forgetting[2]
            gate.fell, self._shadow = False, ShadowModel(ForgettingMemory(*self._forgetting), self._n, 1 / (1 - factor))
        elif self._shadow is not None and self._shadow.push(self._rows, gate.K):
            self._memory, self.pairs = self._shadow.memory, self._shadow.rows
            gate.renew(self._shadow.memory.R, self._shadow.spread, self._shadow.size)
            self._shadow = None
        assert isinstance(self._memory, ForgettingMemory)
        gate.learn(self._memory.R)

    def predictor(self) -> LinearPredictor:
        """Return the fit of all pairs in the memory. Its report holds the doubts; no warning is raised.

        Raises
        ------
        DataError
            No pair was learned yet.
        """
        if self.pairs == 0:
            raise DataError("no pair was learned yet; call learn first")
        R, weight = self._memory.factor(self._rows[: self._waiting])
        regression = build_regression(self._moments(R, weight), "online_edmd", disturbances=self._disturbances)
        rows = regression.rows.keep_targets(self._lifting.nz)
        sentences = find_doubts(rows, regression.lifting.names, regression.inputs, regular=self._ridge != 0)[0]
        solution = solve(rows, ridge=self._ridge)
        rule = f"triangular factor of {self.pairs} pairs, their weights {weight:.6g} in all, "
        if self.outliers:
            rule += f"{self.outliers} pairs were outliers and were not learned, "
        rule += describe_solve(rows, self._ridge, solution.ridge)
        return build_predictor(regression, solution.K, rule=rule, ridge=solution.ridge, doubts=sentences, silent=True)

    def _lift(self, points: Float[np.ndarray, "M2 nx"]) -> Float[np.ndarray, "M2 nf"]:
        """Return ψ of rows of states; of two in memory that the next call overwrites."""
        if len(points) == 2:
            for z, point in zip(self._pair, points, strict=True):
                self._psi.arguments[0][:] = point
                self._psi.evaluate()
                z[:] = self._psi.results[0]
            if np.isfinite(self._pair).all():  # NaN for a state beyond 1e30
                return self._pair
        with np.errstate(all="ignore"):  # the check below names an observable that is not finite
            Z = self._full(points)
        if not np.isfinite(Z).all():
            bad = self._full.names[int(np.argwhere(~np.isfinite(Z))[0, 1])]
            raise DataError(f"the observable {bad!r} is not finite on these data; leave the sample out")
        return Z

    def _moments(self, R: Float[np.ndarray, "nd nd"], weight: float) -> Moments:
        """Return the factor as Moments, whose rows hold the states that ψ lacks before u."""
        nz, n, lacking = self._lifting.nz, self._n, self._full.nz - self._lifting.nz
        if lacking:
            order = np.r_[0:nz, n : n + lacking, nz:n, n + lacking : len(R)]
            R = np.asarray(np.linalg.qr(R[:, order], mode="r"))
        return Moments(
            self._lifting,
            (*self._inputs, *self._disturbances),
            self._dt,
            max(round(weight), 1),
            weight,
            "qr",
            np.ascontiguousarray(R),
        )
