"""A lifted model around a set point: φ⁺ = A φ + B v + N (v ⊗ φ), φ = ψ(x) − ψ(x_s), v = u − u_s."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import CertificateError, DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value
from koopmpc.control.ask.cost import Cost
from koopmpc.lifting.base import Lifting, find_observables
from koopmpc.lifting.state import State
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor

_EXACT = 1e-8  # x has to be C ψ(x) up to this share of its size


@dataclass(frozen=True, eq=False)
class DeviationModel(Value):
    """The model without its constant observables, and without what it misses of the set point itself.

    Attributes
    ----------
    lifting
        ψ.
    kept
        (n,) the observables that are not constant.
    x, u
        (nx,), (nu,) the set point x_s, u_s.
    z
        (n,) ψ(x_s) of the kept observables.
    A, B, N
        (n, n), (n, nu) and (n, nu n); N = [N_1 … N_nu] is all zeros for a linear predictor.
    C
        (nx, n), x − x_s = C φ.
    defect
        (n,) what the model says of φ⁺ at φ = 0, v = 0; it is left out of the model and belongs to its error.
    """

    lifting: Lifting
    kept: Int[np.ndarray, " n"]
    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    z: Float[np.ndarray, " n"]
    A: Float[np.ndarray, "n n"]
    B: Float[np.ndarray, "n nu"]
    N: Float[np.ndarray, "n nun"]
    C: Float[np.ndarray, "nx n"]
    defect: Float[np.ndarray, " n"]

    def lift(self, X: ArrayLike) -> Float[np.ndarray, "... n"]:
        """Return φ of a state (nx,) or of rows of states (M, nx)."""
        return self.lifting(np.asarray(X, dtype=np.float64))[..., self.kept] - self.z

    def advance(self, phi: Float[np.ndarray, "M n"], v: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, "M n"]:
        """Return φ⁺ of rows φ and v as the model has it."""
        products = (v[:, :, None] * phi[:, None, :]).reshape(len(phi), -1)
        return phi @ self.A.T + v @ self.B.T + products @ self.N.T


def deviate(model: LinearPredictor | BilinearPredictor, x: ArrayLike, u: ArrayLike) -> DeviationModel:
    """Return the model around the set point (x, u)."""
    advice = "fit one with bilinear_edmd or edmd"
    checks.kind(model, "model", (LinearPredictor, BilinearPredictor), advice)
    if model.nu == 0:
        stable = float(np.abs(model.eigenvalues).max())
        raise DataError(
            f"the model has no inputs, so there is no feedback to find (its spectral radius is {stable:.4g}); fit it on"
            " episodes with U"
        )
    if model.embedding is not None:
        raise DataError("the model has delays, and a certificate needs the whole state; fit it without an embedding")
    if model.nw:
        raise DataError(
            "the model has measured disturbances, which a certificate does not know; fit it without W, or pass "
            "model.at(w) of a bilinear one"
        )
    x_s, u_s = checks.vector(x, "x", model.nx), checks.vector(u, "u", model.nu)
    C_missed = float(np.abs(model.C @ model.lifting(x_s) - x_s).max())
    if C_missed > _EXACT * (1 + float(np.abs(x_s).max())) or not _reads_states(model):
        raise DataError("the lifting does not hold every state, so no region of states follows; add km.State() to it")
    z = model.lifting(x_s)
    constant = model.lifting.constant_index
    kept = np.array([i for i in range(model.nz) if i != constant], dtype=np.int64)
    N = model.N if isinstance(model, BilinearPredictor) else np.zeros((model.nu, model.nz, model.nz))
    A = model.A + np.tensordot(u_s, N, 1)
    B = model.B + (N @ z).T
    defect = A @ z + model.B @ u_s - z
    return DeviationModel(
        model.lifting,
        kept,
        x_s,
        u_s,
        z[kept],
        np.ascontiguousarray(A[np.ix_(kept, kept)]),
        np.ascontiguousarray(B[kept]),
        np.hstack([Ni[np.ix_(kept, kept)] for Ni in N]),
        np.ascontiguousarray(model.C[:, kept]),
        defect[kept],
    )


@raise_swallowed()
def reduce_to_states(deviation: DeviationModel) -> DeviationModel:
    """Return the same model with φ = x − x_s: what it says of x⁺ to first order in φ around the set point.

    Observables that are nearly functions of one another on the data have directions that no data determine. There the
    whole lifting may have no certificate, and the states alone have one on a smaller region.
    """
    names = deviation.lifting.bound_states
    x = ca.SX.sym("x", len(names))
    slope = ca.Function("slope", [x], [ca.jacobian(deviation.lifting.symbolic(x), x)])
    D = np.asarray(ca.DM(slope(deviation.x)).full(), dtype=np.float64)[deviation.kept]
    C, nx, nu = deviation.C, len(names), len(deviation.u)
    N = deviation.N.reshape(len(C[0]), nu, -1)
    return DeviationModel(
        State().bind(names),
        np.arange(nx),
        deviation.x,
        deviation.u,
        deviation.x,
        C @ deviation.A @ D,
        C @ deviation.B,
        np.hstack([C @ N[:, i] @ D for i in range(nu)]),
        np.eye(nx),
        C @ deviation.defect,
    )


def measure_spending(
    deviation: DeviationModel,
    P: Float[np.ndarray, "n n"],
    K: Float[np.ndarray, "nu n"],
    K_w: Float[np.ndarray, "nu nun"],
    cost: Cost,
) -> float:
    """Return the least λ for which the stage cost is at most λ V in {V ≤ 1}, see `Certificate.weigh_end`."""
    of = cost.of.bind(deviation.lifting.bound_states)
    n, nu = len(P), len(K)
    Q, R = cost.matrices(of.nz, nu)
    if cost.rate(nu) is not None:
        raise DataError("Q_N is a certificate, and the cost has R_delta, which V does not know; leave R_delta out")
    place = {int(kept): i for i, kept in enumerate(deviation.kept)}
    S = np.zeros((of.nz, n))
    for row, index in enumerate(find_observables(deviation.lifting, of)):
        if int(index) in place:
            S[row, place[int(index)]] = 1.0
    root = np.linalg.cholesky(P)
    spent = K.T @ R @ K
    if np.abs(K_w).max(initial=0.0) > 0:
        # G = Σ_k (K_w)_k φ_k in the region: ‖G‖² ≤ Σ over the entries in the coordinates P^½
        parts = K_w.reshape(nu, nu, n) @ root
        gamma = float(np.linalg.norm(parts.reshape(nu * nu, n), 2)) if nu == 1 else float(np.linalg.norm(parts))
        if gamma >= 1:
            raise CertificateError(
                "the feedback of the certificate is a quotient whose input cannot be bounded in its region; certify a"
                " smaller region, or leave Q_N out"
            )
        spent = K.T @ K * float(np.linalg.norm(R, 2)) / (1 - gamma) ** 2
    return float(np.linalg.eigvalsh(root.T @ (S.T @ Q @ S + spent) @ root)[-1])


def is_stabilisable(model: DeviationModel, decay: float) -> bool:
    """Return whether inputs reach every mode of A with |λ|² ≥ ρ, by the rank test of Popov, Belevitch and Hautus."""
    return not find_stray_mode(model, decay)


def find_stray_mode(model: DeviationModel, decay: float) -> str:
    """Return |λ| of the fastest mode with |λ|² ≥ ρ that no input moves, and where it is largest; nothing if none."""
    A, B = model.A, model.B
    size = max(float(np.abs(A).max()), 1.0)
    reach = B / np.maximum(np.linalg.norm(B, axis=0), 1e-300)
    values, modes = np.linalg.eig(A)
    for i in np.argsort(-np.abs(values)):
        if abs(values[i]) ** 2 < decay:
            break
        least = np.linalg.svd(np.hstack([A - values[i] * np.eye(len(A)), reach]), compute_uv=False)[-1]
        # a mode with a smaller singular value, as a share of A, is out of reach of the inputs
        if least < 1e-9 * size:
            name = model.lifting.names[int(model.kept[int(np.argmax(np.abs(modes[:, i])))])]
            return f"|λ| = {abs(values[i]):.4g}, largest in {name}"
    return ""


def _reads_states(model: LinearPredictor | BilinearPredictor) -> bool:
    """Return whether C reads every state exactly: its rows are those of the states among the observables."""
    place = {name: i for i, name in enumerate(model.lifting.names)}
    if not set(model.states) <= set(place):
        return False
    rows = np.zeros((model.nx, model.nz))
    rows[np.arange(model.nx), [place[name] for name in model.states]] = 1.0
    return bool(np.abs(model.C - rows).max() < _EXACT)
