"""The search for the largest region that a certificate can be found for: over its scale, its ellipsoid, its decay."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.control.ask.checks import FEEDBACK_FIELDS
from koopmpc.control.ask.limits import Limits, require_known
from koopmpc.guarantees.deviation import DeviationModel
from koopmpc.guarantees.error_bounds import ErrorBound, ErrorPairs
from koopmpc.guarantees.semidefinite import FeedbackProof, FeedbackTask, solve_feedback
from koopmpc.lifting.base import find_observables

ROUNDING = 1e-10  # products v ⊗ φ with smaller entries than this share of A are rounding: the model is linear
_GROWTH = (2.0, 1.3, 1.1)  # factors by which the next ellipsoid may exceed the last region
DECAY = 1 - 1e-4  # V falls by this factor a step at least, where the error vanishes at the set point
_FASTER = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.25)  # 1 − ρ tried where it does not


Corners = tuple[ArrayLike, ArrayLike]


@dataclass(frozen=True)
class Room:
    """Where the region may lie: |C_i φ| ≤ half widths of a box of states, rows h of limits |h φ| ≤ 1, and |v| ≤ inputs.

    `widths` is (nx,), `rows` (p, n), `inputs` (m,).
    """

    widths: Float[np.ndarray, " nx"]
    rows: Float[np.ndarray, "p n"]
    inputs: Float[np.ndarray, " m"]

    def scale_by(self, scale: float) -> "Room":
        """Return the room with this share of the box of states; limits stay."""
        return replace(self, widths=scale * self.widths)


def find_room(
    model: DeviationModel,
    pairs: ErrorPairs,
    limits: Limits | None,
    region: Corners | None,
    *,
    sampled: bool,
    scenario: bool,
) -> tuple[Room, Float[np.ndarray, " nx"], Float[np.ndarray, " nx"]]:
    """Return where the region and the inputs may be, and the box of states that the bound of the error is on."""
    nx, nu = len(model.x), len(model.u)
    names = model.lifting.bound_states
    allowed = Limits() if limits is None else limits
    checks.kind(allowed, "limits", Limits, "or None for none")
    require_known(allowed, "a certificate", FEEDBACK_FIELDS - {"du_min", "du_max"})
    low, high = pairs.X.min(axis=0), pairs.X.max(axis=0)
    if region is not None:
        corners = checks.vector(region[0], "region", nx), checks.vector(region[1], "region", nx)
        low, high = _stay_inside(corners, (low, high), names) if scenario else corners
    x_low, x_high = allowed.states(nx)
    where = "the sampled box" if region is None else "the region"
    for box_low, box_high, what in ((low, high, where), (x_low, x_high, "the limits")):
        outside = np.flatnonzero((model.x <= box_low) | (model.x >= box_high))
        if outside.size:
            i = int(outside[0])
            raise DataError(
                f"the set point has {names[i]} = {model.x[i]:g}, which is not inside {what},"
                f" {box_low[i]:g} … {box_high[i]:g}; move the set point, or widen the box"
            )
    widths = np.minimum(np.minimum(model.x - low, high - model.x), np.minimum(model.x - x_low, x_high - model.x))
    rows = _limit_observables(model, allowed, names)
    u_low, u_high = allowed.inputs(nu)
    if sampled:  # a bound that is given holds for all inputs that the limits allow
        u_low, u_high = np.maximum(u_low, pairs.U.min(axis=0)), np.minimum(u_high, pairs.U.max(axis=0))
    if ((model.u <= u_low) | (model.u >= u_high)).any():
        raise DataError(
            f"the input of the set point is {model.u.tolist()}, which is not inside both the limits and the sampled"
            f" inputs, {u_low.tolist()} … {u_high.tolist()}; sample inputs on both sides of it"
        )
    inputs = np.minimum(model.u - u_low, u_high - model.u)
    return Room(widths, rows, inputs), low, high


def _limit_observables(model: DeviationModel, limits: Limits, names: Sequence[str]) -> Float[np.ndarray, "p n"]:
    """Return the rows h of limits of observables, |h φ| ≤ 1."""
    if limits.of is None:
        return np.empty((0, len(model.kept)))
    wanted = limits.of.bind(tuple(names))
    y_low, y_high = (end[len(names) :] for end in limits.ends(len(names), wanted.nz))
    y = wanted(model.x)
    half = np.minimum(y - y_low, y_high - y)
    if (half <= 0).any():
        raise DataError("the limits y_min … y_max exclude the set point; move it, or widen them")
    place = {int(kept): i for i, kept in enumerate(model.kept)}
    pairs = zip(find_observables(model.lifting, wanted), half, strict=True)
    limited = [(place[int(index)], h) for index, h in pairs if np.isfinite(h) and int(index) in place]
    return np.array([np.eye(len(model.kept))[i] / h for i, h in limited]).reshape(-1, len(model.kept))


def _stay_inside(
    region: tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nx"]],
    sampled: tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nx"]],
    names: Sequence[str],
) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nx"]]:
    """Return the part of a region that was sampled; a bound that is made of samples says nothing of the rest."""
    (low, high), (first, last) = region, sampled
    beyond = np.maximum(first - low, high - last) / np.maximum(last - first, 1e-300)
    i = int(np.argmax(beyond))
    # share of the sampled width by which a region may be wider; it is cut there
    if beyond[i] > 0.05:
        raise DataError(
            f"the region has {names[i]} = {low[i]:g} … {high[i]:g}, and the data have {first[i]:g} … {last[i]:g}; a"
            " bound of the error from data holds where they are: pass a region inside, or collect data in it"
        )
    return np.maximum(low, first), np.minimum(high, last)


@dataclass(frozen=True)
class Found:
    """A proof in the model's own coordinates.

    P, K, K_w as in `FeedbackProof`; `ball` is the level of V that is reached, 0 for the set point itself.
    """

    P: Float[np.ndarray, "n n"]
    K: Float[np.ndarray, "m n"]
    K_w: Float[np.ndarray, "m mn"]
    decay: float
    margin: float
    size: float
    ball: float
    scale: float
    bound: ErrorBound


def make_task(model: DeviationModel, bound: ErrorBound, room: Room, decay: float) -> FeedbackTask:
    """Return the task in the sizes D of φ and d of v, with the ball of the room as the first ellipsoid."""
    D, d = bound.phi_size, bound.v_size
    n, m = len(D), len(d)
    bilinear = bool(np.abs(model.N).max(initial=0.0) > ROUNDING * np.abs(model.A).max())
    C = model.C * D
    rows = np.vstack([C / room.widths[:, None], room.rows * D])
    rows = rows[np.isfinite(rows).all(axis=1) & (np.abs(rows).max(axis=1, initial=0.0) > 0)]
    narrow = max(1.0, float((rows**2).sum(axis=1).max(initial=0.0)))  # a small room asks for a small ellipsoid
    return FeedbackTask(
        A=model.A * D / D[:, None],
        B=model.B * d / D[:, None],
        N=model.N * np.kron(d, D) / D[:, None] if bilinear else None,
        S=bound.shape / np.outer(D, D),
        c_x=bound.c_x,
        c_u=bound.c_u,
        E=np.eye(n) * n * 3.0 / narrow,
        inputs=room.inputs / d if m else room.inputs,
        rows=rows,
        volume=C / np.linalg.norm(C, axis=1, keepdims=True),
        decay=decay,
    )


def grow(task: FeedbackTask, *, linear: bool = False) -> FeedbackProof | None:
    """Return the proof with the largest region that is found by letting the ellipsoid E follow the region."""
    best = solve_feedback(task, linear=linear)
    # ellipsoids tried before a program counts as infeasible
    for _ in range(2):
        if best is not None:
            break
        task = replace(task, E=0.03 * task.E)  # factor of the first ellipsoid from try to try
        best = solve_feedback(task, linear=linear)
    if best is None or task.N is None:
        return best
    # times that the ellipsoid follows the region
    for _ in range(5):
        before = best.size
        for factor in _GROWTH:
            tried = solve_feedback(replace(task, E=factor * best.P), linear=linear)
            if tried is not None and tried.size > best.size:
                best = tried
                break
        # stop where log det grows by less
        if best.size < before + 0.05:
            break
    return best


def prove(
    model: DeviationModel,
    bound: ErrorBound,
    room: Room,
    scale: float,
    *,
    decay: float | None = None,
    noise: float = 0.0,
    linear: bool = False,
) -> Found | None:
    """Return the best proof for one bound and one room, None where there is none."""
    constant = bound.c_0 > 0 or noise > 0
    decays = [decay] if decay is not None else [1 - step for step in _FASTER] if constant else [DECAY]
    best: Found | None = None
    last: FeedbackProof | None = None
    for rho in decays:
        task = make_task(model, bound, room, rho)
        if noise:
            task = replace(task, inputs=0.9 * task.inputs)  # the rest is for what noise adds
        if last is None:
            proof = grow(task, linear=linear or noise > 0)
        else:  # the ellipsoid of the slower decay is a good one
            proof = solve_feedback(replace(task, E=1.3 * last.P), linear=linear or noise > 0)
        if proof is None:
            break  # a faster decay is harder
        last = proof
        found = _finish(task, proof, bound, room, rho, noise, scale)
        if found is not None and (best is None or found.ball < best.ball or not constant):
            best = found
    return best


def _finish(
    task: FeedbackTask, proof: FeedbackProof, bound: ErrorBound, room: Room, rho: float, noise: float, scale: float
) -> Found | None:
    """Return the proof in the model's coordinates; None where the constant part pushes out of the region.

    √V is a norm, so √V(φ⁺) ≤ √ρ √V(φ) + δ, with δ the norm of the constant part: of the error, and of what noise of
    size η does to the input, B K η + N (K η ⊗ φ), and to the bound, c_u ‖K η‖. The ball is V ≤ (δ / (1 − √ρ))².
    """
    P, K, D, d = proof.P, proof.K, bound.phi_size, bound.v_size
    factor = np.linalg.cholesky(P)
    length = float(np.linalg.norm(np.linalg.solve(factor, np.linalg.cholesky(task.S)), 2))
    delta = bound.c_0 * length
    if noise:
        gain = float(np.linalg.norm(K, 2))
        delta += noise * (float(np.linalg.norm(np.linalg.solve(factor, task.B @ K), 2)) + bound.c_u * gain * length)
        if task.N is not None:
            n = len(P)
            for i in range(len(K)):
                Ni = task.N[:, i * n : (i + 1) * n]
                delta += noise * gain * float(np.linalg.norm(np.linalg.solve(factor, Ni @ factor), 2))
        reach = np.linalg.norm(K @ factor, axis=1) + noise * np.linalg.norm(K, axis=1)
        if (reach > room.inputs / d * (1 + 1e-9)).any():
            return None
    radius = delta / (1 - np.sqrt(rho))
    if radius > 1:
        return None
    return Found(
        P * np.outer(D, D),
        d[:, None] * K / D,
        proof.K_w / np.kron(d, D) * d[:, None],
        rho,
        proof.margin,
        proof.size,
        float(radius**2),
        scale,
        bound,
    )


def find_largest(provable: Callable[[float], bool], low: float, high: float, steps: int = 5) -> float:
    """Return the largest factor between low and high, on a logarithmic scale, that is provable; 0 where low is not."""
    if not provable(low):
        return 0.0
    for _ in range(steps):
        middle = float(np.sqrt(low * high))
        if provable(middle):
            low = middle
        else:
            high = middle
    return low
