"""Random QPs of a seeded generator, of the shapes that a KoopmanMPC makes, and a KKT check row by row."""

import numpy as np

from koopmpc.control.solvers import SOLVERS as SOLVERS
from koopmpc.control.solvers.base import QP as QP
from koopmpc.control.solvers.base import QPSolver as QPSolver
from koopmpc.control.solvers.osqp import DEFAULTS as DEFAULTS

KINDS = ("box", "hard", "soft", "exact", "dense", "degenerate", "singular", "scaled", "infeasible")
FEASIBLE = tuple(kind for kind in KINDS if kind != "infeasible")


def random_qp(rng, kind, N=None):
    """Return a QP of N stages; all but the "infeasible" ones hold a point that is known to be feasible."""
    N = int(rng.integers(1, 9)) if N is None else N
    P, q, inside = np.eye(N), np.zeros(N), rng.normal(size=N)
    A = np.vstack([np.tril(rng.normal(size=(N, N))) for _ in range(2)])
    if kind == "box":
        A, q = np.eye(N), 3 * rng.normal(size=N)
    if kind in ("dense", "degenerate"):
        half = rng.normal(size=(N, N))
        P, q = half @ half.T + 10.0 ** rng.uniform(-3, 0) * np.eye(N), 3 * rng.normal(size=N)
        A = rng.normal(size=(int(rng.integers(0, 3 * N + 1)), N)) if kind == "dense" else A
    if kind == "singular":
        half = rng.normal(size=(N, (N + 1) // 2))
        P = half @ half.T
        q = P @ rng.normal(size=N)
    at = A @ inside
    low = at - rng.choice([0.01, 0.1, 1.0, np.inf], len(A))
    high = at + rng.choice([0.01, 0.1, 1.0, np.inf], len(A))
    if kind in ("soft", "exact") or (kind == "scaled" and rng.random() < 0.5):
        return _scaled(rng, _softened(rng, A, low, high, kind == "exact"), kind)
    if kind == "degenerate":
        A, low, high = _repeated(rng, A, low, high, inside)
    if kind == "infeasible":
        A, low, high = _contradicted(rng, A, low, high)
    return _scaled(rng, QP(P, q, A, low, high), kind)


def _softened(rng, A, low, high, exact):
    """The rows after the first n get slacks: a linear weight, and a quadratic one unless `exact`."""
    n, k = A.shape[1], len(A) - A.shape[1]
    A = np.block([[A, np.vstack([np.zeros((n, k)), -np.eye(k)])], [np.zeros((k, n)), np.eye(k)]])
    low = np.concatenate([low[:n], np.full(k, -np.inf), np.zeros(k)])
    high = np.concatenate([high[:n], high[n:] - rng.choice([0.0, 5.0]), np.full(k, np.inf)])
    quadratic = 0.0 if exact else 10.0 ** rng.uniform(-2, 4)
    P = np.diag(np.append(np.ones(n), np.full(k, quadratic)))
    return QP(P, np.append(np.zeros(n), np.full(k, 10.0 ** rng.uniform(-2, 4))), A, low, high)


def _repeated(rng, A, low, high, inside):
    """Rows stand there twice, in other units and signs too; some are equalities, one is empty."""
    pick, factor = rng.integers(0, len(A), len(A)), rng.choice([1.0, -1.0, 2.0, 1e-3], len(A))
    ends = low[pick] * factor, high[pick] * factor
    A = np.vstack([A, A[pick] * factor[:, None]])
    low, high = np.append(low, np.minimum(*ends)), np.append(high, np.maximum(*ends))
    same = rng.random(len(A)) < 0.2
    low[same] = high[same] = (A @ inside)[same]
    empty = rng.choice([0.0, -1.0]), rng.choice([0.0, np.inf])
    return np.vstack([A, np.zeros(A.shape[1])]), np.append(low, empty[0]), np.append(high, empty[1])


def _contradicted(rng, A, low, high):
    """One combination of the rows is limited from below, and again from above by less."""
    row = A[rng.integers(len(A))] if rng.random() < 0.5 else rng.normal(size=len(A)) @ A
    level, gap, factor = rng.normal(), 10.0 ** rng.uniform(-3, 2), rng.choice([1.0, -2.0])
    end = factor * (level - gap)
    second = (-np.inf, end) if factor > 0 else (end, np.inf)
    A = np.vstack([A, row, factor * row])
    return A, np.append(low, [level, second[0]]), np.append(high, [np.inf, second[1]])


def _scaled(rng, qp, kind):
    """Rows and cost in units from 1e-6 to 1e6, variables from 1e-3 to 1e3."""
    if kind != "scaled":
        return qp
    m, n = qp.A.shape
    row, column, cost = (
        10.0 ** rng.uniform(-6, 6, m),
        10.0 ** rng.uniform(-3, 3, n),
        10.0 ** rng.uniform(-6, 6),
    )
    P = cost * qp.P * np.outer(column, column)
    return QP(P, cost * qp.q * column, qp.A * column * row[:, None], qp.low * row, qp.high * row)


def exactness(qp, v, y, least=1e-300):
    """Return the largest violation of the KKT conditions, relative, in the units of the cost.

    Stationarity P v + q + Aᵀy = 0 by the size of its terms; low ≤ A v ≤ high, and A v at the end that y pushes
    to, by the limit and ‖aᵢ‖ times ‖v‖ and the ‖P⁻¹q‖ of no limits, the variables measured in 1/√Pⱼⱼ. `least` is the
    smallest size of a row.
    """
    if not (np.isfinite(v).all() and np.isfinite(y).all()):
        return np.inf
    curved = np.diag(qp.P) > 0
    unit = 1 / np.sqrt(np.diag(qp.P)[curved])
    units = np.full(len(v), unit.max(initial=0.0) if curved.any() else 1.0)
    units[curved] = unit
    terms = np.abs(qp.P) @ np.abs(v) + np.abs(qp.q) + np.abs(qp.A.T) @ np.abs(y)
    still = np.abs(qp.P @ v + qp.q + qp.A.T @ y) * units / max((terms * units).max(), 1e-300)
    Av = qp.A @ v
    near = np.clip(Av, qp.low, qp.high)
    rows = np.linalg.norm(qp.A * units, axis=1)
    size = rows * (np.linalg.norm(v / units) + np.linalg.norm(qp.q * units)) + np.abs(near) + least
    push = rows * np.abs(y)
    end = np.where(y > 0, qp.high, np.where(y < 0, qp.low, Av))
    away = np.where(push > 1e-9 * (terms * units).max(), np.abs(Av - end), np.abs(Av - near)) / size
    return max(float(part.max(initial=0.0)) for part in (still, away))
