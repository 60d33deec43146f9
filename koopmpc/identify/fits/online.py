"""OnlineEDMD, a recursive EDMD that learns while the plant runs, and the gate that keeps outliers from it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from koopmpc import checks
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.moments.moments import Moments
from koopmpc.identify.moments.rows import ForgettingMemory, Table, Triangle, WindowMemory, row_columns
from koopmpc.identify.regression import build_predictor, build_regression, build_result
from koopmpc.identify.solve import Ridge, check_ridge, describe_solve, find_doubts, solve
from koopmpc.lifting.base import Lifting, buffer_lifting, check_lifting
from koopmpc.predict.predictors import LinearPredictor

_BLOCK = 32  # rows that the factor absorbs at once
# The gate of outliers:
BEYOND = 30.0  # a row is an outlier if an innovation is above so many times the spread of its column
LEAST = 0.01  # the spread of a column counts as at least this share of the column's size
MEMORY = 0.01  # weight of a new row in the running spread and size
FEW = 20  # the gate judges innovations after so many of them, and sizes after so many rows
FAR = 1000.0  # without a forecast, a row is an outlier if a value is above so many times its column's size
FALLEN = 0.01  # signals have fallen if a column stays below this share of its size for FEW rows


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
        pushed = checks.array(np.zeros((*lead, 0)) if w is None else w, "w", (*lead, nw)) if nw else None
        count = 1 if single else len(now)
        Z = self._lift_pair(now, after) if single else None
        if Z is None or not np.isfinite(Z).all():  # many rows, or one row that the fast path could not lift
            with np.errstate(all="ignore"):  # the check below names an observable that is not finite
                Z = self._full(np.concatenate([now.reshape(count, nx), after.reshape(count, nx)]))
            if not np.isfinite(Z).all():
                bad = self._full.names[int(np.argwhere(~np.isfinite(Z))[0, 1])]
                raise DataError(f"the observable {bad!r} is not finite on these data; leave the sample out")
        done, before = 0, self.outliers
        while done < count:
            take = min(count - done, len(self._rows) - self._waiting)
            self._write(Z, forced.reshape(count, nu), pushed, done, take)
            done += take
            if self._gate is not None:
                learned = self._gate.keep(self._rows[self._waiting - take : self._waiting])
                self._waiting -= take - learned
                self.outliers += take - learned
            if self._waiting == len(self._rows) and self._gate is not None and not self._gate.begun:
                self._waiting = self._gate.first(self._rows)
                self.outliers += len(self._rows) - self._waiting
            if self._waiting == len(self._rows):
                self._memory.push(self._rows)
                self._waiting = 0
                if self._gate is not None:
                    self._judge(self._gate)
        self.pairs = self.pairs + count - (self.outliers - before)

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
        result = build_result(regression, solution.K, rule=rule, ridge=solution.ridge, doubts=sentences)
        return build_predictor(regression, result, warn=False)

    def _lift_pair(self, now: Float[np.ndarray, " nx"], after: Float[np.ndarray, " nx"]) -> Float[np.ndarray, "2 nf"]:
        """Return ψ of both states, in memory that the next call overwrites; NaN for a state beyond 1e30."""
        memory = self._psi
        for z, point in zip(self._pair, (now, after), strict=True):
            memory.arguments[0][:] = point
            memory.evaluate()
            z[:] = memory.results[0]
        return self._pair

    def _write(
        self,
        Z: Float[np.ndarray, "M2 nf"],
        forced: Float[np.ndarray, "M nu"],
        pushed: Float[np.ndarray, "..."] | None,
        first: int,
        take: int,
    ) -> None:
        """Write rows [ψ(x) u w, states that ψ lacks, ψ(x⁺) …] into the buffer."""
        count, nz, full, nu = len(forced), self._lifting.nz, self._full.nz, forced.shape[1]
        taken = slice(first, first + take)
        rows = self._rows[self._waiting : self._waiting + take]
        rows[:, :nz] = Z[taken, :nz]
        rows[:, nz : nz + nu] = forced[taken]
        if pushed is not None:
            rows[:, nz + nu : self._n] = pushed.reshape(count, -1)[taken]
        last = rows.shape[1] - full
        rows[:, self._n : last] = Z[taken, nz:]
        rows[:, last:] = Z[count + first : count + first + take]
        self._waiting += take

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


class OutlierGate:
    """A gate for rows [r t]: it rejects a row as an outlier if an innovation t − Kᵀr is above 30 spreads of its column.

    The spread of a column is the root-mean-square of its innovations over about 100 rows, and at least 1 % of the
    column's size. An innovation above the gate enters the spread with the value of the gate. Four of them in sequence
    widen the spread tenfold, so that a changed plant is learned after a few rows.

    Without a forecast, a row is an outlier if a value is above 1000 times the size of its column, the root-mean-square
    over about 100 rows. Among the very first rows, a value is compared with all others of its column. Inputs never make
    an outlier. `fell` becomes True when some column has stayed below 1 % of its size for 20 rows: either the plant came
    to rest, or the rows before were bad readings.

    Parameters
    ----------
    nd, n, nz
        Columns of a row; how many of them are regressors r, the others are t; how many of r are observables.
    """

    def __init__(self, nd: int, n: int, nz: int) -> None:
        self._n, self._rows, self._seen = n, 0, 0  # _seen counts innovations
        self.begun, self._measured = False, (np.arange(nd) < nz) | (np.arange(nd) >= n)
        self._K: Float[np.ndarray, "n nt"] | None = None
        self._spread, self._size = np.zeros(nd - n), np.zeros(nd)  # mean squares
        self.fell, self._low = False, np.zeros(nd)  # _low counts rows in sequence below FALLEN

    def learn(self, R: Triangle) -> None:
        """Take the forecast from the regression R K = T of all rows so far."""
        if self._rows > 4 * self._n and (K := _solve_forecast(R, self._n)) is not None:
            self._K = K

    def renew(self, R: Triangle, spread: np.ndarray, size: np.ndarray) -> None:
        """Replace the forecast by that of R K = T, and the mean squares of innovations and columns by these."""
        self._K, self._spread, self._size = _solve_forecast(R, self._n), spread, size

    @property
    def K(self) -> Float[np.ndarray, "n nt"] | None:
        """K of the forecast t = Kᵀr, or None before the first one."""
        return self._K

    def first(self, rows: Table) -> int:
        """Judge the first rows together: move the rows without outliers to the front, and return their number."""
        most = FAR * np.sort(np.abs(rows), axis=0)[-2]  # the largest value itself may be an outlier
        kept = rows[((np.abs(rows) <= most) | (most == 0) | ~self._measured).all(axis=1)]
        rows[: len(kept)] = kept
        self._rows, self._size, self.begun = len(kept), np.mean(kept**2, axis=0), True
        return len(kept)

    def keep(self, rows: Table) -> int:
        """Move the rows without outliers to the front, and return their number."""
        n, kept = self._n, 0
        row: Table
        for row in rows:
            square, good = row**2, True
            if self._K is not None:
                e = np.abs(row[n:] - row[:n] @ self._K)
                gate = BEYOND * np.maximum(np.sqrt(self._spread), LEAST * np.sqrt(self._size[n:]))
                self._seen += 1
                if self._seen > FEW:
                    good = bool((e <= gate).all())
                    e = np.minimum(e, gate)
                self._spread += max(MEMORY, 1.0 / self._seen) * (e**2 - self._spread)
            if self._seen <= FEW < self._rows:
                far = np.where(self._measured & (self._size > 0), FAR**2 * self._size, np.inf)
                good = bool((square <= far).all())
                square = np.minimum(square, far)
            if good or self._seen <= FEW:
                self._size += max(MEMORY, 1.0 / (self._rows + 1)) * (square - self._size)
            if good:
                self._low = np.where(self._measured & (row**2 < FALLEN**2 * self._size), self._low + 1, 0)
                self.fell |= bool((self._low == FEW).any())
                rows[kept] = row
                kept += 1
                self._rows += 1
        return kept


class ShadowModel:
    """A second factor, of the rows since signals fell; it replaces the first factor if bad readings have spoilt that.

    Bad readings that lasted until they were learned leave information in the first factor that a thousand ordinary rows
    cannot outweigh, and `keep` never lets it fade. So both factors forecast the new rows in the second half of each
    period of ten memories. The shadow is better if the error of the first exceeds 0.1 % of some column's size and twice
    the error of the shadow. A plant that came to rest keeps its model, because the first factor has then adapted to the
    small signals.

    Parameters
    ----------
    memory
        A factor of no rows yet.
    n
        Regressors.
    memory_rows
        Length of its memory in rows, 1 / (1 − λ).
    """

    def __init__(self, memory: ForgettingMemory, n: int, memory_rows: float) -> None:
        self.memory, self._n, self._period = memory, n, int(10 * memory_rows)
        self.rows, self._judged = 0, 0
        self._errors = np.zeros((2, len(memory.R) - n))
        self.size = np.zeros(len(memory.R))  # mean square of each column

    @property
    def spread(self) -> np.ndarray:
        """Mean square of the innovations of each column."""
        return self._errors[1]

    def push(self, rows: Table, K: Float[np.ndarray, "n nt"] | None) -> bool:
        """Absorb rows that the first factor forecasts by K; return True if the shadow is to replace that factor."""
        n, K_shadow = self._n, _solve_forecast(self.memory.R, self._n)
        if 2 * (self.rows % self._period) >= self._period and K is not None and K_shadow is not None:
            r, t = rows[:, :n], rows[:, n:]
            share = len(rows) / (self._judged + len(rows))
            self._judged += len(rows)
            self._errors += share * (np.array([((t - r @ k) ** 2).mean(axis=0) for k in (K, K_shadow)]) - self._errors)
            self.size += share * ((rows**2).mean(axis=0) - self.size)
        self.memory.push(rows)
        self.rows += len(rows)
        if self.rows // self._period == (self.rows - len(rows)) // self._period or not self._judged:
            return False
        first, second = self._errors
        worse = (first > 1e-6 * self.size[n:]) & (first > 4 * second)
        better = bool(worse.any() and (second <= np.maximum(first, 0.01 * self.size[n:])).all())
        self._judged = 0
        return better


def _solve_forecast(R: Triangle, n: int) -> Float[np.ndarray, "n nt"] | None:
    """Return K of R K = T for the forecast t = Kᵀr, or None if the rows do not determine it."""
    diagonal = np.abs(R.diagonal()[:n])
    if diagonal.min(initial=np.inf) <= 1e-12 * diagonal.max(initial=0.0):
        return None
    return solve_triangular(R[:n, :n], R[:n, n:], check_finite=False)
