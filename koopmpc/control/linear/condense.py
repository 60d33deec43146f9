"""Condense: the whole horizon as matrices of the lifted state and all known signals; builds, and never solves.

In Riccati coordinates, u_j = −K_j ξ_j + v_j f + √unit L_j⁻ᵀ w_j with S_j = R + BᵀP_{j+1}B = L_j L_jᵀ, the cost is
constant + unit · Σ ‖w_j‖²: w = 0 is the unconstrained optimum, and the Hessian is the identity even where the plant is
unstable and plain condensing (u as the variable) has lost all its digits. In plain coordinates w is u less its
unconstrained optimum, and the Hessian is what the Riccati coordinates say of it.

References only add to the cost what is linear in w, −2 Σ (C z_k)ᵀQ r_k and so on, with z_k as w moves it. As the
Hessian is unit · I, they shift the minimiser by −gradient / (2 unit).
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from koopmpc.control.horizon import Horizon, Units
from koopmpc.control.riccati import Law
from koopmpc.control.target import Targets
from koopmpc.control.terminal_cost import Terminal

Coordinates = Literal["auto", "riccati", "plain"]
# cond(H) up to which OSQP in plain coordinates is no slower. Measured on random plants: limits on inputs alone take
# up to half the time from 1e3 to 1e5 and 25 times as much beyond 1e6; with limited outputs 4 times as much from 3e4.
WELL_CONDITIONED = 1e3
INPUTS_ALONE = 1e5


@dataclass(frozen=True)
class Condensed:
    """v = [u_0 …; u_0 − u_{−1} …; G z_1 … G z_N] = F_x ξ_0 + F_r r + F_α α + F_u u_r + F_g g + f + D w, a u a block.

    ξ_0 is z_0, or [z_0; u_{−1}]; r holds the N + 1 reference rows one after the other, α the targets' coordinates of
    the same rows, u_r their input targets where these are given as numbers, g the preview of disturbances. The changes
    of u are there where they have limits.

    Above the unconstrained optimum the cost is unit · wᵀH w, unit the mean diagonal of S_0: w has the size of u, and
    a cost in other units gives the same QP.
    """

    from_state: Float[np.ndarray, "n nx"]
    from_reference: Float[np.ndarray, "n nR"]
    from_target: Float[np.ndarray, "n nT"]
    from_given: Float[np.ndarray, "n nI"]
    from_drive: Float[np.ndarray, "n ng"]
    offset: Float[np.ndarray, " n"]
    deviation: Float[np.ndarray, "n nw"]
    hessian: Float[np.ndarray, "nw nw"]
    unit: float
    coordinates: str


def condense(
    horizon: Horizon, law: Law, terminal: Terminal, targets: Targets, units: Units, coordinates: Coordinates
) -> Condensed:
    """Return the maps of a horizon in these units whose blocks follow `law`; "auto" chooses coordinates by cond(H)."""
    h, signals = horizon, horizon.signals
    moves, nu, nx = law.K.shape
    nz, ng, nf = len(h.A), len(h.G), signals.size
    n = moves * nu
    unit = float((law.L[0] ** 2).sum()) / nu
    spread = np.sqrt(unit) * np.linalg.inv(law.L).transpose(0, 2, 1)

    U = np.empty((moves, nu, nx + nf + n))  # u of each move as a matrix on [ξ_0; f; w], and z of each step
    Z = np.empty((h.N, nz, nx + nf + n))
    X = np.zeros((nx, nx + nf + n))
    X[:, :nx] = np.eye(nx)
    last = X[nz:].copy()
    k = 0
    for j, b in enumerate(h.blocks):
        u = U[j]
        np.dot(-law.K[j], X, out=u)
        u[:, nx : nx + nf] += law.v[j]
        u[:, nx + nf + j * nu : nx + nf + (j + 1) * nu] += spread[j]
        if h.with_rates:
            X[nz:] = u
        Bu = h.B @ u
        for _ in range(b):
            z = Z[k]
            np.dot(h.A, X[:nz], out=z)
            z += Bu
            moved = h.disturbance(k)
            if moved is not None:
                z[:, nx : nx + nf] += moved
            X[:nz] = z
            k += 1
    rows = [U.reshape(n, -1)]
    if h.bounded:
        rows.append((U - np.concatenate([last[None], U[:-1]])).reshape(n, -1))
    v = np.vstack([*rows, (h.G @ Z).reshape(h.N * ng, Z.shape[2])])
    W = v[:, nx + nf :]
    reference, target, given = _asked(h, terminal, targets, U[:, :, nx + nf :], Z[:, :, nx + nf :])
    most = WELL_CONDITIONED if len(v) > n else INPUTS_ALONE
    chosen, deviation, hessian = _coordinates(W, n, coordinates, most)
    maps = Condensed(
        v[:, :nx],
        W @ (reference / unit),
        W @ (target / unit),
        W @ (given / unit),
        v[:, nx : nx + nf - 1],
        v[:, nx + nf - 1],
        deviation,
        hessian,
        unit,
        chosen,
    )
    return _of_model(maps, h, units)


def _of_model(maps: Condensed, h: Horizon, units: Units) -> Condensed:
    """Return the maps of a horizon in these units, in those of the model."""
    moves = len(h.blocks) * (1 + h.bounded)
    rows = np.concatenate([np.tile(units.inputs, moves), np.tile(units.limited, h.N)])[:, None]
    back = units.inverse if h.size == len(units.inverse) else block_diag(units.inverse, np.diag(1 / units.inputs))
    drive, nd = maps.from_drive.copy(), h.signals.nd
    if nd:
        drive[:, -nd:] = drive[:, -nd:] @ units.inverse
    return replace(
        maps,
        from_state=rows * (maps.from_state @ back),
        from_reference=rows * maps.from_reference / np.tile(units.tracked, h.N + 1),
        from_target=rows * maps.from_target,
        from_given=rows * maps.from_given / np.tile(units.inputs, h.N + 1),
        from_drive=rows * drive,
        offset=rows[:, 0] * maps.offset,
        deviation=rows * maps.deviation,
        unit=units.scale * maps.unit,
    )


def _asked(
    h: Horizon,
    terminal: Terminal,
    targets: Targets,
    U: Float[np.ndarray, "moves nu nw"],
    Z: Float[np.ndarray, "N nz nw"],
) -> tuple[Float[np.ndarray, "nw nR"], Float[np.ndarray, "nw nT"], Float[np.ndarray, "nw nI"]]:
    """Return what the references, the coordinates of their targets and given input targets ask of w, times unit."""
    nw, nr, na, nu = U.shape[2], len(h.C), targets.Z.shape[1], U.shape[1]
    reference, target, given = (np.zeros((nw, h.N + 1, columns)) for columns in (nr, na, nu))
    reference[:, 1 : h.N] = (Z[:-1].transpose(2, 0, 1) @ h.C.T) @ h.Q
    given[:, : h.N] = np.repeat(U, h.blocks, axis=0).transpose(2, 0, 1) @ h.R
    target[:, : h.N] = given[:, : h.N] @ targets.W
    last = np.vstack([Z[-1], U[-1]])[: h.size].T  # ξ_N
    for asked, linear in ((reference, terminal.reference), (target, terminal.target), (given, terminal.given)):
        asked[:, h.N] = -last @ linear
    return reference.reshape(nw, -1), target.reshape(nw, -1), given.reshape(nw, -1)


def _coordinates(
    deviation: Float[np.ndarray, "nv nw"], n: int, wanted: Coordinates, limit: float
) -> tuple[str, Float[np.ndarray, "nv nw"], Float[np.ndarray, "nw nw"]]:
    """Return the coordinates, the deviation of v in them, and H; the first n rows of `deviation` are the inputs'."""
    if wanted != "riccati":
        back = np.linalg.inv(deviation[:n])  # w of the Riccati coordinates from u less its optimum
        H = back.T @ back
        if wanted == "plain" or _condition(H) <= limit:
            plain = deviation @ back
            plain[:n] = np.eye(n)
            return "plain", plain, H
    return "riccati", np.ascontiguousarray(deviation), np.eye(n)


def _condition(H: Float[np.ndarray, "n n"]) -> float:
    least, most = np.linalg.eigvalsh(H)[[0, -1]]
    return float(most / least) if least > 0 else np.inf
