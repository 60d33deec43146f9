"""The one door to cvxpy for proofs: a feedback, and the ellipsoid in which it is proved to be stable, by one program.

A bilinear model and its error, in deviations φ of the lifted state and v of the input:

    φ⁺ = A φ + B v + N w + S^½ q;   w = v ⊗ φ;   v = K φ + K_w w;   ‖q‖ ≤ c_x ‖φ‖ + c_u ‖v‖.

Three lines about every φ with φᵀE⁻¹φ ≤ 1 give the program by the S-procedure. They use any Λ ≻ 0 and τ = τ_x + τ_u > 0.

    wᵀ(Λ⁻¹⊗E⁻¹) w ≤ vᵀΛ⁻¹v;
    ‖q‖² ≤ c_x² (τ/τ_x) ‖φ‖² + c_u² (τ/τ_u) ‖v‖²;   because (a + b)² ≤ a²/s + b²/(1 − s).
    φ⁺ᵀP⁻¹φ⁺ − ρ φᵀP⁻¹φ + [vᵀΛ⁻¹v − wᵀ(Λ⁻¹⊗E⁻¹)w] + [c_x²/τ_x ‖φ‖² + c_u²/τ_u ‖v‖² − ‖q‖²/τ] ≤ 0.

The last line is what has to hold for all φ, w and q: then V = φᵀP⁻¹φ falls by the factor ρ. Schur's complement and the
congruence by diag(P, Λ⊗I, τI) make it linear in P, L = K P, L_w = K_w (Λ⊗I), Λ, τ_x and τ_u.

Source of the method: Strässer, Schaller, Worthmann, Berberich, Allgöwer, arXiv 2402.03145 and 2411.10359. There τ_x and
τ_u are equal; here the program chooses them.
"""

import warnings
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.interrupts import call_uninterrupted

_STRICT = 1e-7  # least eigenvalue that the program asks of its matrices, in scaled coordinates
_SOLVED = ("optimal", "optimal_inaccurate")  # the solver's word is checked afterwards in either case


@dataclass(frozen=True)
class FeedbackTask:
    """What the program is about, in coordinates in which entries of φ and v are about one.

    Attributes
    ----------
    A, B, N
        (n, n), (n, m) and (n, m n); N is None for a linear model.
    S
        (n, n) shape of the error, ⪰ 0.
    c_x, c_u
        Its bound.
    E
        (n, n) the ellipsoid in which products v ⊗ φ are bounded.
    inputs
        (m,) largest |v_i|, inf where there is no limit.
    rows
        (p, n) rows h of limits |h φ| ≤ 1.
    volume
        (k, n) coordinates whose ellipsoid is made large.
    decay
        ρ.
    """

    A: Float[np.ndarray, "n n"]
    B: Float[np.ndarray, "n m"]
    N: Float[np.ndarray, "n mn"] | None
    S: Float[np.ndarray, "n n"]
    c_x: float
    c_u: float
    E: Float[np.ndarray, "n n"]
    inputs: Float[np.ndarray, " m"]
    rows: Float[np.ndarray, "p n"]
    volume: Float[np.ndarray, "k n"]
    decay: float


@dataclass(frozen=True)
class FeedbackProof:
    """A solution: P, K, K_w (m, m n; zeros for a linear model), Λ, τ_x, τ_u, and the margin with which it was checked.

    `margin` is the least eigenvalue of the last line of this file's first text, with its sign turned and in
    coordinates in which the three diagonal blocks are the identity; a proof has one above zero. `size` is log det of
    the ellipsoid in the coordinates `volume`.
    """

    P: Float[np.ndarray, "n n"]
    K: Float[np.ndarray, "m n"]
    K_w: Float[np.ndarray, "m mn"]
    Lambda: Float[np.ndarray, "m m"]
    tau_x: float
    tau_u: float
    margin: float
    size: float


def solve_feedback(task: FeedbackTask, *, linear: bool = False) -> FeedbackProof | None:
    """Return the feedback with the largest ellipsoid that the program finds, and that the checks confirm, or None.

    Parameters
    ----------
    task
        The model, its error and the limits.
    linear
        Keep K_w = 0, so that v = K φ.
    """
    model: Any = import_module("cvxpy")  # slow
    # inside, φ = T φ̂ with E = T Tᵀ and v = g v̂ with inputs of unit effect: the ellipsoid is the unit ball
    T = _root(task.E)
    back = np.linalg.inv(T)
    g = 1 / np.maximum(np.linalg.norm(back @ task.B, axis=0), 1e-9)
    A, B, S = back @ task.A @ T, back @ task.B * g, back @ task.S @ back.T
    N = None if task.N is None else back @ task.N @ np.kron(np.diag(g), T)
    n, m = B.shape
    P: Any = model.Variable((n, n), symmetric=True)
    L: Any = model.Variable((m, n))
    tau_x, tau_u = model.Variable(nonneg=True), model.Variable(nonneg=True)
    lam: Any = model.Variable((m, m), symmetric=True) if N is not None else model.Constant(np.eye(m))
    products = 0 if N is None else m * n
    eye_n, eye_m = np.eye(n), np.eye(m)

    def zeros(*shape: int) -> Any:
        return np.zeros(shape)

    moved, fed = [A @ P + B @ L], [L]  # φ⁺ and v as rows on the scaled [φ; w]
    diagonal = [task.decay * P]
    if N is not None:
        L_w: Any = zeros(m, products) if linear else model.Variable((m, products))
        moved.append(N @ model.kron(lam, eye_n) + B @ L_w)
        fed.append(L_w)
        diagonal.append(model.kron(lam, eye_n))
    else:
        L_w = zeros(m, 0)
    first = sum(n if i == 0 else products for i in range(len(diagonal)))
    top = (
        diagonal[0] if N is None else model.bmat([[diagonal[0], zeros(n, products)], [zeros(products, n), diagonal[1]]])
    )
    v, next_state = model.hstack(fed), model.hstack(moved)
    held = model.hstack([P, zeros(n, first - n)]) if first > n else P
    c = max(task.c_x, task.c_u)
    unit = np.sqrt(c) if c > 0 else 1.0  # τ = c θ, and rows divided by √c: all entries are then of one size
    below = [next_state, np.diag(task.c_u / unit * g) @ v, task.c_x / unit * T @ held]
    corner = [P - c * (tau_x + tau_u) * S, tau_u * eye_m, tau_x * eye_n]
    if N is not None:
        below.append(v)
        corner.append(lam)
    exact = task.c_x == 0 and task.c_u == 0
    keep = [0, *([] if exact else [1, 2]), *([3] if N is not None else [])]
    below, corner = [below[i] for i in keep], [corner[i] for i in keep]
    if exact:
        corner[0] = P
    sizes = [part.shape[0] for part in corner]
    rows = [[top, *(part.T for part in below)]]
    for i, part in enumerate(below):
        rows.append([part, *(corner[i] if i == j else zeros(sizes[i], sizes[j]) for j in range(len(below)))])
    F = model.bmat(rows)
    constraints = [
        (F + F.T) / 2 >> _STRICT * np.eye(first + sum(sizes)),
        P >> _STRICT * eye_n,
    ]
    if N is not None:
        constraints += [eye_n - P >> 0, lam >> _STRICT * eye_m]
    for row in task.rows @ T:
        constraints.append(row @ P @ row <= 1)
    for i in np.flatnonzero(np.isfinite(task.inputs)):
        width = np.array([[(task.inputs[i] / g[i]) ** 2]])
        if N is None:
            G = model.bmat([[P, L[[i]].T], [L[[i]], width]])
        else:
            G = model.bmat(
                [
                    [top, v[[i]].T, v.T],
                    [v[[i]], width, zeros(1, m)],
                    [v, zeros(m, 1), lam],
                ]
            )
        constraints.append((G + G.T) / 2 >> 0)
    C = task.volume @ T
    problem: Any = model.Problem(model.Maximize(model.log_det(C @ P @ C.T)), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an inaccurate solution is checked below, as every other one
        try:
            call_uninterrupted(lambda: problem.solve(solver=model.CLARABEL))
        except (model.error.SolverError, ValueError, ArithmeticError):
            return None
    if problem.status not in _SOLVED or P.value is None:
        return None
    found, Lambda = _symmetric(P.value), _symmetric(lam.value)
    if min(np.linalg.eigvalsh(found)[0], np.linalg.eigvalsh(Lambda)[0]) <= 0:
        return None
    K = g[:, None] * (L.value @ np.linalg.inv(found)) @ back
    K_w = np.zeros((m, n * m))
    if N is not None and not isinstance(L_w, np.ndarray):
        K_w = g[:, None] * (L_w.value @ np.kron(np.linalg.inv(Lambda), eye_n)) @ np.kron(np.diag(1 / g), back)
    found, Lambda = _symmetric(T @ found @ T.T), g[:, None] * Lambda * g
    taus = (0.0, 0.0) if exact else (c * float(tau_x.value), c * float(tau_u.value))
    return check_feedback(task, found, K, K_w, Lambda, *taus)


def check_feedback(
    task: FeedbackTask,
    P: Float[np.ndarray, "n n"],
    K: Float[np.ndarray, "m n"],
    K_w: Float[np.ndarray, "m mn"],
    Lambda: Float[np.ndarray, "m m"],
    tau_x: float,
    tau_u: float,
) -> FeedbackProof | None:
    """Return the solution shrunk until it keeps every limit, with its margin, or None where that is not above zero.

    The check does not use the program: it evaluates the condition on V itself, and the limits, in plain arithmetic.
    """
    over = [float(row @ P @ row) for row in task.rows]
    if task.N is not None:
        over.append(float(np.linalg.eigvalsh(np.linalg.solve(_root(task.E), np.linalg.solve(_root(task.E), P).T))[-1]))
    level = 1 / max([1.0, *over])  # {V ≤ level} of a valid V is valid, too
    n = len(P)
    rest = 1e-12 * n
    margin = _decay_margin(task, P, K, K_w, Lambda, tau_x, tau_u)
    if margin <= rest:
        return None
    for i in np.flatnonzero(np.isfinite(task.inputs)):
        level = min(level, _input_level(task, P, K, K_w, Lambda, int(i)))
    if level < 0.5:  # the solver's answer is far from what it claims
        return None
    shrunk = P * level * (1 - 1e-9)
    # {V ≤ level} in the old P is {V' ≤ 1} in the new one; V' is a multiple of V, so the decrease carries over.
    C = task.volume
    return FeedbackProof(shrunk, K, K_w, Lambda, tau_x, tau_u, margin, float(np.linalg.slogdet(C @ shrunk @ C.T)[1]))


def _decay_margin(
    task: FeedbackTask,
    P: Float[np.ndarray, "n n"],
    K: Float[np.ndarray, "m n"],
    K_w: Float[np.ndarray, "m mn"],
    Lambda: Float[np.ndarray, "m m"],
    tau_x: float,
    tau_u: float,
) -> float:
    """Return the least eigenvalue of the decrease of V in the coordinates P^½, (Λ⊗E)^½ and τ^½ of φ, w and q."""
    n, exact = len(P), task.c_x == 0 and task.c_u == 0
    if not exact and min(tau_x, tau_u) <= 0:
        return -np.inf
    F = _root(P)
    columns = [(task.A + task.B @ K) @ F]
    fed = [K @ F]
    if task.N is not None:
        W = np.kron(_root(Lambda), _root(task.E))
        columns.append((task.N + task.B @ K_w) @ W)
        fed.append(K_w @ W)
    errors = 0 if exact else n
    v = np.hstack([*fed, np.zeros((len(K), errors))])
    if not exact:
        columns.append(np.asarray(float(np.sqrt(tau_x + tau_u)) * _root(task.S), dtype=np.float64))
    size = v.shape[1]
    rows: list[Any] = [np.linalg.solve(F, np.hstack(columns))]
    if task.N is not None:
        rows.append(np.linalg.solve(_root(Lambda), v))
    if not exact:
        rows += [task.c_u / np.sqrt(tau_u) * v, task.c_x / np.sqrt(tau_x) * np.hstack([F, np.zeros((n, size - n))])]
    G = np.vstack(rows)
    ones = np.ones(size)
    ones[:n] = task.decay
    return float(np.linalg.eigvalsh(np.diag(ones) - G.T @ G)[0])


def _input_level(
    task: FeedbackTask,
    P: Float[np.ndarray, "n n"],
    K: Float[np.ndarray, "m n"],
    K_w: Float[np.ndarray, "m mn"],
    Lambda: Float[np.ndarray, "m m"],
    i: int,
) -> float:
    """Return the largest level of V at which |v_i| is proved to keep its limit, 1 at most."""
    F = _root(P)
    if task.N is None:
        return min(1.0, float(task.inputs[i] ** 2 / max(((K[i] @ F) ** 2).sum(), 1e-300)))
    W = np.kron(_root(Lambda), _root(task.E))
    v = np.hstack([K @ F, K_w @ W])
    inside = np.linalg.solve(_root(Lambda), v)
    room = np.eye(v.shape[1]) - inside.T @ inside  # V + what the products may add
    least = float(np.linalg.eigvalsh(room)[0])
    if least <= 0:
        return 0.0
    row = np.asarray(v[i], dtype=np.float64)
    reach = float(row @ np.asarray(np.linalg.solve(room, row)))
    return min(1.0, float(task.inputs[i] ** 2 / max(reach, 1e-300)))


def _root(P: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the symmetric root of P ⪰ 0."""
    values, vectors = np.linalg.eigh(P)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def _symmetric(P: Any) -> Float[np.ndarray, "n n"]:
    matrix = np.atleast_2d(np.asarray(P, dtype=np.float64))
    return (matrix + matrix.T) / 2
