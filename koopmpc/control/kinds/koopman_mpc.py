"""KoopmanMPC: the Riccati solution first, a QP only where a limit is active; LinearMPC is one on a linearisation."""

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.ask.preview import check_bounds_alone
from koopmpc.control.base import PredictiveController
from koopmpc.control.kinds import BenchEntry, ControllerKind, register_controller
from koopmpc.control.move import Move, Plan, alone
from koopmpc.control.plan.condensed import plan_condensed, publish_condensed
from koopmpc.control.plan.condensed_program import CondensedProgram, planned_states
from koopmpc.control.plan.in_time import BoundRows, CallBounds
from koopmpc.control.plan.task import Moves, read_task
from koopmpc.control.step.condensed import CondensedStep
from koopmpc.control.step.observe import InitialCondition
from koopmpc.control.watching import StepMonitor, find_monitor
from koopmpc.data.episodes import Episodes
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.estimate.observer import Estimator, start_observer
from koopmpc.models.predictors import LinearPredictor
from koopmpc.plants.step_map import StepMap


class KoopmanMPC(PredictiveController):
    """Minimise the Cost over N steps of z⁺ = A z + B u + E w + d, z_0 = ψ(x), within the Limits.

    The backward Riccati recursion gives a matrix M: the unconstrained plan is M [z; 1]. The last input, a measured
    disturbance w and an estimated one d join that vector where they are used. If the plan meets every limit, it is the
    optimum (status UNCONSTRAINED). Otherwise the condensed QP is solved for the deviation from that plan (OPTIMAL, or
    SOFTENED if a limit had to give way); it starts from the last solution, shifted by one step. A failed step falls
    back on the last plan, then on the clipped unconstrained input, then on the last input. Inputs always keep their
    limits. Hard limits on their changes are kept, too, unless they contradict the limits of the inputs.

    One thread at a time may call it: a second one gets a ThreadError, and needs a copy of its own.

    Parameters
    ----------
    predictor
        The lifted model.
    cost, limits
        What to minimise, within what.
    horizon
        N steps of the predictor's dt. The attribute of this name is N + latency, the steps of reference that are read.
    moves
        Move blocking. A number M: M inputs, the last one held to the end of the horizon. A sequence: how many steps
        each input is held; they sum to N. By default every step has its own input. Or by name for each input its own,
        ``{"valve": (1, 1, 2, 4), "heater": 2}``; one that is left out has an input in every step.
    estimator
        Estimates z and a disturbance d of every lifted coordinate, so that no offset is left: `LiftedDisturbance`
        where y is the state, `LiftedKalman` where y is some of it. Without one y is the state, and d zero.
    latency
        Steps until an input acts: 1 where it is computed during a step and applied at its end. The plan starts at
        the state that is predicted for that time. Until the first input of a run takes effect, the controller
        assumes that the `u_prev` of `reset` acts: by default zero, or the limit nearest to zero if zero is not
        allowed.
    solver
        The solver: "daqp", an active-set method, exact to rounding; "osqp", an operator-splitting
        method; "piqp", an interior-point method on the stages; or "auto", the one that was measured to be faster, which
        the attribute `solver` names. If OSQP has not solved a QP in 100 iterations, or in the ``max_iter`` of
        `settings`, DAQP solves it; so it does what PIQP has not solved. PIQP comes with an extra, `koopmpc[piqp]`.
        Where it is installed, "auto" asks it first for plans of 300 steps or more, 60 a state, with hard limits alone:
        inputs then agree to 1e-6 of their range.
    settings
        The solver's own settings, for example ``{"eps_abs": 1e-9, "eps_rel": 1e-9}`` of OSQP. With "auto", the solver
        that has them is asked first.
    time_limit
        Wall-clock time that a step may take [s]. A QP that is not solved in this time is given up, and the fallback
        acts. A solution that was found, but late, is used. In both cases the status is TIME_LIMIT.
    monitor
        The data that the model was fitted to, or a `Monitor` of them: then each Move says whether it is `known`.

    Raises
    ------
    ObservableError
        The cost or a limit is on an observable that the lifting lacks.
    DefinitenessError
        A weight, or R + BᵀPB, is not positive definite.
    DataError, ShapeError
        A horizon below 1, crossed limits, sizes that do not fit.

    References
    ----------
    Korda & Mezić, "Linear predictors for nonlinear dynamical systems: Koopman operator meets model predictive
    control", Automatica 93, 2018.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> pd = km.Feedback([[40, 15]], km.Noise(-20, 20), u_min=-25, u_max=25)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), pd, episodes=60, steps=60)
    >>> model = km.edmd(data, km.State() + km.Fourier(1, states="theta"))
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> mpc = km.KoopmanMPC(model, cost, limits, horizon=40)
    >>> move = mpc([0.8, 0.0], [0.0, 0.0])
    >>> move.u.round(3), move.status.name
    (array([-25.]), 'OPTIMAL')
    """

    def __init__(
        self,
        predictor: LinearPredictor,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        estimator: Estimator | None = None,
        latency: int = 0,
        moves: Moves = None,
        solver: str = "auto",
        settings: Mapping[str, Any] | None = None,
        time_limit: float | None = None,
        monitor: StepMonitor | Episodes | None = None,
    ) -> None:
        if settings is not None:
            checks.kind(settings, "settings", Mapping, 'pass the solver\'s own by name, for example {"max_iter": 100}')
        checks.kind(
            predictor,
            "predictor",
            LinearPredictor,
            "fit one with edmd, or use LinearMPC for a StepMap, LinearPredictor.from_state_space for matrices",
        )
        task = read_task(predictor, cost, limits, horizon, moves, latency, solver, dict(settings or {}))
        observer = start_observer(estimator, predictor, task.N)
        watch = None if monitor is None else find_monitor(monitor, predictor).watch(predictor, task.latency)
        super().__init__(predictor.dt, task.track, task.moves, latency, estimator, time_limit, watch)
        self.predictor, self._task = (
            predictor,
            replace(task, estimator=estimator, time_limit=self._time_limit, periodic=hasattr(observer, "forecast")),
        )
        self._step = CondensedStep(plan_condensed(self._task), observer)
        self._calls: CallBounds | None = None
        self.reset()

    @property
    def program(self) -> CondensedProgram:
        """The data of a step."""
        return self._step.program

    @property
    def _initial(self) -> InitialCondition:
        return self._step.initial

    @property
    def solver(self) -> str:
        """Name of the QP solver that is asked first."""
        return self._step.solver.chosen

    @property
    def coordinates(self) -> str:
        """The variables of the QP: "plain", the inputs, or "riccati", in which the Hessian is the identity.

        OSQP works on the inputs where their Hessian is well conditioned, else in Riccati coordinates, as DAQP always
        does.
        """
        return self.program.coordinates

    @property
    def solver_fails(self) -> bool:
        """While it is True, the answer of the solver is dropped and the step is FAILED; see `Fallible`."""
        return self._step.solver.fails

    @solver_fails.setter
    def solver_fails(self, fails: bool) -> None:
        self._step.solver.fails = fails

    @alone
    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps, so that a run repeats to the bit; a filter starts at x0 (nx,), by default at zero.

        Rates count from `u_prev`, zero moved inside the limits by default; it is held if the first step fails.

        Raises
        ------
        DataError
            x0 or u_prev is of another length, or holds what is no finite number; pass None where it is not known.
        """
        self._step.reset(x0, u_prev)
        if self._watch is not None:
            self._watch.reset()

    @alone
    def update(self, predictor: LinearPredictor) -> None:
        """Go on with new A, B, C and E: the plan, the warm start and the last input are kept.

        Raises
        ------
        DataError
            The predictor has another lifting, dt, other states, inputs or disturbances than the last one.
        """
        task = replace(
            self._task.with_predictor(predictor), coordinates="plain" if self.coordinates == "plain" else "riccati"
        )
        program = plan_condensed(task)  # what may be refused is refused before anything changes
        self.predictor, self._task, self._calls = predictor, task, None
        self._step.update(program, predictor)
        if self._watch is not None:
            self._watch.update(predictor)

    @alone
    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
        limits: Limits | None = None,
    ) -> Move:
        """Return the first input of the plan for measurement y.

        Parameters
        ----------
        y
            (nx,) measured state, or the (ny,) measurements of the estimator; there NaN is a missed one.
        reference
            (nr,) held over the horizon, or rows r_k … r_{k+N+latency}; missing rows repeat the last one.
        applied
            (nu,) what the plant really got last; by default the last u returned.
        w
            (nw,) measured disturbances, held over the horizon, or rows w_k … w_{k+N+latency−1}; missing rows repeat
            the last one. By default zero.
        limits
            Limits of this step in place of the controller's own, best made by their `with_bounds`: bounds that hold,
            or rows of which row 0 is that of this step. Only bounds move: a limit must be finite in the controller's
            own limits, or declared in their `rows`, whose sizes and slack weights hold.

        Raises
        ------
        DataError
            Limits that cross in some step, or that the controller has no row for.
        ShapeError
            A size that does not fit; limits with fewer rows than the plan reads.
        """
        start = perf_counter()
        called = None if limits is None else self._read_calls().read(limits)
        move = self._step(y, reference, applied, w, called, start=start)
        return move if self._watch is None else self._judge_step(self._watch, move, applied, start)

    def _read_calls(self) -> CallBounds:
        """Return what reads the limits of calls."""
        if self._calls is None:
            self._calls = CallBounds(BoundRows(self._task, self.program.targets, self.program))
        return self._calls

    def read_limits(self, limits: Limits) -> Limits:
        """Return the limits of a call with arrays in place of names.

        Raises
        ------
        DataError
            They differ from the controller's own in more than bounds.
        """
        return check_bounds_alone(limits, self.limits, self.predictor.states, self.predictor.inputs)

    def check_limits(self, limits: Limits) -> None:
        """Raise where limits of a call cross, have no row in the plan, or too few rows."""
        self._read_calls().read(limits)

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        memory, program = self._step.memory, self.program
        plan = memory.plan
        if not memory.is_planned or plan is None:
            return None
        initial, moves = self._initial, plan[: len(program.deviation)]
        states = planned_states(
            self.predictor,
            program.move_of,
            with_rates=program.with_rates,
            disturbed=program.rule is not None,
            periodic=self._task.periodic,
        )
        X = states.dot(np.concatenate((moves, initial.known, [1.0])))
        return Plan(X.reshape(program.N + 1, -1), moves.reshape(-1, self.nu)[program.move_of])

    def build_program(self, reference: ArrayLike | None) -> CondensedProgram:
        """Return the data of a step from which C code is generated; see `Published`."""
        return publish_condensed(self, self._task, self.program, reference)

    def _made_of(self) -> tuple[str, LinearPredictor, dict[str, Any]]:
        # one that is made again of its data asks the same solvers
        solver = "auto" if self._step.solver.qps.first.name != self.solver else self.solver
        return "KoopmanMPC", self.predictor, {"solver": solver, "settings": self._task.settings}


class LinearMPC(KoopmanMPC):
    """Minimise the Cost over N steps of x⁺ ≈ F(x̄, ū) + A (x − x̄) + B (u − ū) within the Limits.

    A and B are the Jacobians of `step_map` at (x̄, ū). It is a KoopmanMPC on `LinearPredictor.local(step_map, x, u)`,
    whose observables are the state and a constant, and it steps, copies and fails like one.

    One thread at a time may call it: a second one gets a ThreadError, and needs a copy of its own.

    Parameters
    ----------
    step_map
        The plant, x⁺ = F(x, u).
    x, u
        (nx,) and (nu,), the point of the linearisation; it need not be an equilibrium.
    w
        (nw,) the measured disturbances there, zero by default.
    cost, limits
        What to minimise, within what, in the plant's own coordinates.
    horizon
        N steps of the plant's dt.
    **options
        The other keywords of `KoopmanMPC`, with the same meaning: `estimator`, `latency`, `moves`, `solver`,
        `settings`, `time_limit`.

    Raises
    ------
    ObservableError
        The cost or a limit is on an observable other than the states and the constant.
    DefinitenessError
        A weight, or R + BᵀPB, is not positive definite.
    DataError, ShapeError
        `step_map` is no StepMap; a horizon below 1, crossed limits, sizes that do not fit.

    References
    ----------
    Rawlings, Mayne & Diehl, "Model Predictive Control: Theory, Computation, and Design", 2nd ed., 2017, chapter 1.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> mpc = km.LinearMPC(plant, [0, 0], [0], cost, limits, horizon=40)
    >>> mpc([0.1, 0.0], [0.0, 0.0]).status.name
    'UNCONSTRAINED'
    """

    def __init__(
        self,
        step_map: StepMap,
        x: ArrayLike,
        u: ArrayLike,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        w: ArrayLike | None = None,
        **options: Any,
    ) -> None:
        checks.kind(step_map, "step_map", StepMap, "discretize the dynamics, or use KoopmanMPC for a predictor")
        super().__init__(LinearPredictor.local(step_map, x, u, w), cost, limits, horizon, **options)


def _build_linear_mpc(parts: Any, limits: Limits) -> LinearMPC:
    problem = parts.problem
    x, u, *w = problem.equilibrium
    return LinearMPC(parts.step_map, x, u, problem.cost, limits, problem.horizon, w=w[0] if w else None)


def _build_mpc(parts: Any, limits: Limits, estimator: Estimator | None = None) -> KoopmanMPC:
    problem, monitor = parts.problem, parts.monitor_data
    return KoopmanMPC(parts.model, problem.cost, limits, problem.horizon, estimator=estimator, monitor=monitor)


register_controller(
    ControllerKind(
        KoopmanMPC,
        bench=(
            BenchEntry(
                "linear-mpc",
                "Predictive control on your equations, linearised at the equilibrium.",
                "equations",
                _build_linear_mpc,
            ),
            BenchEntry(
                "koopman-mpc",
                "Predictive control on the linear lifted model that was learned from data.",
                "linear",
                _build_mpc,
            ),
            BenchEntry(
                "offset-free",
                "koopman-mpc with an estimate of what the model misses, so that no error remains at rest.",
                "linear",
                lambda parts, limits: _build_mpc(parts, limits, LiftedDisturbance()),
            ),
        ),
        designed_for=LinearPredictor,
    )
)
