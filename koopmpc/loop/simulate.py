"""simulate: one controller on one plant, step by step; every step has a status, every input is finite."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import isfinite
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.move import Controller, Fallback, Fallible, Move, Plan, Status, WholeRun
from koopmpc.errors import DataError, ShapeError
from koopmpc.loop.faults import Fault, Injections, Wiring
from koopmpc.loop.run import Plans, Run, Step
from koopmpc.plants.dynamics import Plant, reading, require_plant
from koopmpc.plants.step_map import SimulatedPlant, StepMap
from koopmpc.predict.base import Predictor

Signal = ArrayLike | Callable[[int, np.random.Generator], ArrayLike]
StepObserver = Callable[[Step], None]


CONTROLLER = ("dt", "nu", "horizon", "reset", "__call__")
HOW = (
    "a Controller has dt [s], nu, horizon (0 if it reads no preview), reset(x0, u_prev), and is called as "
    "controller(y, reference, applied) -> Move; make it a class, see km.control.Controller"
)
_STATUS, _FALLBACK = list(Status), list(Fallback)
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

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> mpc = km.LinearMPC(plant, [0, 0], [0], cost, limits, horizon=40)
    >>> run = km.simulate(plant, mpc, x0=[0.5, 0], reference=[0, 0], steps=100, cost=cost, limits=limits)
    >>> run.X.shape, run.U.shape, bool(abs(run.X[-1, 0]) < 0.01)
    ((101, 2), (100, 1), True)
    """
    steps, rng = checks.count(steps, "steps"), checks.generator(rng)
    x0 = None if x0 is None else checks.array(x0, "x0", (None,))
    checks.members(controller, "the controller", CONTROLLER, HOW)
    if not isinstance(plant, StepMap):
        require_plant(plant)
    if abs(plant.dt - controller.dt) > 1e-12 * plant.dt:
        raise DataError(f"the controller has dt = {controller.dt:g} s, the plant {plant.dt:g} s; use one dt for both")
    states, inputs, outputs = tuple(plant.states), tuple(plant.inputs), tuple(plant.outputs)
    nx, nu, N = len(states), controller.nu, controller.horizon
    if nu != len(inputs):
        raise ShapeError(f"the controller returns {nu} inputs, the plant takes {len(inputs)} ({inputs})")
    rows = rows_ahead(reference, "reference", "nr", steps + 1, N, "steps+1")
    if cost is not None:
        checks.kind(cost, "cost", Cost, "pass km.Cost(Q=…, R=…)")
    nr = rows.shape[1] if cost is None else cost.of.bind(states).nz
    if rows.shape[1] != nr:
        raise ShapeError(f"reference has {rows.shape[1]} columns, the cost tracks {nr} outputs; pass one a column")
    outside = [i for i in angles if not 0 <= i < nx]
    if outside:
        raise DataError(f"angles holds {outside[0]}; pass indices of states, 0 to {nx - 1}")
    disturbed = _signal(disturbance, "disturbance", steps, nx)
    if disturbed is not None and not isinstance(plant, StepMap | SimulatedPlant):
        raise DataError("a disturbance is added to the next state: pass a StepMap or a SimulatedPlant")
    held = _held(u_reference, cost, steps, nu)
    metadata, model = {"controller": type(controller).__name__, **(metadata or {})}, predictor_of(controller)
    W = None
    if measured is not None:
        W = rows_ahead(measured, "measured", "nw", steps, N, "steps")
        metadata["measured"] = W[:steps].tolist()
    if isinstance(plant, StepMap):
        if x0 is None:
            raise DataError("a simulated plant has no state of its own to begin in; pass x0")
        state = checks.array(x0, "x0", (nx,))
        first = plant.measure(state)
    else:
        first, state = reading(plant.reset(x0, rng), None, 0), plant.state
    ny = len(first)
    noisy = None if noise is None else _noise(noise, steps, ny)
    if state is not None and np.shape(state) != (nx,):
        raise ShapeError(f"the plant's state has shape {np.shape(state)}, its states name {nx}; they must agree")
    broken = None
    if faults:
        broken = Injections(faults, Wiring(ny, (limits or Limits()).inputs(nu)), rng)
        metadata["faults"] = [str(fault) for fault in faults]
    spoilt = noisy is not None or broken is not None
    seen = isinstance(plant, StepMap) and plant.measures_all and not spoilt  # y_k is x_k

    def sensed(k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        """Return what the controller gets of what the plant measured: NaN passes, and it says BAD_MEASUREMENT."""
        if noisy is not None:
            y += noisy(k, rng)
        return y if broken is None else np.array(broken.measured(k, y), dtype=np.float64)

    rows.setflags(write=False)  # the Run keeps these rows, so a controller must not write into them
    Y, U = np.empty((steps + 1, ny)), np.empty((steps, nu))
    X = Y if seen else np.full((steps + 1, nx), np.nan)
    status: list[Status] = []
    fallback: list[Fallback] = []
    solver: list[str] = []
    solve_time: list[float] = []
    iterations: list[int] = []
    slack, known = np.zeros(steps), np.full(steps, -1)
    found, plan, ended = None, None, ""
    fallible = controller if isinstance(controller, Fallible) else None
    look_ahead: Callable[[], Plan | None] | None = getattr(controller, "plan", None)
    applied, end = None, steps
    if state is not None:
        X[0] = state
    Y[0] = y = sensed(0, first) if spoilt else first
    own = getattr(model or getattr(controller, "step_map", None), "states", None)
    controller.reset(x0 if own is None or len(own) == nx else None)  # a model of other states knows no such x0
    begin, whole = 0, getattr(controller, "whole_run", None)  # of a compiled controller
    if whole is not None and isinstance(plant, StepMap) and not (spoilt or disturbed or observers or plans):
        done: WholeRun | None = whole(plant, rows, W, X, Y, U, preview=preview)
        if done is not None:
            begin = steps
            status = [_STATUS[i] for i in done.status.tolist()]
            fallback = [_FALLBACK[i] for i in done.fallback.tolist()]
            solver = ["daqp" if i else "" for i in done.iterations.tolist()]
            solve_time, iterations, slack = done.solve_time.tolist(), done.iterations.tolist(), done.slack
    for k in range(begin, steps):
        ahead = rows[k : k + N + 1] if preview else np.broadcast_to(rows[k], (N + 1, nr))
        failing = fallible if broken is not None and broken.solver_fails(k) else None
        if failing is not None:
            failing.solver_fails = True
        try:
            if W is None:
                move = controller(y, ahead, applied)
            else:
                move = controller(y, ahead, applied, w=W[k : k + max(N, 1)] if preview else W[k])
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise DataError("the controller wrote into the reference, which is the Run's own; copy it first") from error
        finally:
            if failing is not None:
                failing.solver_fails = False
        u = checked_input(move, nu, k)
        if broken is not None:
            u = np.array(broken.applied(k, u), dtype=np.float64)
        U[k] = u
        if plans and look_ahead is not None and (plan := look_ahead()) is not None:
            if found is None:
                found = Plans(*(np.full((steps, *part.shape), np.nan) for part in (plan.X, plan.U)))
            found.X[k], found.U[k] = plan.X, plan.U
        push = None if disturbed is None else disturbed(k, rng)
        if isinstance(plant, StepMap):
            x = X[k + 1]
            plant.advance(X[k], u, x)
            if push is not None:
                x += push
            y = x.copy() if seen else plant.measure(x)
        else:
            pushed = () if push is None else (push,)  # of a SimulatedPlant alone
            y = reading(plant.step(u.copy(), *pushed), ny, k + 1)
            u = U[k].copy()  # the controller may keep the other one
            if (state := plant.state) is not None:
                X[k + 1] = state
            ended = str(getattr(plant, "ended", ""))
        if spoilt:
            y = sensed(k + 1, y)
        if not seen:
            Y[k + 1] = y
        status.append(move.status)  # not the Move itself: thousands of objects keep the garbage collector busy
        fallback.append(move.fallback)
        solver.append(move.solver if type(move) is Move else str(getattr(move, "solver", "")))
        solve_time.append(move.solve_time)
        iterations.append(move.iterations)
        if move.slack:
            slack[k] = move.slack
        looked = move.known if type(move) is Move else getattr(move, "known", None)  # a user's own Move may lack it
        if looked is not None:
            known[k] = looked
        for observer in observers:
            ask = look_ahead if plan is None else partial(_same, plan)
            step = Step(k, Y[k], U[k], rows[k], move, X[k], X[k + 1], Y[k + 1], rows[k + 1], held[k], ask)
            observer(step)
            if ask is not None and plan is None:
                step.look_ahead = _gone  # the controller goes on to the next step
        applied = u
        if ended and k + 1 < steps:
            end, metadata["ended"] = k + 1, ended
            warnings.warn(f"the plant ended the run after {end} of {steps} steps: {ended}", UserWarning, stacklevel=2)
            break
    return Run(
        X=Y.copy() if seen else X[: end + 1],
        Y=Y[: end + 1],
        U=U[:end],
        reference=rows[: end + 1],
        u_reference=held[:end],
        status=tuple(status),
        fallback=tuple(fallback),
        solve_time=np.array(solve_time, dtype=np.float64),
        iterations=np.array(iterations, dtype=np.int64),
        slack=slack[:end],
        known=known[:end],
        solver=tuple(solver),
        cost=cost,
        limits=limits,
        dt=plant.dt,
        states=states,
        inputs=inputs,
        outputs=outputs,
        plans=None if found is None else Plans(found.X[:end], found.U[:end]),
        angles=tuple(angles),
        metadata=metadata,
        scene=getattr(plant, "scene", None),
        model=model,
    )


def checked_input(move: Move, nu: int, k: int) -> Float[np.ndarray, " nu"]:
    """Return the input of what a controller returned at step k; raise where that is no Move, or u not finite."""
    if type(move) is not Move:
        checks.members(move, "what the controller returned", _MOVE, "return a km.Move")
    u = np.asarray(move.u, dtype=np.float64)
    if u.shape != (nu,):
        raise ShapeError(f"the controller returned u of shape {u.shape} at step {k}, expected ({nu},)")
    for value in u.tolist():  # for a few inputs four times as fast as numpy
        if not isfinite(value):
            raise DataError(f"the controller returned u = {u} at step {k}; every input must be finite")
    return u


def _same(plan: Plan) -> Plan:
    """Return the plan that is kept."""
    return plan


def _gone() -> Plan | None:
    raise DataError("the controller has gone on: read step.plan while the observer is called, or pass plans=True")


def predictor_of(controller: object) -> Predictor | None:
    """Return the predictor that a controller holds, None where it has none."""
    held = (getattr(controller, name, None) for name in ("predictor", "model"))
    return next((each for each in held if isinstance(each, Predictor)), None)


def rows_ahead(
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


def _noise(noise: Signal, steps: int, ny: int) -> Callable[[int, np.random.Generator], Float[np.ndarray, " ny"]] | None:
    """Return the measurement noise as a function of (k, rng); a vector holds standard deviations."""
    if callable(noise) or np.ndim(noise) == 2:
        return _signal(noise, "noise", steps + 1, ny)
    deviation = checks.vector(noise, "noise", ny)
    return lambda k, rng: deviation * rng.standard_normal(ny)
