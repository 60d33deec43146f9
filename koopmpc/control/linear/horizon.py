"""Horizon: a cost over N steps of a lifted model as stages of linear–quadratic control, one a block of held inputs.

The stages are written in f = [w_0 … w_{N−1}; d; 1], the preview of measured disturbances and a constant disturbance of
z: what moves the state. What is only tracked, references and the coordinates of targets, comes in when the horizon is
condensed. What the state at the end of the horizon costs, by the tail of the tracking problem or by a given Q_N, stands
below the stages.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from koopmpc import checks
from koopmpc.control.cost import Cost, LiftedTracking
from koopmpc.control.riccati import Stage
from koopmpc.control.target import Targets
from koopmpc.control.terminal_cost import learned_steps, tail_of, tail_stage
from koopmpc.errors import ShapeError
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import LinearPredictor


class SignalLayout(NamedTuple):
    """Where the entries of f stand, for N steps and the sizes of w and d."""

    N: int
    nw: int
    nd: int

    @property
    def size(self) -> int:
        """Entries of f."""
        return self.N * self.nw + self.nd + 1

    def w(self, k: int) -> slice:
        """w_k."""
        return slice(k * self.nw, (k + 1) * self.nw)

    @property
    def d(self) -> slice:
        """All of d."""
        return slice(self.N * self.nw, self.N * self.nw + self.nd)


@dataclass(frozen=True)
class Horizon:
    """z⁺ = A z + B u + E w + d over blocks of held inputs; tracked outputs C z, limited outputs G z, the weights.

    `with_rates` puts the last input beside z, ξ = [z; u_{k−1}], as a weight or a limit of u_k − u_{k−1} needs it;
    `bounded` says that there is such a limit.
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

    @property
    def N(self) -> int:
        """Steps."""
        return sum(self.blocks)

    @property
    def size(self) -> int:
        """Entries of ξ."""
        return len(self.A) + self.B.shape[1] * self.with_rates

    @property
    def signals(self) -> SignalLayout:
        """The places in f."""
        return SignalLayout(self.N, self.E.shape[1], len(self.A) if self.disturbed else 0)

    def disturbance(self, k: int) -> Float[np.ndarray, "nz nf"] | None:
        """Return E w_k + d as a matrix on f; None where there is neither."""
        if not self.disturbed and not self.E.shape[1]:
            return None
        signals = self.signals
        e = np.zeros((len(self.A), signals.size))
        e[:, signals.w(k)] = self.E
        e[:, signals.d] = np.eye(len(self.A), signals.nd)
        return e


def stages(horizon: Horizon, targets: Targets) -> list[Stage]:
    """Return a stage for every block of b steps: A = Aᵇ, B = Σ AⁱB, and the cost of its steps summed."""
    nz, nu = horizon.B.shape
    powers = [(np.eye(nz), np.zeros((nz, nu))), (horizon.A, horizon.B)]
    while len(powers) <= max(horizon.blocks):
        powers.append((horizon.A @ powers[-1][0], horizon.A @ powers[-1][1] + horizon.B))
    weighed = horizon.R @ input_target(horizon, targets)
    known: dict[tuple[int, int], Stage] = {}
    result: list[Stage] = []
    k = 0
    for b in horizon.blocks:
        key = b, k if horizon.signals.nw else 0  # without a preview all blocks of a length are the same
        if key not in known:
            known[key] = _stage(horizon, powers[: b + 1], k, -b * weighed)
        result.append(known[key])
        k += b
    return result


def _stage(
    h: Horizon,
    powers: Sequence[tuple[Float[np.ndarray, "nz nz"], Float[np.ndarray, "nz nu"]]],
    k: int,
    r: Float[np.ndarray, "nu nf"],
) -> Stage:
    """Return the stage of a block from step k on, r what is known of its linear term in u."""
    nz, nu = h.B.shape
    (A, B), q, e = powers[-1], None, h.disturbance(k)
    for i, (Ai, Bi) in enumerate(powers[1:-1], 1):
        moved = h.disturbance(k + i)
        if e is not None and moved is not None:
            missed = h.C.T @ (h.Q @ (h.C @ e))
            q = np.zeros((h.size, h.signals.size)) if q is None else q
            q[:nz] += Ai.T @ missed
            r = r + Bi.T @ missed
            e = h.A @ e + moved
    if h.with_rates:
        A, B = block_diag(A, np.zeros((nu, nu))), np.vstack([B, np.eye(nu)])
        e = None if e is None else np.vstack([e, np.zeros((nu, h.signals.size))])
    return Stage(A, B, *_weights(h, powers[:-1]), e, q, r)


def input_target(h: Horizon, targets: Targets) -> Float[np.ndarray, "nu nf"]:
    """Return the part of u_r that f decides, the rest being that of α: the last disturbance of the preview is held."""
    u_r = np.zeros((len(targets.u0), h.signals.size))
    u_r[:, -1] = targets.u0
    moved = h.disturbance(h.N - 1)
    return u_r if moved is None else u_r + targets.u_disturbance @ moved


def _weights(
    h: Horizon, powers: Sequence[tuple[Float[np.ndarray, "nz nz"], Float[np.ndarray, "nz nu"]]]
) -> tuple[Float[np.ndarray, "nx nx"], Float[np.ndarray, "nx nu"] | None, Float[np.ndarray, "nu nu"]]:
    """Return Q, M and R of a block on ξ and its input; M is None where it is zero."""
    nz, nu = h.B.shape
    CQC = h.C.T @ h.Q @ h.C
    Q, M, R = CQC.copy(), np.zeros((nz, nu)), len(powers) * h.R
    for Ai, Bi in powers[1:]:
        Q, M, R = Q + Ai.T @ CQC @ Ai, M + Ai.T @ CQC @ Bi, R + Bi.T @ CQC @ Bi
    if not h.with_rates:
        return Q, M if len(powers) > 1 else None, R
    R_delta = np.zeros((nu, nu)) if h.R_delta is None else h.R_delta
    return block_diag(Q, R_delta), np.vstack([M, -R_delta]), R + R_delta


def horizon_of(
    predictor: LinearPredictor, track: LiftedTracking, blocks: tuple[int, ...], *, disturbed: bool
) -> Horizon:
    """Return the horizon of a predictor for what it tracks and limits."""
    return Horizon(
        A=predictor.A,
        B=predictor.B,
        E=predictor.E,
        C=track.tracked,
        G=track.limited,
        Q=track.Q,
        R=track.R,
        R_delta=track.R_delta,
        blocks=blocks,
        with_rates=track.with_rates,
        bounded=track.rates is not None,
        disturbed=disturbed,
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


def terminal_of(
    predictor: LinearPredictor,
    cost: Cost,
    horizon: Horizon,
    targets: Targets,
    inverse: Float[np.ndarray, "nz nz"] | None = None,
) -> Terminal:
    """Return the terminal cost that `cost` asks for; `inverse` takes z into the coordinates of the horizon.

    The default tail of a model with a fit report or a scale is no longer than the model is accurate, see
    `learned_steps`; that of a given model goes on until it rests.

    Raises
    ------
    ShapeError
        Q_N has another size than z or the state, or weighs a state of which there is no reference.
    """
    if cost.Q_N is not None:
        return _given(predictor, cost, horizon, targets)
    h, signals, size = horizon, horizon.signals, horizon.size
    last, d = signals.w(h.N - 1), signals.d
    D = np.hstack([h.E, np.eye(len(h.A), signals.nd)])
    stage, steps = tail_stage(h.A, h.B, D, h.C, h.Q, h.R, h.R_delta), cost.tail
    if steps is None and not (predictor.report is None and predictor.scale is None):
        steps = learned_steps(stage, predictor, h.N, inverse)
    tail = tail_of(stage, steps)
    n, nr = len(tail.P), len(h.C)
    P, p_g = np.zeros((size, size)), np.zeros((size, tail.p.shape[1]))
    P[:n, :n], p_g[:n] = tail.P, tail.p  # u_{N−1} may be there for its limits alone
    of_e, of_r, of_u = np.split(p_g, [D.shape[1], D.shape[1] + nr], axis=1)
    p = of_u @ input_target(h, targets)
    p[:, last] += of_e[:, : signals.nw]
    p[:, d] += of_e[:, signals.nw :]
    return Terminal(P, p, of_r, of_u @ targets.W, of_u)


def _given(predictor: LinearPredictor, cost: Cost, h: Horizon, targets: Targets) -> Terminal:
    """Return ‖x_N − r_N‖² or ‖z_N − z_r‖² in the weight Q_N."""
    Q_N = np.asarray(cost.Q_N)
    (nz, nu), nx = h.B.shape, predictor.nx
    own = len(Q_N) if Q_N.ndim else nx
    on_state = own == nx and isinstance(cost.of, State) and cost.of.whole
    if own == nx != nz and not on_state:
        raise ShapeError(f"Q_N ({nx}, {nx}) weighs x_N − r_N, but the reference is not of the state; pass ({nz}, {nz})")
    if own not in (nx, nz):
        raise ShapeError(f"Q_N has shape {Q_N.shape}, expected ({nx}, {nx}) on the state or ({nz}, {nz}) on z")
    weight = checks.weight(Q_N, "Q_N", own)
    P, p = np.zeros((h.size, h.size)), np.zeros((h.size, h.signals.size))
    reference, target = np.zeros((h.size, len(h.C))), np.zeros((h.size, targets.Z.shape[1]))
    given = np.zeros((h.size, nu))
    if on_state:
        P[:nz, :nz] = h.C.T @ weight @ h.C
        reference[:nz] = -h.C.T @ weight
        return Terminal(P, p, reference, target, given)
    z_r = np.zeros((nz, h.signals.size))
    z_r[:, -1] = targets.z0
    moved = h.disturbance(h.N - 1)
    if moved is not None:
        z_r += targets.z_disturbance @ moved
    P[:nz, :nz], p[:nz], target[:nz] = weight, -weight @ z_r, -weight @ targets.Z
    return Terminal(P, p, reference, target, given)
