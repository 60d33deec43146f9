"""Outliers among rows that are learned one after the other, and a rival model that learns from all of them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from koopmpc.models.moments.rows import ForgettingMemory, Table, Triangle


@dataclass(frozen=True)
class _Gate:
    """When a row counts as an outlier."""

    beyond: float = 30.0  # a row is an outlier if an innovation is above so many times the spread of its column
    least: float = 0.01  # the spread of a column counts as at least this share of the column's size
    memory: float = 0.01  # weight of a new row in the running spread and size
    few: int = 20  # the gate judges innovations after so many of them, and sizes after so many rows
    far: float = 1000.0  # without a forecast, a row is an outlier if a value is above so many times its column's size
    fallen: float = 0.01  # signals have fallen if a column stays below this share of its size for `few` rows


_GATE = _Gate()


class OutlierGate:
    """A gate for rows [r t]: it rejects a row as an outlier if an innovation t − Kᵀr is above 30 spreads of its column.

    The spread of a column is the root-mean-square of its innovations over about 100 rows, and at least 1 % of the
    column's size. An innovation above the gate enters the spread with the value of the gate. Four of them in sequence
    widen the spread tenfold, so that a changed plant is learned after a few rows.

    Without a forecast, a row is an outlier if a value is above 1000 times the size of its column, the root-mean-square
    over about 100 rows. Among the very first rows, a value is compared with all others of its column. Inputs never make
    an outlier. `fell` becomes True when some column has stayed below 1 % of its size for 20 rows: either the plant came
    to rest, or the rows before were bad readings.
    """

    def __init__(self, nd: int, n: int, nz: int) -> None:
        self._n, self._rows, self._seen = n, 0, 0  # _seen counts innovations
        self.begun, self._measured = False, (np.arange(nd) < nz) | (np.arange(nd) >= n)
        self._K: Float[np.ndarray, "n nt"] | None = None
        self._spread, self._size = np.zeros(nd - n), np.zeros(nd)  # mean squares
        self.fell, self._low = False, np.zeros(nd)  # _low counts rows in sequence below _GATE.fallen

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
        most = _GATE.far * np.sort(np.abs(rows), axis=0)[-2]  # the largest value itself may be an outlier
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
                gate = _GATE.beyond * np.maximum(np.sqrt(self._spread), _GATE.least * np.sqrt(self._size[n:]))
                self._seen += 1
                if self._seen > _GATE.few:
                    good = bool((e <= gate).all())
                    e = np.minimum(e, gate)
                self._spread += max(_GATE.memory, 1.0 / self._seen) * (e**2 - self._spread)
            if self._seen <= _GATE.few < self._rows:
                far = np.where(self._measured & (self._size > 0), _GATE.far**2 * self._size, np.inf)
                good = bool((square <= far).all())
                square = np.minimum(square, far)
            if good or self._seen <= _GATE.few:
                self._size += max(_GATE.memory, 1.0 / (self._rows + 1)) * (square - self._size)
            if good:
                self._low = np.where(self._measured & (row**2 < _GATE.fallen**2 * self._size), self._low + 1, 0)
                self.fell |= bool((self._low == _GATE.few).any())
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
