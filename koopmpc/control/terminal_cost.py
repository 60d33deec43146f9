"""The terminal cost: what the state at the end of a horizon costs, by a given Q_N or by a tail of further steps.

The tail is the same tracking problem going on without limits, its signals held.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import ShapeError
from koopmpc.control.ask.cost import Cost
from koopmpc.control.horizon import Horizon, Terminal, input_target
from koopmpc.control.riccati import (
    LARGEST,
    SETTLED,
    Recursion,
    Stage,
    controllable,
    find_gain,
    one_step,
    recurse,
    recursion,
    solve_factored,
    stationary,
)
from koopmpc.control.target import Targets
from koopmpc.lifting.state import State
from koopmpc.models.predictors import LinearPredictor

ITERATIONS = 10_000  # end an infinite tail after this many steps, settled or not
EXACT = 1e-14  # the feedforward rests when it moves by less, relative to its size
GROWS = 1 + 1e-5  # modulus beyond which a mode grows: two integrators in a row come out as 1 ± 1e-8, three as 1 ± 1e-5
APART = 1e6  # entries of the eigenvectors' transform up to which modes can be told apart


@dataclass(frozen=True)
class TrialLoops:
    """How long a tail has to be is tried in loops on the model; tuned by the table of docs/closed_loop.md.

    Attributes
    ----------
    axes
        Loops start along this many principal axes of the states.
    farthest
        States stay within this many standard deviations.
    alike
        Share of a law, over the data, by which others may differ and need no trial.
    late
        An input acts this many steps late.
    worth
        A shorter tail is taken if its loop costs at most this share more.
    little
        A loop rests if a step costs at most this share of `worth`.
    ahead, short
        A loop lasts this many horizons, of at least so many steps; a gain must rest within them.
    """

    axes: int = 8
    farthest: float = 20.0
    alike: float = 0.01
    late: float = 0.5
    worth: float = 0.005
    little: float = 1e-3
    ahead: int = 10
    short: int = 20

    def count_steps(self, N: int) -> int:
        """Return T, the steps of a loop."""
        return self.ahead * max(N, self.short)


TRIALS = TrialLoops()


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
    """
    if cost.Q_N is not None:
        return _weigh_end(predictor, cost, horizon, targets)
    h, signals, size = horizon, horizon.signals, horizon.size
    last, d = signals.w[h.N - 1], signals.d
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
    of_e[:, signals.nw - h.periodic : signals.nw] = 0.0
    p[:, last] += of_e[:, : signals.nw]
    p[:, d] += of_e[:, signals.nw :]
    return Terminal(P, p, of_r, of_u @ targets.W, of_u)


def _weigh_end(predictor: LinearPredictor, cost: Cost, h: Horizon, targets: Targets) -> Terminal:
    """Return ‖x_N − r_N‖² or ‖z_N − z_r‖² in the weight Q_N."""
    Q_N = np.asarray(cost.Q_N)
    (nz, nu), nx = h.B.shape, predictor.nx
    own = len(Q_N) if Q_N.ndim else nx
    on_state = own == nx and isinstance(cost.of, State) and cost.of.selects_all
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
    moved = h.rest_disturbance()
    if moved is not None:
        z_r += targets.z_disturbance @ moved
    P[:nz, :nz], p[:nz], target[:nz] = weight, -weight @ z_r, -weight @ targets.Z
    return Terminal(P, p, reference, target, given)


class Tail(NamedTuple):
    """The cost-to-go V(ξ) = ξᵀP ξ + 2 ξᵀp g + const, and the law u = −K ξ + v g of its first step.

    A tail without steps has the law of a step before it.
    """

    P: Float[np.ndarray, "nx nx"]
    p: Float[np.ndarray, "nx ng"]
    K: Float[np.ndarray, "nu nx"]
    v: Float[np.ndarray, "nu ng"]


def tail_stage(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    D: Float[np.ndarray, "nz ne"],
    C: Float[np.ndarray, "nr nz"],
    Q: Float[np.ndarray, "nr nr"],
    R: Float[np.ndarray, "nu nu"],
    R_delta: Float[np.ndarray, "nu nu"] | None,
) -> Stage:
    """Return one step of the tail, z⁺ = A z + B u + D e, at the cost ‖C z − r‖²_Q + ‖u − u_r‖²_R of a step.

    The known signals are g = [e; r; u_r], held from step to step. With R_delta the step is on [z; u_{k−1}] and
    ‖u − u_{k−1}‖²_{R_delta} is added.
    Modes that grow and that no input moves are kept from growing, see `stop_growing_modes`.
    """
    plain = one_step(stop_growing_modes(A, B), B, C.T @ Q @ C, R, R_delta)
    (nz, ne), nr, (n, nu) = D.shape, len(C), plain.B.shape
    e, q, r = np.zeros((n, ne + nr + nu)), np.zeros((n, ne + nr + nu)), np.zeros((nu, ne + nr + nu))
    e[:nz, :ne] = D
    q[:nz, ne : ne + nr] = -C.T @ Q
    r[:, ne + nr :] = -R
    return plain._replace(e=e, q=q, r=r)


def tail_of(stage: Stage, steps: int | None) -> Tail:
    """Return the tail of this many steps, all of them `stage`; its last state is weighed like the others.

    With None it goes on until it rests. K and v are those of its first step, without steps those of a step before it.
    """
    A, B, _, _, _, e, q, r = stage
    if e is None or q is None or r is None:
        raise ValueError("a stage of a tail knows its signals")
    if steps is not None:
        last = _last(stage)
        law = recursion([stage] * max(steps, 1), last, q)
        return Tail(law.P, law.p, law.K[0], law.v[0]) if steps else Tail(last, q, law.K[0], law.v[0])
    P = stationary(stage, ITERATIONS).P
    K, L = find_gain(stage, P)
    p = _resting(A - B @ K, q + (A - B @ K).T @ (P @ e) - K.T @ r, B)
    return Tail(P, p, K, -solve_factored(L, B.T @ (p + P @ e) + r))


def learned_steps(
    stage: Stage, predictor: LinearPredictor, N: int, inverse: Float[np.ndarray, "nz nz"] | None = None
) -> int:
    """Return the steps of the default tail of a learned model: until the gain rests as far as the model is accurate.

    Once a further step changes the gain K by a smaller share than the model misses of its states in one step, the tail
    only follows the model's errors: modes that the plant does not have grow in it until they rule the plan. Both are
    root mean squares over the data about their mean; inputs count by S = L Lᵀ, what they cost. The gain rests when the
    change is so small for as many steps in a row as ψ has arguments; it is waited for T = 10 N steps, 200 at least.
    Then `believed_steps` shortens the tail, except for models of delays and reduced ones. Where the gain does not rest,
    or a model does not know its errors, it has N steps. `inverse` takes z into other coordinates of the stage.
    """
    scale = predictor.scale
    if predictor.report is None or scale is None:
        return N
    back = np.eye(len(scale)) if inverse is None else inverse
    gains = Recursion(recurse(stage, _last(stage)))
    rested = _rested_steps(gains, stage, predictor, N, back)
    if predictor.embedding is not None or predictor.lifting.nz != len(scale):
        return rested or N
    return believed_steps(gains, stage, predictor, N, rested or TRIALS.count_steps(N), back)


def believed_steps(
    gains: Recursion,
    stage: Stage,
    predictor: LinearPredictor,
    N: int,
    most: int,
    inverse: Float[np.ndarray, "nz nz"],
) -> int:
    """Return the shortest tail of none, N, `most`, a half, a quarter … of these steps, down to N/4, that is as good.

    Without limits, N planned steps and a tail are a law u = −K z. Each law steers the re-lifted model
    x⁺ = C (A ψ(x) + B u) for T steps from a standard deviation along each principal axis of the states. States count
    from the mean of the data, which is taken to be at rest. A law that leans on modes of A that lifted states do not
    have costs there what it would on the plant. Inputs act half a step late, which a law pays for that leans on fast
    modes, those of the model's errors above all. What little a longer tail gains on the model need not be gained on the
    plant: see `TrialLoops`. Lateness and that share go to zero with (T m)² where the share m that the model misses of
    its states in a step is small. The tail has `most` steps where all laws are alike.
    """
    scale, lifting = predictor.scale, predictor.lifting
    if scale is None:
        return most
    C, nz, constant = predictor.C, len(scale), lifting.constant_index
    halves = max(2, (4 * most // N).bit_length() - 1)
    lengths = sorted({0, min(N, most), *(most >> i for i in range(halves + 1))})
    found = [gains.find_step(n + N) for n in lengths]
    laws = np.array([np.full(stage.B.shape, np.nan) if each is None else each.K.T for each in found])
    seen = scale @ inverse.T
    if max(np.linalg.norm(seen @ (law - laws[-1])[:nz]) for law in laws) <= TRIALS.alike * np.linalg.norm(
        seen @ laws[-1][:nz]
    ):
        return most
    center = np.zeros(len(C)) if constant is None else C @ (scale.T @ scale[:, constant])
    apart = _spread(predictor, scale) @ C.T
    spread = apart.T @ apart
    sizes = np.sqrt(np.where(spread.diagonal() > 0, spread.diagonal(), 1.0))
    values, axes = np.linalg.eigh(spread / np.outer(sizes, sizes))
    ways = (sizes[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))[:, ::-1][:, : TRIALS.axes].T
    X = np.tile(center + np.vstack([ways, -ways]), (len(laws), 1, 1))
    V, cost = np.zeros((*X.shape[:2], stage.B.shape[1])), np.zeros(len(laws))
    CA, CB = C @ predictor.A, np.linalg.solve(inverse.T, C.T).T @ stage.B[:nz]
    rest, steps = lifting(center[None]), TRIALS.count_steps(N)
    if len(stage.A) > nz:  # the last input is beside z
        inverse = scipy.linalg.block_diag(inverse, np.eye(len(stage.A) - nz))
    laws, crossed = inverse.T @ laws, None if stage.M is None else inverse.T @ stage.M
    weight = _root_of_few(inverse.T @ stage.Q @ inverse)
    unsure = min(1.0, (steps * _measure_residual(predictor, scale)) ** 2 / TRIALS.worth)
    with np.errstate(all="ignore"):
        for _ in range(steps):
            moved = lifting(X.reshape(-1, len(center))).reshape(*X.shape[:2], nz) - rest
            xi = moved if len(inverse) == nz else np.concatenate([moved, V], axis=2)
            V_before, V = V, -xi @ laws
            spent = ((xi @ weight) ** 2).sum(axis=(1, 2)) + ((V @ stage.R) * V).sum(axis=(1, 2))
            if crossed is not None:
                spent += 2 * ((xi @ crossed) * V).sum(axis=(1, 2))
            cost += spent
            if not (
                spent > TRIALS.little * TRIALS.worth * unsure * cost
            ).any():  # all loops are at rest, or beyond all numbers
                break
            acts = V + TRIALS.late * unsure * (V_before - V)
            ahead = np.nan_to_num((moved @ CA.T + acts @ CB.T) / sizes, nan=TRIALS.farthest)
            X = center + sizes * np.clip(ahead, -TRIALS.farthest, TRIALS.farthest)
    cost = np.where(np.isfinite(cost), cost, np.inf)
    return next(n for n, each in zip(lengths, cost, strict=True) if each <= (1 + TRIALS.worth * unsure) * cost.min())


def _root_of_few(Q: Float[np.ndarray, "nx nx"]) -> Float[np.ndarray, "nx n"]:
    """Return F with F Fᵀ = Q, without columns that are rounding: a weight of few outputs has few."""
    F = checks.root(Q)
    sizes = np.linalg.norm(F, axis=1)
    return F[sizes > np.finfo(float).eps * len(F) * sizes.max(initial=0.0)].T


def _rested_steps(
    gains: Recursion, stage: Stage, predictor: LinearPredictor, N: int, inverse: Float[np.ndarray, "nz nz"]
) -> int:
    """Return the steps until the gain rests as far as the model is accurate, 0 where it does not."""
    scale = predictor.scale
    if scale is None:
        return 0
    enough, spread = max(_measure_residual(predictor, scale), SETTLED), _spread(predictor, scale) @ inverse.T
    nz, needed, rested = len(scale), len(predictor.lifting.bound or ()), 0
    K = np.zeros(stage.B.T.shape)
    for n in range(1, TRIALS.count_steps(N) + 1):
        found = gains.find_step(n)
        if found is None or not found.largest < HUGE:
            break
        moved, whole = (np.linalg.norm(found.L.T @ each[:, :nz] @ spread.T) for each in (found.K - K, found.K))
        K, rested = found.K, rested + 1 if moved <= enough * whole else 0
        if rested >= needed:
            return n
    return 0


def _spread(predictor: LinearPredictor, scale: Float[np.ndarray, "nz nz"]) -> Float[np.ndarray, "nz nz"]:
    """Return S for which SᵀS is the covariance of z over the data; of `scale` SᵀS is the mean of z zᵀ."""
    constant = predictor.lifting.constant_index
    if constant is None:
        return scale
    one = scale[:, [constant]] / np.linalg.norm(scale[:, constant])
    return scale - one @ (one.T @ scale)


def _measure_residual(predictor: LinearPredictor, scale: Float[np.ndarray, "nz nz"]) -> float:
    """Return what the model misses of its states in a step, as a share of what they vary, root mean square."""
    sizes: Float[np.ndarray, " nx"] = np.linalg.norm(_spread(predictor, scale) @ predictor.C.T, axis=0)
    if predictor.report is None or not (sizes > 0).any():
        return 0.0
    return float(np.sqrt(np.mean((predictor.report.residual[sizes > 0] / sizes[sizes > 0]) ** 2)))


def _last(stage: Stage) -> Float[np.ndarray, "nx nx"]:
    """Return the weight of the state after the last step: no change of the input follows it."""
    if stage.M is None:
        return stage.Q
    last = stage.Q.copy()
    last[-len(stage.R) :, -len(stage.R) :] = 0.0
    return last


def _resting(
    Phi: Float[np.ndarray, "nx nx"], b: Float[np.ndarray, "nx ng"], B: Float[np.ndarray, "nx nu"]
) -> Float[np.ndarray, "nx ng"]:
    """Return p = b + Φᵀb + (Φᵀ)²b + …, by doubling until Bᵀp rests: the part that no input sees may go on growing."""
    p, power = b, Phi.T
    for _ in range(int(np.log2(ITERATIONS)) + 1):
        if not np.abs(power).max() < LARGEST:  # the loop is not stable
            break
        new = power @ p
        p, power = p + new, power @ power
        if np.abs(B.T @ new).max(initial=0.0) <= EXACT * np.abs(B.T @ p).max(initial=0.0):
            break
    return p


def stop_growing_modes(A: Float[np.ndarray, "nz nz"], B: Float[np.ndarray, "nz nu"]) -> Float[np.ndarray, "nz nz"]:
    """Return A with every eigenvalue |λ| > 1 of a mode that no input moves replaced by λ/|λ|.

    Beyond the horizon such a mode stays as large as it is at its end; its growth, which no input can answer, would
    outweigh everything else. All other modes are as before. What an input moves is decided in balanced coordinates.
    """
    balanced, (size, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    columns = B / size[:, None]
    norms = np.linalg.norm(columns, axis=0)
    V = controllable(balanced, columns / np.where(norms > 0, norms, 1.0))
    U = scipy.linalg.null_space(V.T) if V.shape[1] else np.eye(len(A))
    if not U.shape[1]:
        return A
    unmoved = U.T @ balanced @ U
    if np.abs(np.linalg.eigvals(unmoved)).max() <= GROWS:
        return A
    change = U @ (_scale_to_unit_circle(unmoved) - unmoved) @ U.T
    return A + size[:, None] * change / size


def _scale_to_unit_circle(A: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return A with its eigenvalues beyond 1 scaled back to 1, all other modes as they were.

    Where the two groups of modes cannot be told apart by their eigenvectors, the others are no longer pushed as much.
    """
    try:
        T, Z, grows = scipy.linalg.schur(
            A, output="real", sort=lambda real, imaginary: abs(complex(real, imaginary)) > GROWS
        )
        grown, mixed, rest = T[:grows, :grows], T[:grows, grows:], T[grows:, grows:]
        X = scipy.linalg.solve_sylvester(grown, -rest, -mixed) if len(rest) else mixed  # T [X; 1] = [X; 1] rest
    except np.linalg.LinAlgError:  # eigenvalues within rounding of the bound changed sides when they were sorted
        pass
    else:
        if np.abs(X).max(initial=0.0) < APART:
            still = grown / _sizes(grown)[:, None]
            return Z @ np.block([[still, X @ rest - still @ X], [np.zeros_like(mixed.T), rest]]) @ Z.T
    T, Z = scipy.linalg.schur(A, output="real")
    return Z @ (T / np.maximum(_sizes(T), 1.0)[:, None]) @ Z.T


def _sizes(T: Float[np.ndarray, "n n"]) -> Float[np.ndarray, " n"]:
    """Return |λ| of the diagonal block that each row of a real Schur form belongs to."""
    result, i = np.abs(np.diag(T)), 0
    while i < len(T):
        pair = i + 1 < len(T) and T[i + 1, i] != 0
        if pair:
            result[i : i + 2] = np.sqrt(np.linalg.det(T[i : i + 2, i : i + 2]))
        i += 1 + pair
    return result
