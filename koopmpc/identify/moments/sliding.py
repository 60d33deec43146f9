"""The triangular factor of rows that come one after the other: of all of them, forgetting, or of the last ones."""

from collections import deque

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from koopmpc.identify.moments.moments import Table, Triangle, absorb, empty


class Forgetting:
    """The factor of all rows, each weighted by forgetting^age.

    A row of R is one equation r·k = t of the triangular system R K = T. Forgetting multiplies it by √λ. A direction
    about which new rows say nothing would fade away, until noise alone decided it (wind-up). So an equation whose
    information r_jj² falls below `keep` times its maximum so far is forgotten no further: it is scaled back to that
    floor, left side and right side together, which leaves K as it is.

    Parameters
    ----------
    nd, n
        Columns of a row, and how many of them are regressors.
    forgetting
        λ in (0, 1].
    keep
        The floor, as a share of information.
    """

    def __init__(self, nd: int, n: int, forgetting: float, keep: float) -> None:
        self._R, self._n = empty(nd), n
        self._forgetting, self._keep = forgetting, keep
        self._most = np.zeros(n)
        self._weight = 0.0

    def push(self, rows: Table) -> None:
        """Take in rows, the newest last."""
        R, self._weight = self._joined(self._R, rows)
        if self._forgetting < 1.0:
            held = np.abs(R.diagonal()[: self._n])
            np.maximum(self._most, held, out=self._most)
            floor = np.sqrt(self._keep) * self._most
            low = np.flatnonzero((held < floor) & (held > 0))
            R[low] *= (floor[low] / held[low])[:, None]

    @property
    def R(self) -> Triangle:
        """The factor of the rows that were pushed; it changes with the next ones."""
        return self._R

    def factor(self, pending: Table) -> tuple[Triangle, float]:
        """Return R and the sum of weights of all rows, with those that wait."""
        return self._joined(self._R.copy(order="F"), pending)

    def _joined(self, R: Triangle, rows: Table) -> tuple[Triangle, float]:
        if self._forgetting == 1.0:
            absorb(R, rows)
            return R, self._weight + len(rows)
        R *= self._forgetting ** (0.5 * len(rows))
        weights = self._forgetting ** np.arange(len(rows) - 1.0, -1.0, -1.0)
        absorb(R, rows * np.sqrt(weights)[:, None])
        return R, self._weight * self._forgetting ** len(rows) + float(weights.sum())


class Window:
    """The factor of the last `length` rows, kept like a queue made of two stacks: nothing is ever subtracted.

    New blocks are absorbed at the back. For each old block the front holds one factor, that of the block and of all
    later ones of the front, so that the oldest block leaves when its factor is dropped. When the front is used up, the
    back becomes the front. Each row is absorbed twice, errors do not add up over time, and about 2 · length rows are
    held in memory. Turning the back into the front takes one step that costs as much as `length` updates.

    Parameters
    ----------
    nd
        Columns of a row.
    length
        Rows in the window.
    block
        Rows that come at once.
    """

    def __init__(self, nd: int, length: int, block: int) -> None:
        self._nd, self._length, self._block = nd, length, block
        self._front: deque[tuple[Triangle, Table]] = deque()
        self._back: list[Table] = []
        self._R = empty(nd)

    def push(self, rows: Table) -> None:
        """Take in a block of rows, the newest last."""
        absorb(self._R, rows)
        self._back.append(rows.copy())
        self._drop(0)

    def factor(self, pending: Table) -> tuple[Triangle, float]:
        """Return R and the number of rows in the window, the last of them those that wait."""
        pending = pending[-self._length :]
        old = self._drop(len(pending))
        if old:
            self._turn()
        R = self._R.copy(order="F")
        if old:
            absorb(R, self._front[0][1][old:])
        if len(self._front) > bool(old):
            absorb(R, self._front[bool(old)][0])
        absorb(R, pending)
        return R, float(self._held - old + len(pending))

    @property
    def _held(self) -> int:
        return (len(self._front) + len(self._back)) * self._block

    def _drop(self, waiting: int) -> int:
        """Let blocks go that lie before the window; return how many rows of the oldest one do."""
        while self._held + waiting - self._length >= self._block:
            self._turn()
            self._front.popleft()
        return max(self._held + waiting - self._length, 0)

    def _turn(self) -> None:
        """Make the back the front where that is empty."""
        if not self._front:
            R = empty(self._nd)
            for rows in reversed(self._back):
                absorb(R, rows)
                self._front.appendleft((R.copy(order="F"), rows))
            self._back, self._R = [], empty(self._nd)


def _forecaster(R: Triangle, n: int) -> Float[np.ndarray, "n nt"] | None:
    """Return K of R K = T, with which t is forecast as Kᵀr; None where the rows do not say what it is."""
    diagonal = np.abs(R.diagonal()[:n])
    if diagonal.min(initial=np.inf) <= 1e-12 * diagonal.max(initial=0.0):
        return None
    return solve_triangular(R[:n, :n], R[:n, n:], check_finite=False)


BEYOND, LEAST, MEMORY = 30.0, 0.01, 0.01  # of a spread; of a column's size; share that a new row has in both
FEW = 20  # innovations, or rows, that say nothing of their spread yet
FAR = 1000.0  # of a column's size: what no signal reaches, where there is no forecast to compare it with
FALLEN = 0.01  # of a column's size: what stays below it for FEW rows was another signal before


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
