"""Horizon: a cost over N steps of a lifted model as stages of linear–quadratic control, one a block of held inputs.

The stages are written in f = [w_0 … w_{N−1}; d; 1], the preview of measured disturbances and a constant disturbance of
z: what moves the state. What is only tracked, references and the coordinates of targets, comes in when the horizon is
condensed.

Recursions and rank decisions lose digits where entries differ by many powers of ten, and where observables are almost
dependent. So a linear problem is solved in units in which those of a model and of its user mean nothing: z = L q,
u = D_u ũ, r = D_r r̃, limited outputs D_g g̃, and a cost of `scale` times its own unit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag, solve_triangular

from koopmpc import checks
from koopmpc.control.cost import Cost, LiftedTracking
from koopmpc.control.riccati import Stage
from koopmpc.control.target import Targets, observable_sizes
from koopmpc.errors import DataError
from koopmpc.predict.predictors import LinearPredictor


class SignalLayout(NamedTuple):
    """Where w_0 … w_{N−1} and d stand in f, how many entries these have, and f; the last entry of f is 1."""

    w: tuple[slice, ...]
    d: slice
    nw: int
    nd: int
    size: int


def blocked(moves: int | Sequence[int] | None, horizon: int) -> tuple[int, ...]:
    """Return the lengths of the blocks of steps in which a plan of N steps holds its inputs: move blocking.

    They are N ones, or M moves of which the last is held, or `moves` itself.

    Raises
    ------
    DataError
        The horizon is no whole number above zero; there are more moves than steps; the lengths do not sum to N.
    """
    N = checks.count(horizon, "horizon")
    if moves is None:
        return (1,) * N
    if isinstance(moves, Sequence):
        lengths = tuple(checks.count(b, "a block of moves") for b in moves)
        if sum(lengths) != N:
            raise DataError(f"the blocks of moves {lengths} sum to {sum(lengths)}, the horizon is {N}")
        return lengths
    if not isinstance(cast(object, moves), int | np.integer):
        raise DataError(f"moves is {moves!r}; pass how many moves there are, or a tuple of the blocks' lengths")
    M = checks.count(moves, "moves")
    if M > N:
        raise DataError(f"moves is {M}, the horizon {N}; a horizon has at most a move a step")
    return (1,) * (M - 1) + (N - M + 1,)


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

    N: int = field(init=False)  # steps
    size: int = field(init=False)  # entries of ξ
    signals: SignalLayout = field(init=False)

    def __post_init__(self) -> None:
        N, nw, (nz, nu) = sum(self.blocks), self.E.shape[1], self.B.shape
        steps, nd = tuple(slice(k * nw, (k + 1) * nw) for k in range(N)), nz if self.disturbed else 0
        layout = SignalLayout(steps, slice(N * nw, N * nw + nd), nw, nd, N * nw + nd + 1)
        for name, value in (("N", N), ("size", nz + nu * self.with_rates), ("signals", layout)):
            object.__setattr__(self, name, value)

    def disturbance(self, k: int) -> Float[np.ndarray, "nz nf"] | None:
        """Return E w_k + d as a matrix on f; None where there is neither."""
        if not self.disturbed and not self.E.shape[1]:
            return None
        signals = self.signals
        e = np.zeros((len(self.A), signals.size))
        e[:, signals.w[k]] = self.E
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


class Units(NamedTuple):
    """L, its inverse, and the diagonals of D_u, D_r and D_g; see the file."""

    L: Float[np.ndarray, "nz nz"]
    inverse: Float[np.ndarray, "nz nz"]
    inputs: Float[np.ndarray, " nu"]
    tracked: Float[np.ndarray, " nr"]
    limited: Float[np.ndarray, " ng"]
    scale: float

    @staticmethod
    def of(predictor: LinearPredictor, track: LiftedTracking) -> "Units":
        """Return the units of a predictor under a cost and limits.

        L is the transposed factor of the lifted data, in which q has root-mean-square 1 in every direction; for a model
        that was not fitted the sizes of its observables.
        """
        known = predictor.scale
        L = np.diag(observable_sizes(predictor, track.sizes)) if known is None else known.T.copy()
        inverse = np.asarray(solve_triangular(L, np.eye(len(L)), lower=True))
        C, G = (_norms(rows @ L) for rows in (track.tracked, track.limited))
        return Units(L, inverse, track.sizes.inputs, C, G, track.sizes.scale)

    def horizon(self, h: Horizon) -> Horizon:
        """Return a horizon in these units."""
        A, B, E = self.inverse @ h.A @ self.L, self.inverse @ h.B * self.inputs, self.inverse @ h.E
        C, G = h.C @ self.L / self.tracked[:, None], h.G @ self.L / self.limited[:, None]
        R_delta = None if h.R_delta is None else self._weight(h.R_delta, self.inputs)
        Q, R = self._weight(h.Q, self.tracked), self._weight(h.R, self.inputs)
        return replace(h, A=A, B=B, E=E, C=C, G=G, Q=Q, R=R, R_delta=R_delta)

    def targets(self, targets: Targets) -> Targets:
        """Return targets, as far as a horizon reads them, in these units."""
        return replace(
            targets,
            z0=self.inverse @ targets.z0,
            Z=self.inverse @ targets.Z,
            u0=targets.u0 / self.inputs,
            W=targets.W / self.inputs[:, None],
            z_disturbance=self.inverse @ targets.z_disturbance @ self.L,
            u_disturbance=targets.u_disturbance @ self.L / self.inputs[:, None],
        )

    def cost(self, cost: Cost) -> Cost:
        """Return a cost with its Q_N in these units."""
        if cost.Q_N is None:
            return cost
        Q_N = np.asarray(cost.Q_N)
        if Q_N.ndim < 2:
            Q_N = np.diag(np.broadcast_to(Q_N, Q_N.shape or (len(self.tracked),)))
        if len(Q_N) == len(self.L) and len(Q_N) != len(self.tracked):
            return replace(cost, Q_N=self.L.T @ Q_N @ self.L / self.scale)
        return replace(cost, Q_N=self._weight(Q_N, self.tracked)) if len(Q_N) == len(self.tracked) else cost

    def gain(self, K: Float[np.ndarray, "nu nx"]) -> Float[np.ndarray, "nu nx"]:
        """Return the gain of [z; u_{k−1}], or of z, of one in these units."""
        return self.inputs[:, None] * K @ self._back(K.shape[1])

    def value(self, P: Float[np.ndarray, "nx nx"]) -> Float[np.ndarray, "nx nx"]:
        """Return the P of a value of [z; u_{k−1}], or of z, of one in these units."""
        back = self._back(len(P))
        return self.scale * back.T @ P @ back

    def _back(self, size: int) -> Float[np.ndarray, "nx nx"]:
        """Return what takes [z; u_{k−1}], or z, into these units."""
        return self.inverse if size == len(self.inverse) else block_diag(self.inverse, np.diag(1 / self.inputs))

    def _weight(self, Q: Float[np.ndarray, "n n"], size: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
        return Q * np.outer(size, size) / self.scale


def _norms(rows: Float[np.ndarray, "n nz"]) -> Float[np.ndarray, " n"]:
    size = np.linalg.norm(rows, axis=1)
    return np.where(size > 0, size, 1.0)
