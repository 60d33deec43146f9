"""OnlineEDMD: recursive EDMD that learns while the plant runs, and which rows it does not learn from."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from koopmpc import checks
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.moments.moments import Moments
from koopmpc.identify.moments.rows import Forgetting, Table, Triangle, Window, row_columns
from koopmpc.identify.regression import linear_predictor, regression_of, unreduced
from koopmpc.identify.solve import Ridge, doubts, ridge_of, rule, solve
from koopmpc.lifting.base import Lifting, buffered, lifting_of
from koopmpc.predict.predictors import LinearPredictor

_BLOCK = 32  # rows that the factor takes in at once
# The gate of outliers:
BEYOND, LEAST, MEMORY = 30.0, 0.01, 0.01  # of a spread; of a column's size; share that a new row has in both
FEW = 20  # innovations, or rows, that say nothing of their spread yet
FAR = 1000.0  # of a column's size: what no signal reaches, where there is no forecast to compare it with
FALLEN = 0.01  # of a column's size: what stays below it for FEW rows was another signal before


class OnlineEDMD:
    """Recursive least squares ψ(x⁺) = A ψ(x) + B u + E w over all pairs so far, weighted by forgetting^age.

    It keeps the triangular factor of the rows [ψ(x) u w ψ(x⁺)], never a covariance: updates are orthogonal
    transformations, so errors do not grow with their number. With a window it is the fit of the last `window` pairs.
    With neither forgetting nor a window it is the batch fit.

    With forgetting, a pair whose innovation, ψ(x⁺) less its forecast, is beyond 30 times the spread of innovations so
    far is an outlier: it is not learned, and counted in `outliers`. Otherwise one reading that is far off would be
    remembered for thousands of pairs. As long as there are no forecasts, a pair with a value beyond 1000 times the size
    of its observable is an outlier. A plant that has changed is learned after a few pairs, because outliers widen the
    spread. Outliers are not looked for with a memory of less than four pairs a regressor. Readings that stay bad for
    longer are learned, and spoil the model for as long as the memory holds them. Where they are so far off that it
    would hold them for good, a second memory, begun once they are over, takes its place after ten to twenty times
    1 / (1 − λ) pairs.

    It takes no embedding, because it keeps no past steps. A model with delays learns from points ζ as states:
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
        Number of pairs that count; None for all.
    ridge
        Tikhonov weight as in `edmd`; "gcv" chooses it anew for each predictor.
    keep
        In (0, 1): the information along each direction is not forgotten below this share of its maximum so far, so that
        a plant at rest does not lose its model. Lower `keep` where later signals are more than 1/√keep times smaller
        than the first.

    Raises
    ------
    DataError
        forgetting lies outside (0, 1], or a window is asked for beside it.

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
        self._lifting = lifting_of(lifting).bind(checks.texts(states, "states"))
        self._full = row_columns(self._lifting, (), bilinear=False).full
        self._psi, self._pair = buffered(self._full), np.empty((2, self._full.nz))  # for single pairs
        self._inputs = checks.texts(inputs, "inputs")
        self._disturbances = checks.texts(disturbances, "disturbances")
        self._dt = checks.positive(dt, "dt", "s")
        self._ridge: Ridge = ridge_of(ridge)
        factor = checks.positive(forgetting, "forgetting")
        if factor > 1:
            raise DataError(f"forgetting is {factor:g}; it must lie in (0, 1], 1 forgets nothing")
        if not 0 < keep < 1:
            raise DataError(f"keep is {keep:g}; it must lie between 0 and 1")
        nz, nf = self._lifting.nz, len(self._inputs) + len(self._disturbances)
        self._n, width = nz + nf, nf + 2 * self._full.nz
        self._memory: Forgetting | Window
        if window is None:
            self._forgetting = width, self._n, factor, float(keep)
            self._memory = Forgetting(*self._forgetting)
        elif factor < 1:
            raise DataError(f"window is {window} and forgetting {factor:g}; choose one of them")
        else:
            self._memory = Window(width, checks.count(window, "window"), max(_BLOCK, width))
        self._rows = np.empty((_BLOCK if window is None else max(_BLOCK, width), width))
        self._waiting: int = 0
        long = factor < 1 and 1 / (1 - factor) >= 4 * self._n  # else forecasts say nothing of outliers
        self._gate = Gate(width, self._n, nz) if long else None
        self._rival: Rival | None = None
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
        """Return an OnlineEDMD with the names and dt of these episodes that has learned from them in their order."""
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
        """Check that what is learned can take the place of this model.

        Raises
        ------
        DataError
            The model has another lifting, dt, states, inputs or disturbances.
        """
        own = {
            "lifting": (self._lifting, model.lifting),
            "dt": (self._dt, model.dt),
            "inputs": (self._inputs, model.inputs),
            "disturbances": (self._disturbances, model.disturbances),
        }
        for name, (learned, given) in own.items():
            if learned != given:
                raise DataError(f"OnlineEDMD learns another {name} than the model's; start it with those of the model")

    def learn(self, x: ArrayLike, u: ArrayLike, x_next: ArrayLike, w: ArrayLike | None = None) -> None:
        """Learn that u (and w) led from x to x_next: one pair, or rows of pairs, the newest last.

        Parameters
        ----------
        x, x_next
            (nx,) or (M, nx).
        u
            (nu,) or (M, nu).
        w
            (nw,) or (M, nw), where the model has measured disturbances.

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
        Z = self._lifted(now, after) if single else None
        if Z is None or not np.isfinite(Z).all():  # many rows, or one that the fast path cannot lift
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

    def _judge(self, gate: "Gate") -> None:
        """Begin a rival once signals have fallen, let it take over where it is better, and renew the forecasts."""
        if gate.fell:
            factor = self._forgetting[2]
            gate.fell, self._rival = False, Rival(Forgetting(*self._forgetting), self._n, 1 / (1 - factor))
        elif self._rival is not None and self._rival.push(self._rows, gate.K):
            self._memory, self.pairs = self._rival.memory, self._rival.rows
            gate.renew(self._rival.memory.R, self._rival.spread, self._rival.size)
            self._rival = None
        assert isinstance(self._memory, Forgetting)
        gate.learn(self._memory.R)

    def predictor(self) -> LinearPredictor:
        """Return the fit of all pairs that count now. Doubts stand in its report; no warning is raised.

        Raises
        ------
        DataError
            Nothing was learned yet.
        """
        if self.pairs == 0:
            raise DataError("no pair was learned yet; call learn first")
        R, weight = self._memory.factor(self._rows[: self._waiting])
        regression = regression_of(self._moments(R, weight), "online_edmd", disturbances=self._disturbances)
        rows = regression.rows.leading(self._lifting.nz)
        sentences = doubts(rows, regression.lifting.names, regression.inputs, regular=self._ridge != 0)[0]
        solution = solve(rows, ridge=self._ridge)
        said = f"triangular factor of {self.pairs} pairs, their weights {weight:.6g} in all, "
        if self.outliers:
            said += f"{self.outliers} pairs were outliers and were not learned, "
        said += rule(rows, self._ridge, solution.ridge)
        result = unreduced(regression, solution.K, rule=said, ridge=solution.ridge, doubts=sentences)
        return linear_predictor(regression, result, warn=False)

    def _lifted(self, now: Float[np.ndarray, " nx"], after: Float[np.ndarray, " nx"]) -> Float[np.ndarray, "2 nf"]:
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
        some = slice(first, first + take)
        rows = self._rows[self._waiting : self._waiting + take]
        rows[:, :nz] = Z[some, :nz]
        rows[:, nz : nz + nu] = forced[some]
        if pushed is not None:
            rows[:, nz + nu : self._n] = pushed.reshape(count, -1)[some]
        last = rows.shape[1] - full
        rows[:, self._n : last] = Z[some, nz:]
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


class Gate:
    """Which rows are no outliers: those whose innovation t − Kᵀr is within 30 spreads in every column.

    The spread of a column is the root-mean-square of its innovations, over about 100 rows, and counts as at least 1 %
    of the column's own. An innovation beyond the gate counts there as if it stood at the gate: the spread grows
    tenfold with four of them in sequence, so that a plant that has changed is learned after a few rows.

    As long as there is no forecast, a value beyond 1000 times the size of its column makes its row an outlier; the size
    is the root-mean-square over about 100 rows. The very first rows have no size to compare with: among them a value is
    compared with all others of its column. Inputs never make an outlier. `fell` is True once 20 rows in sequence have
    stayed below 1 % of the size of some column: the plant came to rest, or what was learned before was no signal.

    Parameters
    ----------
    nd, n, nz
        Columns of a row; how many of them are regressors r, the others are t; how many of r are observables.
    """

    def __init__(self, nd: int, n: int, nz: int) -> None:
        self._n, self._rows, self._seen = n, 0, 0  # _seen: innovations
        self.begun, self._measured = False, (np.arange(nd) < nz) | (np.arange(nd) >= n)
        self._K: Float[np.ndarray, "n nt"] | None = None
        self._spread, self._size = np.zeros(nd - n), np.zeros(nd)  # mean squares
        self.fell, self._low = False, np.zeros(nd)  # _low: rows in sequence below FALLEN

    def learn(self, R: Triangle) -> None:
        """Take over the regression R K = T of all rows so far."""
        if self._rows > 4 * self._n and (K := _forecaster(R, self._n)) is not None:
            self._K = K

    def renew(self, R: Triangle, spread: np.ndarray, size: np.ndarray) -> None:
        """Begin anew with the regression R K = T, and mean squares of innovations and columns."""
        self._K, self._spread, self._size = _forecaster(R, self._n), spread, size

    @property
    def K(self) -> Float[np.ndarray, "n nt"] | None:
        """The forecast t = Kᵀr that innovations are taken from; None as long as there is none."""
        return self._K

    def first(self, rows: Table) -> int:
        """Look at the first rows as a whole: move those that are no outliers to the front, and return their number."""
        most = FAR * np.sort(np.abs(rows), axis=0)[-2]  # without the one that may be far off
        kept = rows[((np.abs(rows) <= most) | (most == 0) | ~self._measured).all(axis=1)]
        rows[: len(kept)] = kept
        self._rows, self._size, self.begun = len(kept), np.mean(kept**2, axis=0), True
        return len(kept)

    def keep(self, rows: Table) -> int:
        """Move the rows that are no outliers to the front, and return how many they are."""
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


class Rival:
    """A second factor, of the rows since signals fell, which takes over where the first one is spoilt.

    Bad readings that went on until they were learned leave information in the first factor that a thousand ordinary
    rows cannot outweigh, and that `keep` holds for ever. Over the second half of each ten memories both forecast the
    rows that come: the rival is better where the first is off by more than 0.1 % of some column, and by more than twice
    as much as the rival. A plant that came to rest keeps its model: in that time the first one has adapted to what is
    left to forecast.

    Parameters
    ----------
    memory
        A factor of no rows yet.
    n
        Regressors.
    memory_rows
        Rows that it remembers, 1 / (1 − λ).
    """

    def __init__(self, memory: Forgetting, n: int, memory_rows: float) -> None:
        self.memory, self._n, self._period = memory, n, int(10 * memory_rows)
        self.rows, self._judged = 0, 0
        self._errors = np.zeros((2, len(memory.R) - n))
        self.size = np.zeros(len(memory.R))  # mean square of each column

    @property
    def spread(self) -> np.ndarray:
        """The mean square of innovations of each column."""
        return self._errors[1]

    def push(self, rows: Table, K: Float[np.ndarray, "n nt"] | None) -> bool:
        """Take in rows that the first factor forecasts by K; return whether the rival takes its place from now on."""
        n, own = self._n, _forecaster(self.memory.R, self._n)
        if 2 * (self.rows % self._period) >= self._period and K is not None and own is not None:
            r, t = rows[:, :n], rows[:, n:]
            share = len(rows) / (self._judged + len(rows))
            self._judged += len(rows)
            self._errors += share * (np.array([((t - r @ k) ** 2).mean(axis=0) for k in (K, own)]) - self._errors)
            self.size += share * ((rows**2).mean(axis=0) - self.size)
        self.memory.push(rows)
        self.rows += len(rows)
        if self.rows // self._period == (self.rows - len(rows)) // self._period or not self._judged:
            return False
        first, second = self._errors
        off = (first > 1e-6 * self.size[n:]) & (first > 4 * second)
        better = bool(off.any() and (second <= np.maximum(first, 0.01 * self.size[n:])).all())
        self._judged = 0
        return better


def _forecaster(R: Triangle, n: int) -> Float[np.ndarray, "n nt"] | None:
    """Return K of R K = T, with which t is forecast as Kᵀr; None where the rows do not say what it is."""
    diagonal = np.abs(R.diagonal()[:n])
    if diagonal.min(initial=np.inf) <= 1e-12 * diagonal.max(initial=0.0):
        return None
    return solve_triangular(R[:n, :n], R[:n, n:], check_finite=False)
