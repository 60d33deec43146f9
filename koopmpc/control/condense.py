"""Condense: the whole horizon as matrices of the lifted state and all known signals; builds, and never solves.

In Riccati coordinates, u_j = −K_j ξ_j + v_j f + √unit L_j⁻ᵀ w_j with S_j = R + BᵀP_{j+1}B = L_j L_jᵀ, the cost is
constant + unit · Σ ‖w_j‖²: w = 0 is the unconstrained optimum, and the Hessian is the identity even where the plant is
unstable and plain condensing (u as the variable) has lost all its digits. In plain coordinates w is u less its
unconstrained optimum, and the Hessian is what the Riccati coordinates say of it.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg
from jaxtyping import Float

from koopmpc.control.horizon import Horizon
from koopmpc.control.riccati import Law
from koopmpc.control.target import Targets

Coordinates = Literal["auto", "riccati", "plain"]
# cond(H) up to which OSQP in plain coordinates is no slower. Measured on random plants: limits on inputs alone take
# up to half the time from 1e3 to 1e5 and 25 times as much beyond 1e6; with limited outputs 4 times as much from 3e4.
WELL_CONDITIONED = 1e3
INPUTS_ALONE = 1e5


@dataclass(frozen=True)
class Condensed:
    """v = [u_0 …; u_0 − u_{−1} …; G z_1 … G z_N] = F_x ξ_0 + F_r r + F_α α + F_g g + f + D w, a u a block.

    ξ_0 is z_0, or [z_0; u_{−1}]; r holds the N + 1 reference rows one after the other, α the targets' coordinates of
    the same rows, g the preview of disturbances. The changes of u are there where they have limits.

    Above the unconstrained optimum the cost is unit · wᵀH w, unit the mean diagonal of S_0: w has the size of u, and
    a cost in other units gives the same QP.
    """

    from_state: Float[np.ndarray, "n nx"]
    from_reference: Float[np.ndarray, "n nR"]
    from_target: Float[np.ndarray, "n nT"]
    from_drive: Float[np.ndarray, "n ng"]
    offset: Float[np.ndarray, " n"]
    deviation: Float[np.ndarray, "n nw"]
    hessian: Float[np.ndarray, "nw nw"]
    unit: float
    coordinates: str


def condense(horizon: Horizon, law: Law, targets: Targets, coordinates: Coordinates = "riccati") -> Condensed:
    """Return the maps of a horizon whose blocks follow `law`; "auto" chooses the coordinates by cond(H)."""
    h, signals = horizon, horizon.signals(targets.Z.shape[1])
    moves, nu, nx = law.K.shape
    nz, ng, nf = len(h.A), len(h.G), signals.size
    n = moves * nu
    outputs = n * (1 + h.bounded)
    unit = float((law.L[0] ** 2).sum()) / nu

    v = np.empty((outputs + h.N * ng, nx + nf + n))
    X = np.zeros((nx, nx + nf + n))  # ξ_k as a matrix on [ξ_0; f; w]
    X[:, :nx] = np.eye(nx)
    known, k = slice(nx, nx + nf), 0
    for j, b in enumerate(h.blocks):
        rows = slice(j * nu, (j + 1) * nu)
        u = -law.K[j] @ X
        u[:, known] += law.v[j]
        one = np.sqrt(unit) * np.eye(nu)
        u[:, nx + nf :][:, rows] += scipy.linalg.solve_triangular(law.L[j], one, lower=True, trans="T")
        v[rows] = u
        if h.bounded:
            v[n + j * nu : n + (j + 1) * nu] = u - X[nz:]
        if h.rated:
            X[nz:] = u
        Bu = h.B @ u
        for _ in range(b):
            X[:nz] = h.A @ X[:nz] + Bu
            push = h.push(signals, k)
            if push is not None:
                X[:nz, known] += push
            v[outputs + k * ng : outputs + (k + 1) * ng] = h.G @ X[:nz]
            k += 1
    most = WELL_CONDITIONED if len(v) > n else INPUTS_ALONE
    chosen, deviation, hessian = _coordinates(v[:, nx + nf :], n, coordinates, most)
    f = v[:, known]
    return Condensed(
        v[:, :nx],
        f[:, signals.references],
        f[:, signals.targets],
        f[:, signals.drive],
        f[:, -1],
        deviation,
        hessian,
        unit,
        chosen,
    )


def _coordinates(
    deviation: Float[np.ndarray, "nv nw"], n: int, wanted: Coordinates, limit: float
) -> tuple[str, Float[np.ndarray, "nv nw"], Float[np.ndarray, "nw nw"]]:
    """Return the coordinates, the deviation of v in them, and H; the first n rows of `deviation` are the inputs'."""
    if wanted != "riccati":
        back = np.linalg.inv(deviation[:n])  # w of the Riccati coordinates from u less its optimum
        H = back.T @ back
        least, most = np.linalg.eigvalsh(H)[[0, -1]]
        if wanted == "plain" or most <= limit * least:
            plain = deviation @ back
            plain[:n] = np.eye(n)
            return "plain", plain, H
    return "riccati", np.ascontiguousarray(deviation), np.eye(n)
