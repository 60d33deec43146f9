"""What others reach on a record: ARX by least squares, a subspace method (nfoursid) and polynomial NARX (SysIdentPy).

Orders and settings come from one fixed grid. Each entry is fitted to the first two thirds of the learning part; the one
with the least free-run error on the last third is fitted to the whole learning part. The test part takes no part.
"""

import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from tests.real.records import Record

FreeRun = Callable[[Record], np.ndarray]  # (rows, ny) outputs over the test part, known rows first
Fit = Callable[[Record], FreeRun]

ARX_ORDERS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20)
SUBSPACE_ORDERS = (1, 2, 3, 4, 6)
SUBSPACE_ROWS = (10, 20)
NARX_LAGS = (2, 4, 8)
NARX_DEGREES = (2, 3)


def choose(record: Record, grid: Iterable[Fit]) -> np.ndarray | None:
    """Return the free run over the test part of the entry that does best on the last third of the learning part."""
    at = 2 * len(record.U_learn) // 3
    part = replace(
        record,
        U_learn=record.U_learn[:at],
        Y_learn=record.Y_learn[:at],
        U_test=record.U_learn[at:],
        Y_test=record.Y_learn[at:],
    )
    best: tuple[float, Fit] | None = None
    for fit in grid:
        error = _error(part, fit)
        if best is None or error < best[0]:
            best = error, fit
    return None if best is None or not np.isfinite(best[0]) else best[1](record)(record)


def _error(part: Record, fit: Fit) -> float:
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return part.error(fit(part)(part))
    except (ValueError, np.linalg.LinAlgError, FloatingPointError, IndexError):
        return float("inf")  # a package that cannot fit this entry of the grid has no result for it


def arx(order: int, feedthrough: bool) -> Fit:
    """Return the fit of y_k = Σ aᵢ y_{k−i} + Σ bᵢ u_{k−i} + c, i = 1 … order; with feedthrough also b₀ u_k."""

    def row(U: np.ndarray, Y: np.ndarray, k: int) -> np.ndarray:
        past = [k - i for i in range(1, order + 1)]
        now = [k] if feedthrough else []
        return np.concatenate([*(Y[max(i, 0)] for i in past), *(U[max(i, 0)] for i in [*now, *past]), [1.0]])

    def fit(record: Record) -> FreeRun:
        rows = range(order, len(record.Y_learn))
        regressors = np.array([row(record.U_learn, record.Y_learn, k) for k in rows])
        coefficients = np.linalg.lstsq(regressors, record.Y_learn[order:], rcond=None)[0]

        def run(test: Record) -> np.ndarray:
            Y = test.Y_test.copy()
            Y[test.known :] = np.nan
            for k in range(test.known, len(Y)):
                Y[k] = row(test.U_test, Y, k) @ coefficients
            return Y

        return run

    return fit


def subspace(order: int, block_rows: int) -> Fit:
    """Return the fit of a linear state space by N4SID on standardized signals; x₀ by least squares of known rows."""

    def fit(record: Record) -> FreeRun:
        import pandas as pd
        from nfoursid.nfoursid import NFourSID

        mean_u, size_u = record.U_learn.mean(0), record.U_learn.std(0)
        mean_y, size_y = record.Y_learn.mean(0), record.Y_learn.std(0)
        frame = pd.DataFrame(
            np.hstack([(record.U_learn - mean_u) / size_u, (record.Y_learn - mean_y) / size_y]),
            columns=[*(names_u := [f"u{i}" for i in range(len(size_u))]), *(f"y{i}" for i in range(len(size_y)))],
        )
        names_y = [f"y{i}" for i in range(len(size_y))]
        method = NFourSID(frame, output_columns=names_y, input_columns=names_u, num_block_rows=block_rows)
        method.subspace_identification()
        system, _ = method.system_identification(rank=order)
        A, B, C, D = (np.asarray(matrix) for matrix in (system.a, system.b, system.c, system.d))

        def outputs(U: np.ndarray, x: np.ndarray) -> np.ndarray:
            rows = []
            for u in U:
                rows.append(C @ x + D @ u)
                x = A @ x + B @ u
            return np.array(rows)

        def run(test: Record) -> np.ndarray:
            U, Y = (test.U_test - mean_u) / size_u, (test.Y_test - mean_y) / size_y
            forced = outputs(U[: test.known], np.zeros(len(A)))
            observed = np.vstack([C @ np.linalg.matrix_power(A, k) for k in range(test.known)])
            gap = (Y[: test.known] - forced).ravel()
            x0 = np.linalg.lstsq(observed, gap, rcond=1e-6)[0]
            return outputs(U, x0) * size_y + mean_y

        return run

    return fit


def narx(lags: int, degree: int) -> Fit:
    """Return the fit of a polynomial NARX, its terms chosen by forward regression with an information criterion."""

    def fit(record: Record) -> FreeRun:
        from sysidentpy.basis_function import Polynomial
        from sysidentpy.model_structure_selection import FROLS
        from sysidentpy.parameter_estimation import LeastSquares

        nu = record.U_learn.shape[1]
        past = list(range(1, lags + 1))
        model = FROLS(
            order_selection=True,
            n_info_values=20,
            ylag=lags,
            xlag=past if nu == 1 else [past] * nu,
            info_criteria="aic",
            estimator=LeastSquares(),
            basis_function=Polynomial(degree=degree),
        )
        model.fit(X=record.U_learn, y=record.Y_learn)

        def run(test: Record) -> np.ndarray:
            known = max(lags, min(test.known, lags))
            late = test.known - known
            free = model.predict(X=test.U_test[late:], y=test.Y_test[late : late + known])
            return np.concatenate([test.Y_test[:late], np.asarray(free).reshape(-1, 1)])

        return run

    return fit


def run_arx(record: Record) -> np.ndarray | None:
    """Return the best ARX model's free run."""
    return choose(record, (arx(order, now) for order in ARX_ORDERS for now in (False, True)))


def run_subspace(record: Record) -> np.ndarray | None:
    """Return the best subspace model's free run."""
    return choose(record, (subspace(order, rows) for rows in SUBSPACE_ROWS for order in SUBSPACE_ORDERS))


def run_narx(record: Record) -> np.ndarray | None:
    """Return the best polynomial NARX model's free run; None where there are several outputs."""
    if record.Y_learn.shape[1] > 1:
        return None
    return choose(record, (narx(lags, degree) for degree in NARX_DEGREES for lags in NARX_LAGS))


YARDSTICKS: dict[str, Callable[[Record], np.ndarray | None]] = {
    "ARX": run_arx,
    "subspace": run_subspace,
    "NARX": run_narx,
}
