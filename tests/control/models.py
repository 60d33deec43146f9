"""Small systems, and the finite-horizon problem written a second and a third time: dense, and in CVXPY."""

import numpy as np
import pytest
import scipy.linalg

import koopmpc as km
from koopmpc.control.solvers import SOLVERS
from tests.example_plants import linear as linear
from tests.example_plants import random_pair as random_pair
from tests.example_plants import step_map as step_map

PRECISE = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100_000}


class Told:
    """An estimator of a user's own: y is the state, and d what it was told."""

    def __init__(self, d):
        self.given = np.asarray(d, dtype=float)

    def start(self, predictor, horizon):
        return Telling(self.given, predictor)


class Telling:
    def __init__(self, d, predictor):
        self.d, self.ny, self.predictor = d, predictor.nx, predictor
        self.z = np.zeros(predictor.nz)

    def reset(self, x0=None):
        """d stays what it is."""

    def update(self, predictor):
        self.predictor = predictor

    def observe(self, y, u, w):
        if np.isfinite(y).all():
            self.z = self.predictor.lift(y)
        return bool(np.isfinite(y).all())


def equilibrium(A, B, C, Q, r, constant=None, R=None):
    """(z_r, u_r) by null spaces and least squares; the index `constant` is pinned to 1; of several the least ‖u‖_R."""
    nz = len(A)
    E = np.hstack([A - np.eye(nz), B])
    keep = [i for i in range(nz) if i != constant]
    free = keep + list(range(nz, E.shape[1]))
    base = np.zeros(E.shape[1])
    span = np.zeros((E.shape[1], 0))
    E = E[keep]
    basis = scipy.linalg.null_space(E[:, free])
    span = np.zeros((len(base), basis.shape[1]))
    span[free] = basis
    if constant is not None:
        base[constant] = 1.0
        base[free] = np.linalg.lstsq(E[:, free], -E[:, constant], rcond=None)[0]
    S = scipy.linalg.sqrtm(Q).real
    alpha = np.linalg.lstsq(S @ C @ span[:nz], S @ (r - C @ base[:nz]), rcond=None)[0]
    v = base + span @ alpha
    more = span @ scipy.linalg.null_space(S @ C @ span[:nz], rcond=1e-9)
    if R is not None and more.shape[1]:
        T = scipy.linalg.sqrtm(R).real
        v = v - more @ np.linalg.lstsq(T @ more[nz:], T @ v[nz:], rcond=1e-9)[0]
    return v[:nz], v[nz:]


def tail(model, cost, r, u_r, push=None, C=None, steps=600):
    """(F, h) of the tail's cost ‖F ξ − h‖² + const, ξ = z or [z; u_{k−1}], by orthogonal elimination of its inputs."""
    A, B, C = model.A, model.B, model.C if C is None else C
    (nz, nu), push = B.shape, np.zeros(len(A)) if push is None else push
    Q, R = (scipy.linalg.sqrtm(M).real for M in cost.matrices(len(C), nu))
    rated = cost.R_delta is not None
    if rated:
        A, B = scipy.linalg.block_diag(A, np.zeros((nu, nu))), np.vstack([B, np.eye(nu)])
        push = np.append(push, np.zeros(nu))
    n = len(A)
    at = np.hstack([Q @ C, np.zeros((len(C), n - nz))])  # every state of the tail is weighed by Q
    F, h = at, Q @ r
    for _ in range(steps):
        rows = [(F @ B, F @ A, h - F @ push), (R, np.zeros((nu, n)), R @ u_r), (np.zeros((len(at), nu)), at, Q @ r)]
        if rated:
            S = scipy.linalg.sqrtm(cost.rate(nu)).real
            rows.append((S, np.hstack([np.zeros((nu, nz)), -S]), np.zeros(nu)))
        left = np.linalg.qr(np.vstack([np.hstack([u, x, y[:, None]]) for u, x, y in rows]), mode="r")
        F, h = left[nu:, nu:-1], left[nu:, -1]
    return F, h


def end_of(model, cost, targets, rows, push=None, C=None):
    """(F, h) of the terminal cost ‖F ξ_N − h‖²: a Q_N on the state or on z, or the tail."""
    if cost.Q_N is None:
        assert cost.tail is not None or model.report is None  # a learned model has a default of its own
        steps = 600 if cost.tail is None else cost.tail
        return tail(model, cost, rows[-1], targets[-1][1], push, C, steps)
    P = np.asarray(cost.Q_N)
    root = scipy.linalg.sqrtm(np.diag(P) if P.ndim == 1 else P).real
    if len(P) == model.nx:
        return root @ (model.C if C is None else C), root @ rows[-1]
    return root, root @ targets[-1][0]


def dense_plan(model, cost, z0, rows, targets, C=None):
    """The unconstrained plan U (N, nu) as one least-squares problem in the inputs."""
    C = model.C if C is None else C
    A, B = model.A, model.B
    N, nu = len(rows) - 1, model.nu
    Q, R = cost.matrices(len(C), nu)
    root = lambda M: scipy.linalg.sqrtm(M).real  # noqa: E731
    F, h = end_of(model, cost, targets, rows, C=C)
    blocks, right = [], []
    Z, D = np.array(z0), np.zeros((len(A), N * nu))
    for k in range(N):
        pick = np.eye(nu, N * nu, k * nu)
        blocks.append(root(R) @ pick)
        right.append(root(R) @ targets[k][1])
        Z, D = A @ Z, A @ D + B @ pick
        if k + 1 < N:
            blocks.append(root(Q) @ C @ D)
            right.append(root(Q) @ (rows[k + 1] - C @ Z))
        else:
            blocks.append(F @ D)
            right.append(h - F @ Z)
    return np.linalg.lstsq(np.vstack(blocks), np.concatenate(right), rcond=None)[0].reshape(N, nu)


def in_coordinates(wanted, controller=km.KoopmanMPC):
    """Return what makes a controller whose QP is in these coordinates, whatever is usually chosen; None leaves the choice."""

    def build(*arguments, **options):
        with pytest.MonkeyPatch.context() as patch:
            for solver in SOLVERS.values() if wanted else ():
                patch.setattr(solver, "coordinates", wanted)
            return controller(*arguments, **options)

    return build


def with_disturbances(model, E):
    return km.LinearPredictor(model.A, model.B, model.C, model.lifting, model.dt, model.states, model.inputs, E=E)
