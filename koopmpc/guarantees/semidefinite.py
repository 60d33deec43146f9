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
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base.interrupts import call_uninterrupted

_STRICT = 1e-7  # least eigenvalue that the program asks of its matrices, in scaled coordinates
_SOLVED = ("optimal", "optimal_inaccurate")  # the solver's word is checked afterwards in either case


@dataclass(frozen=True)
class FeedbackTask:
    """What the program is about, in coordinates in which entries of φ and v are about one."""

    # A, B, N: (n, n), (n, m) and (n, m n); a linear model has no N
    A: Float[np.ndarray, "n n"]
    B: Float[np.ndarray, "n m"]
    N: Float[np.ndarray, "n mn"] | None
    S: Float[np.ndarray, "n n"]  # (n, n) shape of the error, ⪰ 0
    # c_x, c_u: its bound
    c_x: float
    c_u: float
    E: Float[np.ndarray, "n n"]  # (n, n) the ellipsoid in which products v ⊗ φ are bounded
    inputs: Float[np.ndarray, " m"]  # (m,) largest |v_i|, inf where there is no limit
    rows: Float[np.ndarray, "p n"]  # (p, n) rows h of limits |h φ| ≤ 1
    volume: Float[np.ndarray, "k n"]  # (k, n) coordinates whose ellipsoid is made large
    decay: float  # ρ


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
    margin: float = np.nan
    size: float = np.nan


def solve_feedback(task: FeedbackTask, *, linear: bool = False) -> FeedbackProof | None:
    """Return the feedback with the largest ellipsoid that the program finds, and that the checks confirm, or None."""
    program = _Program(task, linear)
    return check_feedback(task, program.solution()) if program.solve() else None


class _Program:
    """The program in coordinates φ = T φ̂ with E = T Tᵀ and v = g v̂ with inputs of unit effect.

    The ellipsoid E is the unit ball there. `v` and `next` are v̂ and φ̂⁺ as rows on [φ̂; ŵ], scaled by `top`.
    """

    def __init__(self, task: FeedbackTask, linear: bool) -> None:
        model: Any = import_module("cvxpy")  # slow
        self.task, self.model = task, model
        self.T = _root(task.E)
        self.back = np.linalg.inv(self.T)
        self.g = 1 / np.maximum(np.linalg.norm(self.back @ task.B, axis=0), 1e-9)
        A, B = self.back @ task.A @ self.T, self.back @ task.B * self.g
        (n, m), self.exact = B.shape, task.c_x == 0 and task.c_u == 0
        self.P: Any = model.Variable((n, n), symmetric=True)
        self.L: Any = model.Variable((m, n))
        self.tau_x, self.tau_u = model.Variable(nonneg=True), model.Variable(nonneg=True)
        c = max(task.c_x, task.c_u)
        self.c = c
        self.unit = np.sqrt(c) if c > 0 else 1.0  # rows count over √c, and τ over c: entries are of one size
        self.next, self.v, self.held = A @ self.P + B @ self.L, self.L, self.P
        self.top: Any = task.decay * self.P
        self.lam: Any = None
        self.L_w: Any = None
        if task.N is not None:
            N, nothing = self.back @ task.N @ np.kron(np.diag(self.g), self.T), np.zeros((n, m * n))
            self.lam = model.Variable((m, m), symmetric=True)
            self.L_w = np.zeros((m, m * n)) if linear else model.Variable((m, m * n))
            products = model.kron(self.lam, np.eye(n))
            self.next = model.hstack([self.next, N @ products + B @ self.L_w])
            self.v, self.held = model.hstack([self.L, self.L_w]), model.hstack([self.P, nothing])
            self.top = model.bmat([[self.top, nothing], [nothing.T, products]])

    def _arrow(self, top: Any, rows: list[tuple[Any, Any]]) -> Any:
        """Return the symmetric matrix of a block, of rows below it, and of the block on the diagonal of each row."""
        sizes = [part.shape[0] for part, _ in rows]
        blocks = [[top, *(part.T for part, _ in rows)]]
        for i, (part, corner) in enumerate(rows):
            blocks.append([part, *(corner if i == j else np.zeros((sizes[i], sizes[j])) for j in range(len(rows)))])
        F = self.model.bmat(blocks)
        return (F + F.T) / 2

    def decrease(self) -> Any:
        """Return the matrix that is positive where V falls by the factor ρ."""
        task, (n, m) = self.task, self.task.B.shape
        S = self.back @ task.S @ self.back.T
        rows = [(self.next, self.P if self.exact else self.P - self.c * (self.tau_x + self.tau_u) * S)]
        if not self.exact:
            rows.append((np.diag(task.c_u / self.unit * self.g) @ self.v, self.tau_u * np.eye(m)))
            rows.append((task.c_x / self.unit * self.T @ self.held, self.tau_x * np.eye(n)))
        if self.lam is not None:
            rows.append((self.v, self.lam))
        return self._arrow(self.top, rows)

    def constraints(self) -> list[Any]:
        """Return the decrease of V, the ellipsoid inside E, and the limits of states and inputs."""
        task, P, lam = self.task, self.P, self.lam
        F, (n, m) = self.decrease(), task.B.shape
        found = [F >> _STRICT * np.eye(F.shape[0]), P >> _STRICT * np.eye(n)]
        if lam is not None:
            found += [np.eye(n) - P >> 0, lam >> _STRICT * np.eye(m)]
        found += [row @ P @ row <= 1 for row in task.rows @ self.T]
        for i in np.flatnonzero(np.isfinite(task.inputs)):
            width = np.array([[(task.inputs[i] / self.g[i]) ** 2]])
            rows = [(self.v[[i]], width)] if lam is None else [(self.v[[i]], width), (self.v, lam)]
            found.append(self._arrow(P if lam is None else self.top, rows) >> 0)
        return found

    def solve(self) -> bool:
        """Return whether the solver gave an answer with P ≻ 0 and Λ ≻ 0."""
        model, C = self.model, self.task.volume @ self.T
        problem: Any = model.Problem(model.Maximize(model.log_det(C @ self.P @ C.T)), self.constraints())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an inaccurate solution is checked as every other one
            try:
                call_uninterrupted(lambda: problem.solve(solver=model.CLARABEL))
            except (model.error.SolverError, ValueError, ArithmeticError):
                return False
        if problem.status not in _SOLVED or self.P.value is None:
            return False
        values = [self.P.value] if self.lam is None else [self.P.value, self.lam.value]
        return all(np.linalg.eigvalsh(_symmetric(value))[0] > 0 for value in values)

    def solution(self) -> FeedbackProof:
        """Return what the solver claims in the coordinates of the task, before it is checked."""
        g, T, back, (n, m) = self.g, self.T, self.back, self.task.B.shape
        P = _symmetric(self.P.value)
        Lambda = np.eye(m) if self.lam is None else _symmetric(self.lam.value)
        K = g[:, None] * (self.L.value @ np.linalg.inv(P)) @ back
        K_w = np.zeros((m, n * m))
        if self.L_w is not None and not isinstance(self.L_w, np.ndarray):
            products = np.kron(np.linalg.inv(Lambda), np.eye(n))
            K_w = g[:, None] * (self.L_w.value @ products) @ np.kron(np.diag(1 / g), back)
        taus = (0.0, 0.0) if self.exact else (self.c * float(self.tau_x.value), self.c * float(self.tau_u.value))
        return FeedbackProof(_symmetric(T @ P @ T.T), K, K_w, g[:, None] * Lambda * g, *taus)


def check_feedback(task: FeedbackTask, claimed: FeedbackProof) -> FeedbackProof | None:
    """Return the solution shrunk until it keeps every limit, with its margin, or None where that is not above zero.

    The check does not use the program: it evaluates the condition on V itself, and the limits, in plain arithmetic.
    """
    P = claimed.P
    over = [float(row @ P @ row) for row in task.rows]
    if task.N is not None:
        over.append(float(np.linalg.eigvalsh(np.linalg.solve(_root(task.E), np.linalg.solve(_root(task.E), P).T))[-1]))
    level = 1 / max([1.0, *over])  # {V ≤ level} of a valid V is valid, too
    margin = _decay_margin(task, claimed)
    if margin <= 1e-12 * len(P):
        return None
    for i in np.flatnonzero(np.isfinite(task.inputs)):
        level = min(level, _input_level(task, claimed, int(i)))
    if level < 0.5:  # the solver's answer is far from what it claims
        return None
    shrunk = P * level * (1 - 1e-9)
    # {V ≤ level} in the old P is {V' ≤ 1} in the new one; V' is a multiple of V, so the decrease carries over.
    C = task.volume
    return replace(claimed, P=shrunk, margin=margin, size=float(np.linalg.slogdet(C @ shrunk @ C.T)[1]))


def _decay_margin(task: FeedbackTask, proof: FeedbackProof) -> float:
    """Return the least eigenvalue of the decrease of V in the coordinates P^½, (Λ⊗E)^½ and τ^½ of φ, w and q."""
    P, K, K_w, Lambda, tau_x, tau_u = proof.P, proof.K, proof.K_w, proof.Lambda, proof.tau_x, proof.tau_u
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


def _input_level(task: FeedbackTask, proof: FeedbackProof, i: int) -> float:
    """Return the largest level of V at which |v_i| is proved to keep its limit, 1 at most."""
    F, K, K_w, Lambda = _root(proof.P), proof.K, proof.K_w, proof.Lambda
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
