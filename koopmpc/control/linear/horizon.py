"""Horizon: a cost over N steps of a lifted model as stages of linear–quadratic control, one a block of held inputs.

The stages are written in f = [w_0 … w_{N−1}; d; 1], the preview of measured disturbances and a constant disturbance of
z: what moves the state. What is only tracked, references and the coordinates of targets, comes in when the horizon is
condensed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from koopmpc.control.cost import LiftedTracking
from koopmpc.control.riccati import Stage
from koopmpc.control.target import Targets
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
