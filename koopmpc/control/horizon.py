"""Horizon: a cost over N steps of a lifted model as stages of control, then as matrices; builds, and never solves.

The stages, one a block of held inputs, are written in f = [w_0 … w_{N−1}; d; 1], the preview of measured disturbances
and a constant disturbance of z: what moves the state. What is only tracked, references and the coordinates of targets,
comes in when the horizon is condensed.

In Riccati coordinates, u_j = −K_j ξ_j + v_j f + √unit L_j⁻ᵀ w_j with S_j = R + BᵀP_{j+1}B = L_j L_jᵀ, the cost is
constant + unit · Σ ‖w_j‖²: w = 0 is the unconstrained optimum, and the Hessian is the identity even where the plant is
unstable and plain condensing (u as the variable) has lost all its digits. In plain coordinates w is u less its
unconstrained optimum, and the Hessian is what the Riccati coordinates say of it.

References only add to the cost what is linear in w, −2 Σ (C z_k)ᵀQ r_k and so on, with z_k as w moves it. As the
Hessian is unit · I, they shift the minimiser by −gradient / (2 unit).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from koopmpc.control.plan.tracking import EndRows, LiftedTracking
from koopmpc.control.riccati import Law, Stage
from koopmpc.control.target import Targets, Units
from koopmpc.models.predictors import LinearPredictor

Coordinates = Literal["auto", "riccati", "plain"]
# cond(H) up to which OSQP in plain coordinates is as fast. Measured on random plants: limits on inputs alone take
# up to half the time from 1e3 to 1e5 and 25 times as much beyond 1e6; with limited outputs 4 times as much from 3e4.
WELL_CONDITIONED = 1e3
INPUTS_ALONE = 1e5


class WeightRows(NamedTuple):
    """The diagonals that weigh the tracked outputs and the input of each step of a plan."""

    Q: Float[np.ndarray, "N nr"]
    R: Float[np.ndarray, "N nu"]


class SignalLayout(NamedTuple):
    """Where w_0 … w_{N−1} and d stand in f, how many entries these have, and f; the last entry of f is 1."""

    w: tuple[slice, ...]
    d: slice
    nw: int
    nd: int
    size: int


@dataclass(frozen=True)
class Horizon:
    """z⁺ = A z + B u + E w + d over blocks of held inputs; tracked outputs C z, limited outputs G z, the weights.

    `with_rates` puts the last input beside z, ξ = [z; u_{k−1}], as a weight or a limit of u_k − u_{k−1} needs it;
    `bounded` says that there is such a limit. Where weights move in time, `rows` are the diagonals that weigh the
    tracked outputs and the input of each step in place of Q and R.
    """

    A: Float[np.ndarray, "nz nz"]
    B: Float[np.ndarray, "nz nu"]
    E: Float[np.ndarray, "nz nw"]
    C: Float[np.ndarray, "nr nz"]
    G: Float[np.ndarray, "ng nz"]
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    R_delta: Float[np.ndarray, "nu nu"] | None
    blocks: tuple[int, ...]
    with_rates: bool
    bounded: bool
    disturbed: bool
    periodic: int = 0
    rows: WeightRows | None = None

    N: int = field(init=False)  # steps
    size: int = field(init=False)  # entries of ξ
    signals: SignalLayout = field(init=False)

    def __post_init__(self) -> None:
        N, nw, (nz, nu) = sum(self.blocks), self.E.shape[1], self.B.shape
        steps, nd = tuple(slice(k * nw, (k + 1) * nw) for k in range(N)), nz if self.disturbed else 0
        layout = SignalLayout(steps, slice(N * nw, N * nw + nd), nw, nd, N * nw + nd + 1)
        for name, value in (("N", N), ("size", nz + nu * self.with_rates), ("signals", layout)):
            object.__setattr__(self, name, value)

    def weights(self, k: int) -> tuple[Float[np.ndarray, "nr nr"], Float[np.ndarray, "nu nu"]]:
        """Return the weights of step k."""
        return (self.Q, self.R) if self.rows is None else (np.diag(self.rows.Q[k]), np.diag(self.rows.R[k]))

    def disturbance(self, k: int) -> Float[np.ndarray, "nz nf"] | None:
        """Return E w_k + d as a matrix on f; None where there is neither."""
        if not self.disturbed and not self.E.shape[1]:
            return None
        signals = self.signals
        e = np.zeros((len(self.A), signals.size))
        e[:, signals.w[k]] = self.E
        e[:, signals.d] = np.eye(len(self.A), signals.nd)
        return e

    def rest_disturbance(self) -> Float[np.ndarray, "nz nf"] | None:
        """Return what acts at the end of the horizon and goes on so: all but a periodic disturbance."""
        e = self.disturbance(self.N - 1)
        if e is not None and self.periodic:
            last = self.signals.w[self.N - 1].stop
            e[:, last - self.periodic : last] = 0.0
        return e

    def in_units(self, units: Units) -> "Horizon":
        """Return the same horizon in these units."""
        L, inverse, inputs, C, G, scale = units

        def to_units(weight: Float[np.ndarray, "n n"], size: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
            return weight * np.outer(size, size) / scale

        return replace(
            self,
            A=inverse @ self.A @ L,
            B=inverse @ self.B * inputs,
            E=inverse @ self.E,
            C=self.C @ L / C[:, None],
            G=self.G @ L / G[:, None],
            Q=to_units(self.Q, C),
            R=to_units(self.R, inputs),
            R_delta=None if self.R_delta is None else to_units(self.R_delta, inputs),
            rows=None if self.rows is None else WeightRows(self.rows.Q * C**2 / scale, self.rows.R * inputs**2 / scale),
        )


def build_stages(horizon: Horizon, targets: Targets) -> list[Stage]:
    """Return a stage for every block of b steps: A = Aᵇ, B = Σ AⁱB, and the cost of its steps summed."""
    nz, nu = horizon.B.shape
    powers = [(np.eye(nz), np.zeros((nz, nu))), (horizon.A, horizon.B)]
    while len(powers) <= max(horizon.blocks):
        powers.append((horizon.A @ powers[-1][0], horizon.A @ powers[-1][1] + horizon.B))
    target = input_target(horizon, targets)
    known: dict[tuple[int, int], Stage] = {}
    result: list[Stage] = []
    k = 0
    for b in horizon.blocks:
        # without a preview and weights in time all blocks of a length are the same
        key = b, k if horizon.signals.nw or horizon.rows is not None else 0
        if key not in known:
            known[key] = _stage(horizon, powers[: b + 1], k, target)
        result.append(known[key])
        k += b
    return result


def _stage(
    h: Horizon,
    powers: Sequence[tuple[Float[np.ndarray, "nz nz"], Float[np.ndarray, "nz nu"]]],
    k: int,
    target: Float[np.ndarray, "nu nf"],
) -> Stage:
    """Return the stage of the block that starts at step k, whose inputs aim at `target`."""
    nz, nu = h.B.shape
    (A, B), q, e = powers[-1], None, h.disturbance(k)
    r = -_sum_inputs(h, k, len(powers) - 1) @ target
    for i, (Ai, Bi) in enumerate(powers[1:-1], 1):
        moved = h.disturbance(k + i)
        if e is not None and moved is not None:
            missed = h.C.T @ (h.weights(k + i)[0] @ (h.C @ e))
            q = np.zeros((h.size, h.signals.size)) if q is None else q
            q[:nz] += Ai.T @ missed
            r = r + Bi.T @ missed
            e = h.A @ e + moved
    if h.with_rates:
        A, B = block_diag(A, np.zeros((nu, nu))), np.vstack([B, np.eye(nu)])
        e = None if e is None else np.vstack([e, np.zeros((nu, h.signals.size))])
    return Stage(A, B, *_weights(h, powers[:-1], k), e, q, r)


def input_target(h: Horizon, targets: Targets) -> Float[np.ndarray, "nu nf"]:
    """Return u_r as a matrix on f, without the part W α; the last disturbance of the preview is held."""
    u_r = np.zeros((len(targets.u0), h.signals.size))
    u_r[:, -1] = targets.u0
    moved = h.rest_disturbance()
    return u_r if moved is None else u_r + targets.u_disturbance @ moved


def _weights(
    h: Horizon, powers: Sequence[tuple[Float[np.ndarray, "nz nz"], Float[np.ndarray, "nz nu"]]], k: int
) -> tuple[Float[np.ndarray, "nx nx"], Float[np.ndarray, "nx nu"] | None, Float[np.ndarray, "nu nu"]]:
    """Return Q, M and R of the block of step k on ξ and its input; M = None stands for zero."""
    nz, nu = h.B.shape
    CQC = h.C.T @ h.weights(k)[0] @ h.C
    Q, M, R = CQC.copy(), np.zeros((nz, nu)), _sum_inputs(h, k, len(powers))
    for i, (Ai, Bi) in enumerate(powers[1:], 1):
        if h.rows is not None:
            CQC = h.C.T @ h.weights(k + i)[0] @ h.C
        Q, M, R = Q + Ai.T @ CQC @ Ai, M + Ai.T @ CQC @ Bi, R + Bi.T @ CQC @ Bi
    if not h.with_rates:
        return Q, M if len(powers) > 1 else None, R
    R_delta = np.zeros((nu, nu)) if h.R_delta is None else h.R_delta
    return block_diag(Q, R_delta), np.vstack([M, -R_delta]), R + R_delta


def _sum_inputs(h: Horizon, k: int, steps: int) -> Float[np.ndarray, "nu nu"]:
    """Return the weight of an input that is held for so many steps from k on."""
    return steps * h.R if h.rows is None else np.diag(h.rows.R[k : k + steps].sum(axis=0))


def horizon_of(
    predictor: LinearPredictor,
    track: LiftedTracking,
    blocks: tuple[int, ...],
    *,
    disturbed: bool,
    periodic: bool = False,
    rows: WeightRows | None = None,
) -> Horizon:
    """Return the horizon of a predictor for what it tracks and limits; a periodic disturbance acts on all of z."""
    return Horizon(
        A=predictor.A,
        B=predictor.B,
        E=np.hstack([predictor.E, np.eye(predictor.nz)]) if periodic else predictor.E,
        C=track.tracked,
        G=track.limited,
        Q=track.Q,
        R=track.R,
        R_delta=track.R_delta,
        blocks=blocks,
        with_rates=track.with_rates,
        bounded=track.rates is not None,
        disturbed=disturbed,
        periodic=predictor.nz if periodic else 0,
        rows=rows,
    )


class Terminal(NamedTuple):
    """V = ξ_NᵀP ξ_N + 2 ξ_Nᵀ(p f + p_r r_N + p_α α_N + p_u u_N) + const, ξ_N = z_N or [z_N; u_{N−1}].

    f are the horizon's signals, r_N the last reference row, α_N the coordinates of its target and u_N its input target
    where that is given as numbers.
    """

    P: Float[np.ndarray, "nx nx"]
    p: Float[np.ndarray, "nx nf"]
    reference: Float[np.ndarray, "nx nr"]
    target: Float[np.ndarray, "nx na"]
    given: Float[np.ndarray, "nx nu"]


@dataclass(frozen=True)
class Condensed:
    """v = [u_0 …; u_0 − u_{−1} …; G z_1 … G z_N; F z_N] = F_x ξ_0 + F_r r + F_α α + F_u u_r + F_g g + f + D w.

    A u is that of a block; the rows F z_N are those of a terminal set.

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
    horizon: Horizon,
    law: Law,
    terminal: Terminal,
    targets: Targets,
    units: Units,
    coordinates: Coordinates,
    end: EndRows | None = None,
) -> Condensed:
    """Return the maps of a horizon in these units whose blocks follow `law`; "auto" chooses coordinates by cond(H).

    The rows of a terminal set, `end` in the units of the model, stand at the end of v.
    """
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
    rows.append((h.G @ Z).reshape(h.N * ng, Z.shape[2]))
    if end is not None:
        last_input = units.inputs[:, None] * U[-1]
        ends = end.F @ np.vstack([units.L @ Z[-1], last_input])[: end.F.shape[1]]
        ends[:, nx + nf - 1] += end.offset
        rows.append(ends)
    v = np.vstack(rows)
    W = v[:, nx + nf :]
    reference, target, given = _pull_of_targets(h, terminal, targets, U[:, :, nx + nf :], Z[:, :, nx + nf :])
    most = WELL_CONDITIONED if len(v) > n else INPUTS_ALONE
    chosen, deviation, hessian = _coordinates(W, n, coordinates, most)
    maps = Condensed(
        from_state=v[:, :nx],
        from_reference=W @ (reference / unit),
        from_target=W @ (target / unit),
        from_given=W @ (given / unit),
        from_drive=v[:, nx : nx + nf - 1],
        offset=v[:, nx + nf - 1],
        deviation=deviation,
        hessian=hessian,
        unit=unit,
        coordinates=chosen,
    )
    return _of_model(maps, h, units)


def _of_model(maps: Condensed, h: Horizon, units: Units) -> Condensed:
    """Return maps that were made in these units in the units of the model."""
    moves = len(h.blocks) * (1 + h.bounded)
    ends = len(maps.offset) - moves * len(units.inputs) - h.N * len(units.limited)  # rows of a terminal set
    rows = np.concatenate([np.tile(units.inputs, moves), np.tile(units.limited, h.N), np.ones(ends)])[:, None]
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


def _pull_of_targets(
    h: Horizon,
    terminal: Terminal,
    targets: Targets,
    U: Float[np.ndarray, "moves nu nw"],
    Z: Float[np.ndarray, "N nz nw"],
) -> tuple[Float[np.ndarray, "nw nR"], Float[np.ndarray, "nw nT"], Float[np.ndarray, "nw nI"]]:
    """Return −½ times the gradient in w that references, coordinates of targets and given input targets make."""
    nw, nr, na, nu = U.shape[2], len(h.C), targets.Z.shape[1], U.shape[1]
    reference, target, given = (np.zeros((nw, h.N + 1, columns)) for columns in (nr, na, nu))
    tracked, held = Z[:-1].transpose(2, 0, 1) @ h.C.T, np.repeat(U, h.blocks, axis=0).transpose(2, 0, 1)
    reference[:, 1 : h.N] = tracked @ h.Q if h.rows is None else tracked * h.rows.Q[1:]
    given[:, : h.N] = held @ h.R if h.rows is None else held * h.rows.R
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
        least, most = np.linalg.eigvalsh(H)[[0, -1]]
        if wanted == "plain" or 0 < most <= limit * least:
            plain = deviation @ back
            plain[:n] = np.eye(n)
            return "plain", plain, H
    return "riccati", np.ascontiguousarray(deviation), np.eye(n)
