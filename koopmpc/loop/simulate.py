"""simulate: one controller on one plant, step by step; every step has a status, every input is finite."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.move import Controller, Move, Plan
from koopmpc.errors import DataError, ShapeError
from koopmpc.loop.injection import Fault, Injections, Wiring, call, named
from koopmpc.loop.run import Plans, Run
from koopmpc.plants.simulated import Plant, SimulatedPlant, require_plant
from koopmpc.plants.step_map import StepMap

Signal = ArrayLike | Callable[[int, np.random.Generator], ArrayLike]


def reference_rows(reference: ArrayLike, steps: int, horizon: int) -> Float[np.ndarray, "T nr"]:
    """Return steps + horizon + 1 rows, the last one repeated."""
    rows = checks.array(reference, "reference")
    rows = np.atleast_1d(rows)
    if rows.ndim == 1:
        rows = np.broadcast_to(rows, (steps + 1, len(rows)))
    if rows.shape[0] != steps + 1:
        raise ShapeError(f"reference has shape {rows.shape}, expected (nr,) or (steps+1, nr) = ({steps + 1}, nr)")
    return np.vstack([rows, np.broadcast_to(rows[-1], (horizon, rows.shape[1]))])


def held_inputs(u_reference: ArrayLike | None, steps: int, nu: int) -> Float[np.ndarray, "T nu"]:
    """Return one row a step of the inputs that hold the reference; zeros where there are none."""
    if u_reference is None:
        return np.zeros((steps, nu))
    values = checks.array(u_reference, "u_reference")
    if values.ndim < 2:
        return np.tile(checks.vector(values, "u_reference", nu), (steps, 1))
    return checks.array(values, "u_reference", (steps, nu))


def measured_rows(measured: ArrayLike, steps: int, horizon: int) -> Float[np.ndarray, "T nw"]:
    """Return steps + horizon rows of measured disturbances, the last one repeated."""
    rows = np.atleast_1d(checks.array(measured, "measured"))
    if rows.ndim == 1:
        rows = np.broadcast_to(rows, (steps, len(rows)))
    if rows.ndim != 2 or len(rows) != steps:
        raise ShapeError(f"measured has shape {rows.shape}, expected (nw,) or (steps, nw) = ({steps}, nw)")
    return np.vstack([rows, np.broadcast_to(rows[-1], (horizon, rows.shape[1]))])


def signal_of(
    signal: Signal | None, name: str, rows: int, n: int
) -> Callable[[int, np.random.Generator], Float[np.ndarray, " n"]] | None:
    """Return the signal as a function of (k, rng); None where there is none."""
    if signal is None:
        return None
    if callable(signal):
        return lambda k, rng: checks.array(signal(k, rng), name, (n,))
    values = checks.array(signal, name)
    if values.ndim < 2:
        constant = checks.vector(values, name, n)
        return lambda k, rng: constant
    values = checks.array(values, name, (rows, n))
    return lambda k, rng: values[k]


def noise_of(
    noise: Signal | None, steps: int, ny: int
) -> Callable[[int, np.random.Generator], Float[np.ndarray, " ny"]] | None:
    """Return the measurement noise as a function of (k, rng); a vector holds standard deviations."""
    if noise is None or callable(noise) or np.ndim(noise) == 2:
        return signal_of(noise, "noise", steps + 1, ny)
    deviation = checks.vector(noise, "noise", ny)
    return lambda k, rng: deviation * rng.standard_normal(ny)


_CONTROLLER = (
    "a Controller has dt [s], nu, horizon (0 if it reads no preview), reset(x0, u_prev), and is called as "
    "controller(y, reference, applied) -> Move; make it a class, see km.control.Controller"
)
_MOVE = ("status", "fallback", "solve_time", "iterations", "slack")


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a closed loop as an observer sees it: x_k, y_k, the Move, and where it led.

    `simulate` fills every field; in a loop of one's own k, y, u and reference are enough.
    """

    k: int
    y: Float[np.ndarray, " ny"]
    u: Float[np.ndarray, " nu"]
    reference: Float[np.ndarray, " nr"]
    move: Move | None = None
    x: Float[np.ndarray, " nx"] | None = None
    plan: Plan | None = None
    x_next: Float[np.ndarray, " nx"] | None = None
    y_next: Float[np.ndarray, " ny"] | None = None
    reference_next: Float[np.ndarray, " nr"] | None = None
    u_reference: Float[np.ndarray, " nu"] | None = None


Observer = Callable[[Step], None]


def simulate(
    plant: StepMap | Plant,
    controller: Controller,
    *,
    x0: ArrayLike,
    reference: ArrayLike,
    steps: int,
    cost: Cost | None = None,
    limits: Limits | None = None,
    u_reference: ArrayLike | None = None,
    disturbance: Signal | None = None,
    noise: Signal | None = None,
    measured: ArrayLike | None = None,
    faults: Sequence[Fault] = (),
    rng: np.random.Generator | int = 0,
    observers: Sequence[Observer] = (),
    plans: bool = False,
    preview: bool = True,
    angles: Sequence[int] = (),
    metadata: Mapping[str, Any] | None = None,
) -> Run:
    """Run u_k = controller(y_k, r_k … r_{k+N}), x_{k+1} = F(x_k, u_k) + d_k, y_k = h(x_k) + n_k for `steps` steps.

    Parameters
    ----------
    plant
        A StepMap, or any Plant. Model mismatch is a plant other than the controller's model.
    x0
        (nx,) initial state.
    reference
        (nr,) held throughout, or (steps+1, nr): row k belongs to x_k. The controller gets rows k … k+horizon, the
        last one repeated; with ``preview=False`` row k throughout.
    cost, limits
        What the run is judged by; kept in the Run.
    u_reference
        (nu,) or (steps, nu): the inputs that hold the reference. The metrics charge ‖u_k − u_reference_k‖²_R, so
        that rest on the reference costs nothing; zero by default. The controller is not told.
    disturbance
        d_k, (nx,) or (steps, nx), or a function of (k, rng), added to the next state. Needs a simulated plant.
    noise
        n_k, (ny,) standard deviations of white noise, (steps+1, ny) values, or a function of (k, rng).
    measured
        w_k, (nw,) or (steps, nw): disturbances that the controller is told as `w`, rows k … k+horizon−1, the last
        one repeated; with ``preview=False`` row k throughout. What they do to the plant is a `disturbance`, such as
        W @ E.T. Kept in the metadata.
    faults
        What breaks, see `koopmpc.loop.faults`; a signal passes through them in order, y_k after its noise. Run.Y is
        what the controller got and Run.U what the plant got, which the controller is told at the next step; the
        metadata name them under "faults".
    observers
        Called once a step with a Step.
    plans
        Keep the plan of every step.
    angles
        Indices of states whose errors wrap at ±π in the metrics.

    Raises
    ------
    ShapeError, DataError
        Sizes do not fit; plant or controller lack a member; a controller returned a u that is not finite.
    """
    steps = checks.count(steps, "steps")
    rng = checks.generator(rng)
    if isinstance(plant, StepMap):
        plant = SimulatedPlant(plant)
    require_plant(plant)
    checks.members(controller, "the controller", ("dt", "nu", "horizon", "reset", "__call__"), _CONTROLLER)
    if abs(plant.dt - controller.dt) > 1e-12 * plant.dt:
        raise DataError(f"the controller has dt = {controller.dt:g} s, the plant {plant.dt:g} s; use one dt for both")
    x0 = checks.array(x0, "x0", (None,))
    y = _measured(plant.reset(x0, rng))
    nx, ny, nu = len(plant.states), len(y), controller.nu
    if nu != len(plant.inputs):
        raise ShapeError(f"the controller returns {nu} inputs, the plant takes {len(plant.inputs)} ({plant.inputs})")
    rows = reference_rows(reference, steps, controller.horizon)
    nr = rows.shape[1] if cost is None else cost.of.bind(plant.states).nz
    if rows.shape[1] != nr:
        raise ShapeError(f"reference has {rows.shape[1]} columns, the cost tracks {nr} outputs; pass one a column")
    outside = [i for i in angles if not 0 <= i < nx]
    if outside:
        raise DataError(f"angles holds {outside[0]}; pass indices of states, 0 to {nx - 1}")
    push = signal_of(disturbance, "disturbance", steps, nx)
    if push is not None and not isinstance(plant, SimulatedPlant):
        raise DataError("a disturbance is added to the next state: pass a StepMap or a SimulatedPlant")
    jitter = noise_of(noise, steps, ny)
    held = held_inputs(u_reference, steps, nu)
    told = None if measured is None else measured_rows(measured, steps, controller.horizon)
    if told is not None:
        metadata = {**(metadata or {}), "measured": told[:steps].tolist()}
    injected = None
    if faults:
        box = (limits or Limits()).inputs(nu)
        injected = Injections(faults, Wiring(ny, box), rng)
        metadata = {**(metadata or {}), "faults": named(faults)}

    X, Y, U = np.full((steps + 1, nx), np.nan), np.empty((steps + 1, ny)), np.empty((steps, nu))
    moves: list[Move] = []
    kept: list[Plan | None] = []
    look_ahead = getattr(controller, "plan", None)
    N = controller.horizon
    Y[0] = y if jitter is None else y + jitter(0, rng)
    if injected is not None:
        Y[0] = injected.measured(0, Y[0].copy())
    _store(X, 0, plant.state)
    controller.reset(x0)
    for k in range(steps):
        ahead = rows[k : k + N + 1] if preview else np.broadcast_to(rows[k], (N + 1, rows.shape[1]))
        applied = U[k - 1] if k else None
        more = {} if told is None else {"w": told[k : k + max(N, 1)] if preview else told[k]}
        fails = injected is not None and injected.solver_fails(k)
        move = call(controller, Y[k].copy(), ahead, applied, solver_fails=fails, **more)
        if k == 0:
            checks.members(move, "what the controller returned", ("u", *_MOVE), "return a km.Move")
        if np.shape(move.u) != (nu,):
            raise ShapeError(f"the controller returned u of shape {np.shape(move.u)} at step {k}, expected ({nu},)")
        if not np.isfinite(move.u).all():
            raise DataError(f"the controller returned u = {move.u} at step {k}; every input must be finite")
        U[k] = move.u if injected is None else injected.applied(k, move.u)
        moves.append(move)
        plan = look_ahead() if look_ahead is not None and (plans or observers) else None
        kept.append(plan if plans else None)
        if push is not None and isinstance(plant, SimulatedPlant):
            y = _measured(plant.step(U[k].copy(), push(k, rng)))
        else:
            y = _measured(plant.step(U[k].copy()))
        Y[k + 1] = y if jitter is None else y + jitter(k + 1, rng)
        if injected is not None:
            Y[k + 1] = injected.measured(k + 1, Y[k + 1].copy())
        _store(X, k + 1, plant.state)
        if observers:
            step = Step(k, Y[k], U[k], rows[k], move, X[k], plan, X[k + 1], Y[k + 1], rows[k + 1], held[k])
            for observer in observers:
                observer(step)
    return Run(
        X=X,
        Y=Y,
        U=U,
        reference=rows[: steps + 1].copy(),
        status=tuple(m.status for m in moves),
        fallback=tuple(m.fallback for m in moves),
        solve_time=np.array([m.solve_time for m in moves]),
        iterations=np.array([m.iterations for m in moves], dtype=np.int64),
        slack=np.array([m.slack for m in moves]),
        cost=cost,
        limits=limits,
        dt=plant.dt,
        states=tuple(plant.states),
        inputs=tuple(plant.inputs),
        outputs=tuple(plant.outputs),
        plans=_stack(kept) if plans else None,
        angles=tuple(angles),
        metadata=dict(metadata or {}),
        u_reference=held,
    )


def _measured(y: Any) -> Float[np.ndarray, " ny"]:
    return np.array(y, dtype=np.float64)  # NaN passes: a sensor may fail, and the controller says BAD_MEASUREMENT


def _store(X: Float[np.ndarray, "T1 nx"], k: int, state: Float[np.ndarray, " nx"] | None) -> None:
    if state is not None:
        X[k] = state


def _stack(plans: Sequence[Plan | None]) -> Plans | None:
    """Stack the plans; rows of NaN where a step had none."""
    first = next((p for p in plans if p is not None), None)
    if first is None:
        return None
    nothing = Plan(np.full_like(first.X, np.nan), np.full_like(first.U, np.nan))
    whole = [nothing if p is None else p for p in plans]
    return Plans(np.stack([p.X for p in whole]), np.stack([p.U for p in whole]))
