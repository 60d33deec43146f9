"""Horizon: a cost over N steps of a lifted model as stages of linear–quadratic control, one a block of held inputs.

The stages are written in f, all that is known before the step: f = [r_0 … r_N; α_0 … α_N; w_0 … w_{N−1}; d; 1], the
reference, its targets' coordinates, the preview of measured disturbances, and a constant disturbance of z.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.riccati import Stage
from koopmpc.control.target import Targets
from koopmpc.errors import DataError


class Signals(NamedTuple):
    """Where the entries of f stand, for N steps and the sizes of r, α, w and d."""

    N: int
    nr: int
    na: int
    nw: int
    nd: int

    @property
    def references(self) -> slice:
        """All r."""
        return slice(0, (self.N + 1) * self.nr)

    @property
    def targets(self) -> slice:
        """All α."""
        return slice(self.references.stop, self.references.stop + (self.N + 1) * self.na)

    @property
    def drive(self) -> slice:
        """All w, and d."""
        return slice(self.targets.stop, self.targets.stop + self.N * self.nw + self.nd)

    @property
    def size(self) -> int:
        """Entries of f."""
        return self.drive.stop + 1

    def r(self, k: int) -> slice:
        """r_k."""
        return slice(k * self.nr, (k + 1) * self.nr)

    def alpha(self, k: int) -> slice:
        """α_k."""
        return slice(self.targets.start + k * self.na, self.targets.start + (k + 1) * self.na)

    def w(self, k: int) -> slice:
        """w_k."""
        return slice(self.drive.start + k * self.nw, self.drive.start + (k + 1) * self.nw)

    @property
    def d(self) -> slice:
        """All of d."""
        return slice(self.drive.stop - self.nd, self.drive.stop)


@dataclass(frozen=True)
class Horizon:
    """z⁺ = A z + B u + E w + d over blocks of held inputs; tracked outputs C z, limited outputs G z, the weights.

    `rated` puts the last input beside z, ξ = [z; u_{k−1}], as a weight or a limit of u_k − u_{k−1} needs it; `bounded`
    says that there is such a limit. P_N weighs ξ_N − ξ_r, or x_N − r_N where CQ_N = CᵀQ_N is given.
    """

    A: Float[np.ndarray, "nz nz"]
    B: Float[np.ndarray, "nz nu"]
    E: Float[np.ndarray, "nz nw"]
    C: Float[np.ndarray, "nr nz"]
    G: Float[np.ndarray, "ng nz"]
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    R_delta: Float[np.ndarray, "nu nu"] | None
    P_N: Float[np.ndarray, "nx nx"]
    CQ_N: Float[np.ndarray, "nz nr"] | None
    blocks: tuple[int, ...]
    rated: bool
    bounded: bool
    disturbed: bool

    @property
    def N(self) -> int:
        """Steps."""
        return sum(self.blocks)

    @property
    def size(self) -> int:
        """Entries of ξ."""
        return len(self.A) + self.B.shape[1] * self.rated

    def signals(self, na: int) -> Signals:
        """Return the places in f, for targets of `na` coordinates."""
        return Signals(self.N, len(self.C), na, self.E.shape[1], len(self.A) if self.disturbed else 0)

    def push(self, signals: Signals, k: int) -> Float[np.ndarray, "nz nf"] | None:
        """Return E w_k + d as a matrix on f; None where there is neither."""
        if signals.drive.start == signals.drive.stop:
            return None
        e = np.zeros((len(self.A), signals.size))
        e[:, signals.w(k)] = self.E
        e[:, signals.d] = np.eye(len(self.A), signals.nd)
        return e


def blocked(moves: int | Sequence[int] | None, N: int) -> tuple[int, ...]:
    """Return the lengths of the blocks: N ones, M moves of which the last is held, or `moves` itself.

    Raises
    ------
    DataError
        There are more moves than steps, or the lengths do not sum to N.
    """
    if moves is None:
        return (1,) * N
    if isinstance(moves, Sequence):
        lengths = tuple(checks.count(b, "a block of moves") for b in moves)
        if sum(lengths) != N:
            raise DataError(f"the blocks of moves {lengths} sum to {sum(lengths)}, the horizon is {N}")
        return lengths
    M = checks.count(moves, "moves")
    if M > N:
        raise DataError(f"moves is {M}, the horizon {N}; a horizon has at most a move a step")
    return (1,) * (M - 1) + (N - M + 1,)


def one_step(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    Q: Float[np.ndarray, "nz nz"],
    R: Float[np.ndarray, "nu nu"],
    R_delta: Float[np.ndarray, "nu nu"] | None,
) -> Stage:
    """Return one step with the cost ‖z‖²_Q + ‖u‖²_R, on [z; u_{k−1}] with ‖u − u_{k−1}‖²_{R_delta} where given."""
    nz, nu = B.shape
    if R_delta is None:
        return Stage(A, B, Q, None, R)
    M = np.vstack([np.zeros((nz, nu)), -R_delta])
    return Stage(
        _stacked(A, np.zeros((nu, nu))), np.vstack([B, np.eye(nu)]), _stacked(Q, R_delta), M, R + R_delta
    )


def stages(horizon: Horizon, targets: Targets) -> list[Stage]:
    """Return a stage for every block of b steps: A = Aᵇ, B = Σ AⁱB, and the cost of its steps summed."""
    h, signals = horizon, horizon.signals(targets.Z.shape[1])
    nz, nu = h.B.shape
    powers = [(np.eye(nz), np.zeros((nz, nu))), (h.A, h.B)]
    while len(powers) <= max(h.blocks):
        powers.append((h.A @ powers[-1][0], h.A @ powers[-1][1] + h.B))
    weights = {b: _weights(h, powers[:b]) for b in set(h.blocks)}
    result: list[Stage] = []
    k = 0
    for b in h.blocks:
        q, r = np.zeros((h.size, signals.size)), np.zeros((nu, signals.size))
        e: Float[np.ndarray, "nz nf"] | None = None
        for i, (Ai, Bi) in enumerate(powers[:b]):
            missed = np.zeros((len(h.C), signals.size)) if e is None else h.C @ e
            missed[:, signals.r(k + i)] -= np.eye(len(h.C))
            weighed = h.C.T @ (h.Q @ missed)
            q[:nz] += weighed if i == 0 else Ai.T @ weighed
            r += Bi.T @ weighed - h.R @ _input(signals, targets, h, k + i)
            push = h.push(signals, k + i)
            e = push if e is None or push is None else h.A @ e + push
        A, B = powers[b]
        if h.rated:
            A, B = _stacked(A, np.zeros((nu, nu))), np.vstack([B, np.eye(nu)])
            e = None if e is None else np.vstack([e, np.zeros((nu, signals.size))])
        result.append(Stage(A, B, *weights[b], e, q, r))
        k += b
    return result


def end(horizon: Horizon, targets: Targets) -> Float[np.ndarray, "nx nf"]:
    """Return the linear term p_N of the terminal weight, as a matrix on f."""
    h, signals = horizon, horizon.signals(targets.Z.shape[1])
    p = np.zeros((h.size, signals.size))
    nz = len(h.A)
    if h.CQ_N is not None:
        p[:nz, signals.r(h.N)] = -h.CQ_N
        return p
    z_r = np.zeros((nz, signals.size))
    z_r[:, signals.alpha(h.N)], z_r[:, -1] = targets.Z, targets.z0
    push = h.push(signals, h.N - 1)
    if push is not None:
        z_r += targets.z_push @ push
    p -= h.P_N[:, :nz] @ z_r
    if h.rated:
        p -= h.P_N[:, nz:] @ _input(signals, targets, h, h.N)
    return p


def _input(signals: Signals, targets: Targets, h: Horizon, k: int) -> Float[np.ndarray, "nu nf"]:
    """Return u_r of step k; the last disturbance of the preview stays."""
    u_r = np.zeros((len(targets.u0), signals.size))
    u_r[:, signals.alpha(k)], u_r[:, -1] = targets.W, targets.u0
    push = h.push(signals, h.N - 1)
    return u_r if push is None else u_r + targets.u_push @ push


def _weights(
    h: Horizon, powers: Sequence[tuple[Float[np.ndarray, "nz nz"], Float[np.ndarray, "nz nu"]]]
) -> tuple[Float[np.ndarray, "nx nx"], Float[np.ndarray, "nx nu"] | None, Float[np.ndarray, "nu nu"]]:
    """Return Q, M and R of a block on ξ and its input; M is None where it is zero."""
    nz, nu = h.B.shape
    CQC = h.C.T @ h.Q @ h.C
    Q, M, R = CQC.copy(), np.zeros((nz, nu)), len(powers) * h.R
    for Ai, Bi in powers[1:]:
        Q, M, R = Q + Ai.T @ CQC @ Ai, M + Ai.T @ CQC @ Bi, R + Bi.T @ CQC @ Bi
    if not h.rated:
        return Q, M if len(powers) > 1 else None, R
    R_delta = np.zeros((nu, nu)) if h.R_delta is None else h.R_delta
    return _stacked(Q, R_delta), np.vstack([M, -R_delta]), R + R_delta


def _stacked(X: Float[np.ndarray, "nz nz"], Y: Float[np.ndarray, "nu nu"]) -> Float[np.ndarray, "nx nx"]:
    """Return the block diagonal of X and Y."""
    nz, nx = len(X), len(X) + len(Y)
    whole = np.zeros((nx, nx))
    whole[:nz, :nz], whole[nz:, nz:] = X, Y
    return whole
