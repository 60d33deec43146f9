"""simulate: one controller on one plant, step by step; every step has a status, every input is finite.

`_Wiring` is the loop that is asked for, checked. `_step_through` makes the steps. `LoopRows` keeps them.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError, refuse_moved
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.ask.preview import require_preview
from koopmpc.control.function import as_controller
from koopmpc.control.move import Controller, Fallible, Move, Plan
from koopmpc.data.excitation import Excitation
from koopmpc.loop.controllers import checked_input, count_disturbances, predictor_of, require_match, start_for
from koopmpc.loop.faults import Fault, Injections, Wiring
from koopmpc.loop.rows import LoopRows, Step
from koopmpc.loop.run import Run
from koopmpc.loop.signals import Draw, Signal, find_reference_inputs, make_noise, make_signal, rows_ahead, tracked_rows
from koopmpc.plants.plant import Plant, SimulatedPlant, read_measurement
from koopmpc.plants.step_map import StepMap

StepObserver = Callable[[Step], None]


@dataclass(frozen=True, eq=False)
class LoopOptions:
    """What is seldom asked of a loop: `simulate(…, options=km.loop.LoopOptions(noise=0.01, rng=3))`.

    Attributes
    ----------
    noise
        n_k, (ny,) standard deviations of white noise, (steps+1, ny) values, or a function of (k, rng).
    disturbance
        d_k, (nx,) or (steps, nx), or a function of (k, rng), added to the next state. Needs a simulated plant.
    faults
        What breaks, see `km.faults`. A signal passes through them in order, y_k after its noise. Run.Y is what the
        controller got. Run.U is what the plant got, which the controller is told at the next step. The metadata
        list the faults under "faults".
    rng
        Seed of noise, disturbance and faults. Each fault has its own random generator, so noise and disturbance are
        the same with and without faults.
    preview
        Whether the controller gets the references and measured disturbances of the steps ahead.
    plans
        Keep the plan of every step.
    u_reference
        (nu,) or (steps, nu): the inputs that hold the reference. The metrics charge ‖u_k − u_reference_k‖²_R, so
        staying at the reference costs nothing. By default they are those of the cost's u_target if that is given as
        numbers, else zero. Only the metrics use them; the controller does not see them.
    angles
        Indices of states whose errors wrap at ±π in the metrics.
    metadata
        Names, numbers and lists that the Run and its log keep.
    """

    noise: Signal | None = None
    disturbance: Signal | None = None
    faults: Sequence[Fault] = ()
    rng: np.random.Generator | int = 0
    preview: bool = True
    plans: bool = False
    u_reference: ArrayLike | None = None
    angles: Sequence[int] = ()
    metadata: Mapping[str, Any] | None = None


def simulate(
    plant: StepMap | Plant,
    controller: Controller | Excitation | Callable[..., Any],
    *,
    x0: ArrayLike | None,
    reference: ArrayLike,
    steps: int,
    cost: Cost | None = None,
    limits: Limits | None = None,
    measured: ArrayLike | None = None,
    observers: Sequence[StepObserver] = (),
    options: LoopOptions | None = None,
    **moved: Any,
) -> Run:
    """Run u_k = controller(y_k, r_k … r_{k+N}), x_{k+1} = F(x_k, u_k, w_k) + d_k, y_k = h(x_k) + n_k for `steps` steps.

    Parameters
    ----------
    plant
        A StepMap, or any Plant. For model mismatch pass a plant that differs from the controller's model.
    controller
        Any Controller with the plant's dt, a function u = f(y, r), or an excitation. It is reset to x0 first.
    x0
        (nx,) initial state; None: the plant chooses its own initial state.
    reference
        (nr,) held throughout, or (steps+1, nr): row k belongs to x_k. The controller gets rows k … k+horizon, the
        last one repeated; without a preview it gets row k repeated over its horizon. Of (steps+1+horizon, nr) the
        last rows are seen ahead, in place of that last one, and never reached.
    steps
        Number of steps T. If the plant ends the episode earlier, as a `GymPlant` may, the run ends there with a
        UserWarning, and the reason is in the metadata under "ended".
    cost, limits
        What the run is judged by; kept in the Run. Limits in time have rows for all its steps. The controller has
        limits of its own, whose rows move along with the run.
    measured
        w_k, (nw,) or (steps, nw): disturbances that the controller is told as `w`, rows k … k+horizon−1, the last
        one repeated; without a preview it gets row k alone, to hold over its horizon. A plant that has measured
        disturbances of its own needs them, and a controller whose model has none is then not told. Any other plant is
        not moved by them: pass their effect as a disturbance, for example ``LoopOptions(disturbance=W @ E.T)``. The
        metadata keep them under "measured".
    observers
        Called once a step with a Step.
    options
        Noise, disturbances, faults, plans and what else is seldom asked: see `km.loop.LoopOptions`.

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
    refuse_moved(moved, LoopOptions, "km.loop.LoopOptions")
    asked = LoopOptions() if options is None else options
    checks.kind(asked, "options", LoopOptions, "pass km.loop.LoopOptions(…)")
    steps, x0 = checks.count(steps, "steps"), None if x0 is None else checks.array(x0, "x0", (None,))
    if limits is not None:  # the cost is checked with the reference
        checks.kind(limits, "limits", Limits, "pass km.Limits(u_min=…, u_max=…), or leave it out")
        require_preview(limits.resolve(plant.states, plant.inputs), steps, "the run")
    if not hasattr(controller, "reset") and hasattr(plant, "dt") and hasattr(plant, "inputs"):
        controller = as_controller(controller, plant.dt, len(plant.inputs))
    controller = require_match(plant, controller, asked.angles)
    start = start_for(controller, x0)
    wiring = _Wiring(
        plant=plant,
        controller=controller,
        steps=steps,
        reference=tracked_rows(reference, cost, plant, steps, controller.horizon),
        u_reference=find_reference_inputs(asked.u_reference, cost, steps, controller.nu),
        measured=None
        if measured is None
        else rows_ahead(measured, "measured", "nw", steps, controller.horizon, "steps"),
        preview=asked.preview,
        disturbance=make_signal(asked.disturbance, "disturbance", steps, len(plant.states)),
        rng=checks.generator(asked.rng),
    )
    rows = wiring.begin(x0, asked, limits)
    controller.reset(start)
    metadata = wiring.describe(asked)
    if observers or asked.plans or not _run_at_once(wiring, rows):
        ended = _step_through(wiring, rows, observers)
        if ended:
            metadata["ended"] = ended
            warnings.warn(
                f"the plant ended the run after {rows.steps} of {steps} steps: {ended}", UserWarning, stacklevel=2
            )
    return Run(
        **rows.columns(),
        cost=cost,
        limits=limits,
        dt=plant.dt,
        states=tuple(plant.states),
        inputs=tuple(plant.inputs),
        outputs=tuple(plant.outputs),
        angles=tuple(asked.angles),
        metadata=metadata,
        scene=getattr(plant, "scene", None),
        model=predictor_of(controller),
    )


@dataclass(eq=False)
class _Wiring:
    """The loop that is asked for, checked: plant, controller, and every signal as rows or as a function of (k, rng).

    `reference` holds T + 1 + N rows and `measured` T + N, the last one repeated for the preview. `u_reference` are the
    (T, nu) inputs that hold the reference. None stands for a signal that is not asked for.
    """

    plant: StepMap | Plant
    controller: Controller
    steps: int
    reference: Float[np.ndarray, "rows nr"]
    u_reference: Float[np.ndarray, "T nu"]
    measured: Float[np.ndarray, "wrows nw"] | None
    preview: bool
    disturbance: Draw | None
    rng: np.random.Generator
    noise: Draw | None = None
    faults: Injections | None = None
    driving: Float[np.ndarray, "wrows nw"] | None = field(init=False)  # the rows of w that move the plant
    told: Float[np.ndarray, "wrows nw"] | None = field(init=False)  # those that the controller gets

    def __post_init__(self) -> None:
        if self.disturbance is not None and not isinstance(self.plant, StepMap | SimulatedPlant):
            raise DataError("a disturbance is added to the next state: pass a StepMap or a SimulatedPlant")
        self.driving = _check_measured(self.plant, self.measured)
        blind = self.driving is not None and count_disturbances(self.controller) == 0
        self.told = None if blind else self.measured
        self.reference.setflags(write=False)  # the Run keeps these rows, so a controller must not write into them

    @property
    def sees_state(self) -> bool:
        """Whether y_k is x_k."""
        whole = isinstance(self.plant, StepMap) and self.plant.measures_all
        return whole and self.noise is None and self.faults is None

    def begin(self, x0: Float[np.ndarray, " nx"] | None, asked: LoopOptions, limits: Limits | None) -> LoopRows:
        """Start the plant, the noise and the faults; return the rows of the run, with the first measurement in them."""
        y0, state = self.start_plant(x0)
        self.noise = None if asked.noise is None else make_noise(asked.noise, self.steps, len(y0))
        if asked.faults:
            box = (limits or Limits()).resolve(self.plant.states, self.plant.inputs).base.inputs(self.controller.nu)
            self.faults = Injections(asked.faults, Wiring(len(y0), box), self.rng)
        return LoopRows(
            self.sense(0, y0),
            np.full(len(self.plant.states), np.nan) if state is None else state,
            self.reference,
            self.u_reference,
            sees_state=self.sees_state,
            plans=asked.plans,
        )

    def describe(self, asked: LoopOptions) -> dict[str, Any]:
        """Return the metadata of the run."""
        metadata = {"controller": type(self.controller).__name__, **(asked.metadata or {})}
        if self.measured is not None:
            metadata["measured"] = self.measured[: self.steps].tolist()
        if asked.faults:
            metadata["faults"] = [str(fault) for fault in asked.faults]
        return metadata

    def start_plant(
        self, x0: Float[np.ndarray, " nx"] | None
    ) -> tuple[Float[np.ndarray, " ny"], Float[np.ndarray, " nx"] | None]:
        """Return the first measurement, and the first state; None where the plant hides it."""
        plant, shape = self.plant, (len(self.plant.states),)
        if isinstance(plant, StepMap):
            if x0 is None:
                raise DataError("a simulated plant has no state of its own to begin in; pass x0")
            state = checks.array(x0, "x0", shape)
            return plant.measure(state), state
        y0, state = read_measurement(plant.reset(x0, self.rng), None, 0), plant.state
        if state is not None and np.shape(state) != shape:
            raise ShapeError(
                f"the plant's state has shape {np.shape(state)}, its states name {shape[0]}; they must agree"
            )
        return y0, state

    def sense(self, k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        """Return what the controller gets of what the plant measured: NaN passes, and it says BAD_MEASUREMENT."""
        if self.noise is not None:
            y += self.noise(k, self.rng)
        return y if self.faults is None else np.array(self.faults.measured(k, y), dtype=np.float64)

    def ask(self, k: int, y: Float[np.ndarray, " ny"], applied: Float[np.ndarray, " nu"] | None) -> Move:
        """Return the move of the controller at step k."""
        controller, rows, W, N = self.controller, self.reference, self.told, self.controller.horizon
        ahead = rows[k : k + N + 1] if self.preview else np.broadcast_to(rows[k], (N + 1, rows.shape[1]))
        fails = self.faults is not None and self.faults.solver_fails(k)
        failing = controller if fails and isinstance(controller, Fallible) else None
        try:
            if failing is not None:
                failing.solver_fails = True
            if W is None:
                return controller(y, ahead, applied)
            return controller(y, ahead, applied, w=W[k : k + max(N, 1)] if self.preview else W[k])
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise DataError("the controller wrote into the reference, which is the Run's own; copy it first") from error
        finally:
            if failing is not None:
                failing.solver_fails = False

    def advance(self, k: int, u: Float[np.ndarray, " nu"], rows: LoopRows) -> Float[np.ndarray, " ny"]:
        """Drive the plant with u_k, write x_{k+1} and y_{k+1} into the rows, and return a copy of y_{k+1}."""
        plant = self.plant
        push = None if self.disturbance is None else self.disturbance(k, self.rng)
        if isinstance(plant, StepMap):
            x = rows.X[k + 1]
            plant.advance(rows.X[k], u, x, None if self.driving is None else self.driving[k])
            if push is not None:
                x += push
            y = x.copy() if rows.X is rows.Y else plant.measure(x)
        else:
            pushed = () if push is None else (push,)  # of a SimulatedPlant alone
            y = read_measurement(plant.step(u.copy(), *pushed), rows.Y.shape[1], k + 1)
            if (state := plant.state) is not None:
                rows.X[k + 1] = state
        if rows.X is not rows.Y:
            y = self.sense(k + 1, y)
            rows.Y[k + 1] = y
        return y


def _step_through(wiring: _Wiring, rows: LoopRows, observers: Sequence[StepObserver]) -> str:
    """Run the loop step by step; return why the plant ended it early, or an empty text."""
    nu, reference, faults = wiring.controller.nu, wiring.reference, wiring.faults
    look_ahead: Callable[[], Plan | None] | None = getattr(wiring.controller, "plan", None)
    X, Y, U, held = rows.X, rows.Y, rows.U, rows.u_reference
    simulated = isinstance(wiring.plant, StepMap)
    y, applied = Y[0].copy(), None
    for k in range(wiring.steps):
        move = wiring.ask(k, y, applied)
        u = checked_input(move, nu, k)
        if faults is not None:
            u = np.array(faults.applied(k, u), dtype=np.float64)
        U[k] = u
        y = wiring.advance(k, u, rows)
        ask = rows.keep(move, look_ahead)
        for observer in observers:
            step = Step(k, Y[k], U[k], reference[k], move, X[k], X[k + 1], Y[k + 1], reference[k + 1], held[k], ask)
            observer(step)
            if ask is look_ahead and ask is not None:
                step.look_ahead = _refuse_plan
        applied = u
        if not simulated:
            applied = U[k].copy()  # the controller may keep the other one
            ended = str(getattr(wiring.plant, "ended", ""))
            if ended and k + 1 < wiring.steps:
                rows.steps = k + 1
                return ended
    return ""


def _run_at_once(wiring: _Wiring, rows: LoopRows) -> bool:
    """Let a compiled controller make the whole run; return False where it cannot, or the loop needs Python."""
    make_run = getattr(wiring.controller, "whole_run", None)
    plant, plain = wiring.plant, wiring.noise is None and wiring.faults is None and wiring.disturbance is None
    if make_run is None or not plain or not isinstance(plant, StepMap) or wiring.driving is not None:
        return False
    rows.at_once = make_run(plant, wiring.reference, wiring.measured, rows.X, rows.Y, rows.U, preview=wiring.preview)
    return rows.at_once is not None


def _refuse_plan() -> Plan | None:
    """Raise where the plan of a step is asked for after the controller has gone on to the next one."""
    raise DataError("the controller has gone on: read step.plan while the observer is called, or pass plans=True")


def _check_measured(
    plant: StepMap | Plant, measured: Float[np.ndarray, "rows nw"] | None
) -> Float[np.ndarray, "rows nw"] | None:
    """Return the rows of w that move the plant, after a check that they fit; None where it has no w."""
    if not isinstance(plant, StepMap) or not plant.disturbances:
        return None
    nw, names = len(plant.disturbances), ", ".join(plant.disturbances)
    if measured is None:
        raise DataError(f"the plant has measured disturbances ({names}); pass measured=, a row a step")
    if measured.shape[1] != nw:
        raise ShapeError(f"measured has {measured.shape[1]} columns, the plant {nw} disturbances: {names}")
    return measured
