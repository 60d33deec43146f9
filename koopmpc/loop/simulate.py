"""simulate: one controller on one plant, step by step; every step has a status, every input is finite."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import isfinite
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.move import Controller, Fallible, Move
from koopmpc.errors import DataError, ShapeError
from koopmpc.loop.faults import Fault, Injections, Wiring
from koopmpc.loop.run import Plans, Run, Step, StepRows
from koopmpc.plants.dynamics import Plant, require_plant
from koopmpc.plants.step_map import SimulatedPlant, StepMap
from koopmpc.predict.base import Predictor

Signal = ArrayLike | Callable[[int, np.random.Generator], ArrayLike]
StepObserver = Callable[[Step], None]


_CONTROLLER = (
    "a Controller has dt [s], nu, horizon (0 if it reads no preview), reset(x0, u_prev), and is called as "
    "controller(y, reference, applied) -> Move; make it a class, see km.control.Controller"
)
_MOVE = ("u", "status", "fallback", "solve_time", "iterations", "slack")


def simulate(
    plant: StepMap | Plant,
    controller: Controller,
    *,
    x0: ArrayLike | None,
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
    observers: Sequence[StepObserver] = (),
    plans: bool = False,
    preview: bool = True,
    angles: Sequence[int] = (),
    metadata: Mapping[str, Any] | None = None,
) -> Run:
    """Run u_k = controller(y_k, r_k … r_{k+N}), x_{k+1} = F(x_k, u_k) + d_k, y_k = h(x_k) + n_k for `steps` steps.

    Parameters
    ----------
    plant
        A StepMap, or any Plant. For model mismatch pass a plant that differs from the controller's model.
    controller
        Any Controller with the plant's dt. It is reset to x0 at the beginning.
    x0
        (nx,) initial state; None: the plant chooses its own initial state.
    reference
        (nr,) held throughout, or (steps+1, nr): row k belongs to x_k. The controller gets rows k … k+horizon, the
        last one repeated; with ``preview=False`` it gets row k repeated over its horizon.
    steps
        Number of steps T. If the plant ends the episode earlier, as a `GymPlant` may, the run ends there with a
        UserWarning, and the reason is in the metadata under "ended".
    cost, limits
        What the run is judged by; kept in the Run.
    u_reference
        (nu,) or (steps, nu): the inputs that hold the reference. The metrics charge ‖u_k − u_reference_k‖²_R, so
        staying at the reference costs nothing. By default they are those of the cost's u_target if that is given as
        numbers, else zero. Only the metrics use them; the controller does not see them.
    disturbance
        d_k, (nx,) or (steps, nx), or a function of (k, rng), added to the next state. Needs a simulated plant.
    noise
        n_k, (ny,) standard deviations of white noise, (steps+1, ny) values, or a function of (k, rng).
    measured
        w_k, (nw,) or (steps, nw): disturbances that the controller is told as `w`, rows k … k+horizon−1, the last
        one repeated; with ``preview=False`` it gets row k alone, to hold over its horizon. They do not move the
        plant: pass their effect as `disturbance`, for example ``disturbance=W @ E.T``. The metadata keep them under
        "measured".
    faults
        What breaks, see `km.faults`. A signal passes through them in order, y_k after its noise. Run.Y is what the
        controller got. Run.U is what the plant got, which the controller is told at the next step. The metadata
        list the faults under "faults".
    rng
        Seed of noise, disturbance and faults. Each fault has its own random generator, so noise and disturbance are
        the same with and without faults.
    observers
        Called once a step with a Step.
    plans
        Keep the plan of every step.
    preview
        Whether the controller gets the references and measured disturbances of the steps ahead.
    angles
        Indices of states whose errors wrap at ±π in the metrics.
    metadata
        Names, numbers and lists that the Run and its log keep.

    Raises
    ------
    ShapeError, DataError
        Sizes do not fit; plant or controller lack a member; a controller returned a u that is not finite.
    """
    steps, rng = checks.count(steps, "steps"), checks.generator(rng)
    x0 = None if x0 is None else checks.array(x0, "x0", (None,))
    checks.members(controller, "the controller", ("dt", "nu", "horizon", "reset", "__call__"), _CONTROLLER)
    if isinstance(plant, StepMap):
        plant = SimulatedPlant(plant)
    else:
        require_plant(plant)
    if abs(plant.dt - controller.dt) > 1e-12 * plant.dt:
        raise DataError(f"the controller has dt = {controller.dt:g} s, the plant {plant.dt:g} s; use one dt for both")
    first = plant.reset(x0, rng)
    states, inputs, outputs, state = tuple(plant.states), tuple(plant.inputs), tuple(plant.outputs), plant.state
    nx, ny, nu, N = len(states), len(_reading(first, None, 0)), controller.nu, controller.horizon
    if state is not None and np.shape(state) != (nx,):
        raise ShapeError(f"the plant's state has shape {np.shape(state)}, its states name {nx}; they must agree")
    scene, model = getattr(plant, "scene", None), predictor_of(controller)
    if nu != len(inputs):
        raise ShapeError(f"the controller returns {nu} inputs, the plant takes {len(inputs)} ({inputs})")
    rows = _rows_ahead(reference, "reference", "nr", steps + 1, N, "steps+1")
    nr = rows.shape[1] if cost is None else cost.of.bind(states).nz
    if rows.shape[1] != nr:
        raise ShapeError(f"reference has {rows.shape[1]} columns, the cost tracks {nr} outputs; pass one a column")
    outside = [i for i in angles if not 0 <= i < nx]
    if outside:
        raise DataError(f"angles holds {outside[0]}; pass indices of states, 0 to {nx - 1}")
    disturbed = _signal(disturbance, "disturbance", steps, nx)
    if disturbed is not None and not isinstance(plant, SimulatedPlant):
        raise DataError("a disturbance is added to the next state: pass a StepMap or a SimulatedPlant")
    noisy = _noise(noise, steps, ny)
    held = _held(u_reference, cost, steps, nu)
    metadata = {"controller": type(controller).__name__, **(metadata or {})}
    W = None
    if measured is not None:
        W = _rows_ahead(measured, "measured", "nw", steps, N, "steps")
        metadata["measured"] = W[:steps].tolist()
    broken = None
    if faults:
        broken = Injections(faults, Wiring(ny, (limits or Limits()).inputs(nu)), rng)
        metadata["faults"] = [str(fault) for fault in faults]

    def sensed(k: int, measurement: ArrayLike) -> Float[np.ndarray, " ny"]:
        y = _reading(measurement, ny, k)  # NaN passes: the controller then says BAD_MEASUREMENT
        if noisy is not None:
            y += noisy(k, rng)
        return y if broken is None else np.array(broken.measured(k, y), dtype=np.float64)

    def known() -> Float[np.ndarray, " nx"]:
        state = plant.state
        return hidden if state is None else np.array(state, dtype=np.float64)

    rows.setflags(write=False)  # the Run keeps these rows, so a controller must not write into them
    taken: list[Step] = []
    hidden = np.full(nx, np.nan)
    look_ahead = getattr(controller, "plan", None) if plans or observers else None
    x, y, applied = known(), sensed(0, first), None
    controller.reset(x0)
    for k in range(steps):
        ahead = rows[k : k + N + 1] if preview else np.broadcast_to(rows[k], (N + 1, nr))
        more = {} if W is None else {"w": W[k : k + max(N, 1)] if preview else W[k]}
        failing = controller if broken is not None and broken.solver_fails(k) else None
        if isinstance(failing, Fallible):
            failing.solver_fails = True
        try:
            move = controller(y.copy(), ahead, applied, **more)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise DataError("the controller wrote into the reference, which is the Run's own; copy it first") from error
        finally:
            if isinstance(failing, Fallible):
                failing.solver_fails = False
        if k == 0 or type(move) is not Move:
            checks.members(move, "what the controller returned", _MOVE, "return a km.Move")
        u = np.array(move.u, dtype=np.float64)
        if u.shape != (nu,):
            raise ShapeError(f"the controller returned u of shape {u.shape} at step {k}, expected ({nu},)")
        if not all(map(isfinite, u.tolist())):  # for a few inputs four times as fast as numpy
            raise DataError(f"the controller returned u = {u} at step {k}; every input must be finite")
        u = u if broken is None else np.array(broken.applied(k, u), dtype=np.float64)
        plan = None if look_ahead is None else look_ahead()
        if disturbed is not None and isinstance(plant, SimulatedPlant):
            y_next = plant.step(u.copy(), disturbed(k, rng))
        else:
            y_next = plant.step(u.copy())
        x_next, y_next = known(), sensed(k + 1, y_next)
        step = Step(k, y, u, rows[k], move, x, plan, x_next, y_next, rows[k + 1], held[k])
        for observer in observers:
            observer(step)
        taken.append(step if plans or plan is None else replace(step, plan=None))
        x, y, applied = x_next, y_next, u
        if (ended := getattr(plant, "ended", "")) and k + 1 < steps:
            metadata["ended"] = str(ended)
            warnings.warn(f"the plant ended the run after {k + 1} of {steps} steps: {ended}", UserWarning, stacklevel=2)
            break
    return Run(
        **StepRows.of(taken, nx, end=True).columns(),
        cost=cost,
        limits=limits,
        dt=plant.dt,
        states=states,
        inputs=inputs,
        outputs=outputs,
        plans=Plans.of([step.plan for step in taken]),
        angles=tuple(angles),
        metadata=metadata,
        scene=scene,
        model=model,
    )


def _reading(value: object, ny: int | None, k: int) -> Float[np.ndarray, " ny"]:
    """Return what a plant measured at step k as an array of its own."""
    try:
        y = None if value is None else np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        y = None
    if y is None:
        raise DataError(
            f"the plant returned {type(value).__name__} at step {k}; reset and step return y, a number each"
        )
    if y.ndim != 1 or (ny is not None and len(y) != ny):
        expected = "(ny,)" if ny is None else f"({ny},), as at reset"
        raise ShapeError(f"the plant returned y of shape {y.shape} at step {k}, expected {expected}")
    return y


def predictor_of(controller: object) -> Predictor | None:
    """Return the predictor that a controller holds, None where it has none."""
    held = (getattr(controller, name, None) for name in ("predictor", "model"))
    return next((each for each in held if isinstance(each, Predictor)), None)


def _rows_ahead(
    values: ArrayLike, name: str, columns: str, count: int, horizon: int, counted: str
) -> Float[np.ndarray, "T n"]:
    """Return `count` rows of a signal that is previewed, and after them `horizon` copies of the last one."""
    rows = np.atleast_1d(checks.array(values, name))
    if rows.ndim == 1:
        rows = np.broadcast_to(rows, (count, len(rows)))
    if rows.ndim != 2 or len(rows) != count:
        expected = f"({columns},) or ({counted}, {columns}) = ({count}, {columns})"
        raise ShapeError(f"{name} has shape {rows.shape}, expected {expected}")
    return np.vstack([rows, np.broadcast_to(rows[-1], (horizon, rows.shape[1]))])


def _held(u_reference: ArrayLike | None, cost: Cost | None, steps: int, nu: int) -> Float[np.ndarray, "T nu"]:
    """Return the reference input of each step, for the metrics.

    It is `u_reference` if given, else the cost's u_target if that is given as numbers, else zero.
    """
    if u_reference is None:
        given = None if cost is None else cost.given_inputs(nu)
        if given is None:
            return np.zeros((steps, nu))
        if 1 < len(given) < steps:
            raise ShapeError(f"u_target has {len(given)} rows, the run {steps} steps; pass one row, or one a step")
        return np.array(np.broadcast_to(given, (steps, nu)) if len(given) == 1 else given[:steps])
    values = checks.array(u_reference, "u_reference")
    if values.ndim < 2:
        return np.tile(checks.vector(values, "u_reference", nu), (steps, 1))
    return checks.array(values, "u_reference", (steps, nu))


def _signal(
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


def _noise(
    noise: Signal | None, steps: int, ny: int
) -> Callable[[int, np.random.Generator], Float[np.ndarray, " ny"]] | None:
    """Return the measurement noise as a function of (k, rng); a vector holds standard deviations."""
    if noise is None or callable(noise) or np.ndim(noise) == 2:
        return _signal(noise, "noise", steps + 1, ny)
    deviation = checks.vector(noise, "noise", ny)
    return lambda k, rng: deviation * rng.standard_normal(ny)
