"""KoopmanMPC: the Riccati solution first, a QP only where a limit is active; LinearMPC is one on a linearisation."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any, ClassVar, cast

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.linalg.blas import idamax

from koopmpc import checks
from koopmpc.checks import HUGE, numbers
from koopmpc.control.base import MPCBase
from koopmpc.control.cost import Cost, LiftedTracking, add_held, lifted_tracking
from koopmpc.control.horizon import Coordinates, WeightRows
from koopmpc.control.in_time.preview import check_bounds_alone
from koopmpc.control.kinds import BenchEntry, ControllerKind, register_controller
from koopmpc.control.limits import Interval, Limits, clip_input
from koopmpc.control.linear.call_windows import CallWindows, has_fields_of
from koopmpc.control.linear.condensed_program import CondensedProgram
from koopmpc.control.linear.first_input import FirstInput
from koopmpc.control.linear.moving import MovingMap
from koopmpc.control.linear.plan import PlanKind, PlanMap, plan_map, planned_states
from koopmpc.control.linear.weights import WeighedPlan, WeighedPlans
from koopmpc.control.linear.windows import LimitWindows, describe_bounds, limit_windows
from koopmpc.control.move import Fallback, Move, Plan, Status, alone, busy
from koopmpc.control.program import linear_parts, no_export, publish_estimator, reference_table
from koopmpc.control.solvers import FINISHER, add_sparse, exact_turn, order, order_solvers
from koopmpc.control.solvers.ball import BallSolver
from koopmpc.control.solvers.base import StepSolver
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.stepped.blocks import Moves
from koopmpc.control.stepped.priorities import PrioritySolver, spread_priorities, weigh_priorities
from koopmpc.control.stepped.search import LevelSearch, LevelSolver
from koopmpc.control.watching import StepMonitor, find_monitor
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.estimate.observer import Estimator, start_observer
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import LinearPredictor

_at_least = np.greater_equal  # looked up once, as the three below
_at_most = np.less_equal
_FREE = Status.UNCONSTRAINED
_NONE = Fallback.NONE
_FAR = 1e12  # length² of multipliers above which rounding shows in an input, 1 moving it to its limit
_OTHER_SOLVER = (
    "The controller solves with OSQP; this C solves with DAQP, to rounding: inputs differ by OSQP's tolerance."
)
_BY_WEIGHTS = (
    "The controller solves a QP for each priority of its limits; this C solves one, in which a limit weighs 1,000 "
    "times as much as one of the priority below."
)


class KoopmanMPC(MPCBase):
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

    _wanted: ClassVar[Coordinates | None] = None  # QP coordinates, set by a subclass in tests; None: the solver's
    _rows_of_limits: LimitWindows | None = None  # of the controller's own limits in time
    _window: LimitWindows | None = None  # by which the limits of the last step were set
    _called_with: Limits | None = None  # the limits in time of the last call that had some
    _weighs_priorities: ClassVar[bool] = False  # where one QP has to do
    _quick: CallWindows | None = None  # makes windows of further calls
    _step = 0  # calls since reset, as far as limits or weights move in time
    _weighed: WeighedPlans | None = None  # the plans of weights in time
    _row = 0  # row of the windows that belongs to the last step
    _pushed = False  # whether limits in time moved a target that the plan's last column is aimed at
    _free_steps: Sequence[bool] = ()  # steps in which they would move none
    _values: Float[np.ndarray, "N1 nl"] | None = None  # limited values of the targets of the last column

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
        settings = dict(settings or {})
        turns = order_solvers(solver, settings)
        self._solver = turns[0].solver.name
        track, disturbed = lifted_tracking(predictor, cost, limits, in_time=True), estimator is not None
        if track.limits.priority is not None:
            track = self._weigh_priorities(track, predictor)
        super().__init__(
            predictor.dt,
            predictor,
            track,
            moves,
            horizon,
            predictor.inputs,
            start_observer(estimator, predictor, checks.count(horizon, "horizon")),
            estimator,
            latency,
            time_limit,
            stagewise=False,
            monitor=None if monitor is None else find_monitor(monitor, predictor),
        )
        self.predictor, self._disturbed = predictor, disturbed
        coordinates = self._wanted or turns[0].solver.coordinates
        long = self._solver == order.SPARSE or self._N >= order.LONG
        self._plan_kind = PlanKind(disturbed, self._initial.periodic.size > 0, staged=long and not track.weighed)
        self._map = plan_map(predictor, track, self._moves, coordinates, self._initial.buffer, self._plan_kind)
        self._rows_of_limits, self._weighed = self._read_own(predictor, self._map)
        self._window = self._rows_of_limits
        self._options = {"solver": self._solver, "settings": settings}
        self._levels: LevelSearch | None = None
        ball = self._map.ball
        if self._held is not None:
            if ball is not None:
                raise DataError("the limits have levels and a terminal ellipsoid; pass a polytope, or no terminal set")
            self._levels = LevelSearch(self._held, self._blocks, self.nu)
            self._qps = LevelSolver(self._map.qp, exact_turn(turns), self._levels)
        elif self.limits.priority is not None and not self._weighs_priorities:
            if ball is not None:
                raise DataError(
                    "the limits have a priority and a terminal ellipsoid; pass a polytope, or no terminal set"
                )
            self._qps = PrioritySolver(self._map.qp, [exact_turn(turns), *turns[1:]], self._priorities())
        else:
            if ball is None and solver == "auto" and not settings:
                turns = add_sparse(turns, self._map.qp)
                if turns[0].solver.name != self._solver:
                    self._options["solver"] = solver  # one that is made again of its data has the same turns
            self._qps = StepSolver(self._map.qp, turns) if ball is None else BallSolver(self._map.qp, turns, ball)
        rows = len(self._map.matrix)
        self._plan, self._spare = np.zeros(rows), np.zeros(rows)
        self._reference_key: bytes | None = None
        self._given_row = 0  # the row of a given u_target that belongs to this step
        self._read: MovingMap | None = self._map.moving  # the map that holds the reference of the last call
        self._peak, self._near = 0.0, False  # largest |r| of that reference; whether no limit moves its targets
        self._aimed = False  # whether the plan's last column is that of the reference
        self._bound = self._make_bound() if self._map.is_long else None
        self._owes = False  # whether the last plan is known by its first input alone
        self._going = False  # whether a step was made since reset: the first one repeats to the bit in every run
        self._rows = np.zeros((self._N + 1, len(track.tracked)))
        self._states: Float[np.ndarray, "N1nx nvk"] | None = None  # the states of a plan, once somebody asks for one

    def _weigh_priorities(self, track: LiftedTracking, predictor: LinearPredictor) -> LiftedTracking:
        """Return what is tracked and limited; beside levels, and in C, weights stand for priorities."""
        known = track.limits
        if known.levels is None and not self._weighs_priorities:
            return track
        who = "its C code" if self._weighs_priorities else f"{checks.article(self)} with levels"
        return replace(track, softness=weigh_priorities(track.softness, known, predictor.states, who))

    def _priorities(self) -> Int[np.ndarray, " nv"]:
        """Return the priority of each entry of a plan."""
        plan = self._map
        first = plan.moves * (1 if plan.track.rates is None else 2)
        return spread_priorities(self.limits, self.predictor.states, (first, self._N, plan.planned))

    def _made_of(self) -> tuple[str, LinearPredictor, dict[str, Any]]:
        return "KoopmanMPC", self.predictor, self._options

    def build_program(self, reference: ArrayLike | None) -> CondensedProgram:
        """Return the data of a step."""
        levels = self._qps.describe() if isinstance(self._qps, LevelSolver) else None
        if self._held is not None and levels is None:
            raise no_export(
                self,
                "only some of its inputs or steps are on levels, and this search has no C code",
                "one whose inputs are all on levels in all steps",
            )
        if self._weighed is not None:
            raise no_export(
                self, "its weights move in time, and its C holds one plan", "one without Cost(Q_rows=…, R_rows=…)"
            )
        plan, track = self._map, self._map.track
        if plan.ball is not None:
            raise no_export(
                self,
                "Clarabel solves its QP with a terminal ellipsoid",
                "one with a polytope, or without a terminal set",
            )
        rows = reference_table(reference, len(track.Q))
        estimator = publish_estimator(
            self._initial.observer,
            self._estimator,
            self._time_limit,
            'solver="daqp", settings={"iter_limit": 100}',
        )
        if self._qps.first.name != FINISHER.name:
            saved = self.as_data()
            twin = KoopmanMPC.from_data(replace(saved, options={"solver": FINISHER.name}))
            notes = (_OTHER_SOLVER,) if self._solver == "osqp" else ()
            return replace(twin.build_program(rows), controller=type(self).__name__, notes=notes)
        if isinstance(self._qps, PrioritySolver):
            twin = _PriorityWeights.from_data(self.as_data())
            return replace(twin.build_program(rows), controller=type(self).__name__, notes=(_BY_WEIGHTS,))
        setup = cast("DAQP", self._qps.first).setup
        return CondensedProgram(
            controller=type(self).__name__,
            **linear_parts(self.predictor, plan.targets),
            inputs=track.inputs,
            rates=track.rates,
            given=add_held(track.given, track.shift),
            reference=rows,
            gain=plan.matrix[: plan.moves, : self.predictor.nz],
            settings=setup.settings,
            N=self._N,
            latency=self._latency,
            move_of=self._move_of,
            with_rates=self._with_rates,
            hard_rates=track.hard_rates,
            M=plan.matrix[:, :-1],
            low=plan.low,
            high=plan.high,
            offset=plan.maps.offset,
            from_reference=plan.maps.from_reference,
            from_target=plan.maps.from_target,
            from_given=plan.maps.from_given,
            aimed=bool(plan.aimed and plan.targets.Z.shape[1]),
            unpushed=plan.single.reach,
            checked=plan.checked,
            disturbance=plan.disturbance,
            qp=plan.qp,
            deviation=plan.deviation,
            solver=setup,
            estimator=estimator,
            bounds=describe_bounds(plan) if self.limits.in_time or self.limits.rows else None,
            levels=levels,
        )

    @property
    def solver(self) -> str:
        """Name of the QP solver that is asked first."""
        return self._solver

    @property
    def coordinates(self) -> str:
        """The variables of the QP: "plain", the inputs, or "riccati", in which the Hessian is the identity.

        OSQP works on the inputs where their Hessian is well conditioned, else in Riccati coordinates, as DAQP always
        does.
        """
        return self._map.maps.coordinates

    @alone
    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps; see `MPCBase`."""
        self._step, self._row, self._window = 0, 0, self._rows_of_limits
        if self._called_with is not None:
            self._map.restore_limits()
            self._called_with = self._reference_key = None
        super().reset(x0, u_prev)
        self._qps.reset()
        self._going, self._given_row, self._owes = False, 0, False
        if self._bound is not None:
            self._bound.forget()

    @alone
    def update(self, predictor: LinearPredictor) -> None:
        """Go on with new A, B, C and E: the plan, the warm start and the last input are kept.

        Raises
        ------
        DataError
            The predictor has another lifting, dt, other states, inputs or disturbances than the last one.
        """
        checks.kind(predictor, "predictor", LinearPredictor, "it replaces another LinearPredictor")
        for name in ("lifting", "dt", "states", "inputs", "disturbances"):
            if getattr(predictor, name) != getattr(self.predictor, name):
                raise DataError(f"the predictor has another {name} than the controller's; make a new controller")
        track = lifted_tracking(predictor, self.cost, self.limits, in_time=True)
        if track.limits.priority is not None:
            track = self._weigh_priorities(track, predictor)
        coordinates = "plain" if self.coordinates == "plain" else "riccati"
        plan = plan_map(predictor, track, self._moves, coordinates, self._initial.buffer, self._plan_kind)
        windows, weighed = self._read_own(predictor, plan)  # what may be refused is refused before anything changes
        self.predictor, self._states, self._called_with, self._quick = predictor, None, None, None
        self._settle()
        self._take_plan(plan)
        self._window, self._rows_of_limits, self._weighed = windows, windows, weighed
        self._bound = self._make_bound() if self._map.is_long else None
        self._initial.update(predictor)
        if self._watch is not None:
            self._watch.update(predictor)

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
        try:
            held = self._token.pop()
        except IndexError:
            raise busy(self) from None
        except BaseException:  # a Ctrl-C that came right behind the pop
            self._token.append(0)
            raise
        try:
            start = perf_counter()
            if self._weighed is not None:
                self._follow_weights(self._weighed)
            target = numbers(reference, "reference")
            key, moving = target.tobytes(), None
            if key != self._reference_key:
                self._reference_key = None  # one that is refused leaves no rows of the last one
                moving = self._take_reference(target, key)
                self._reference_key, self._aimed = key, False
            if self._window is not None or limits is not None:
                self._move_limits(limits, moving)
            if moving is None and not self._aimed:
                self._aim()
            self._going = True
            origin = self._initial
            origin.take(y, self._given, applied, w)
            if self._held is not None:
                self._count_held(applied)
            if self._window is not None or self._weighed is not None:
                self._step += 1
            plan, t = self._map, self._spare
            if moving is None or (self._near and (self._bound is None or moving is plan.single)):
                if moving is None:
                    plan.matrix.dot(origin.known, t)
                else:
                    moving.rows_of_plan.dot(moving.known, t)
                if plan.given is not None:
                    self._add_given(t)
                _at_least(t, plan.low, plan.met_low)
                _at_most(t, plan.high, plan.met_high)
                # no 0 byte: every limit is met, and nothing is NaN (NaN meets no limit)
                ask = self._solve_limited if 0 in plan.met else self._return_free_plan
                move = ask(t, applied, start)
            elif self._near:
                move = self._find_first(plan, moving, applied, start)
            else:
                whole = moving.multiply()
                if plan.given is not None:
                    self._add_given(whole)
                _at_least(whole, moving.low, moving.met_low)
                _at_most(whole, moving.high, moving.met_high)
                (t if plan.planned == len(t) else t[: plan.planned])[:] = moving.planned
                ask = self._solve_moving if 0 in moving.met else self._return_free_plan
                move = ask(t, applied, start)
            if origin.refused:
                move.refused = True
            watch = self._watch
            if watch is not None:  # not by a method, for a step takes a few microseconds
                move.known = watch.look(origin, move.u, applied)
                move.solve_time = perf_counter() - start
            return move
        finally:
            self._token.append(held)

    def _make_bound(self) -> FirstInput | None:
        """Return what finds the first input of long previews alone, where that is possible."""
        if self._weighed is not None or self._levels is not None:
            return None
        return FirstInput(self._map, self.nu, in_time=self._rows_of_limits is not None)

    def _find_first(self, plan: PlanMap, moving: MovingMap, applied: ArrayLike | None, start: float) -> Move:
        """Return the move of a long preview near which no limit moves a target: by its first input, if that will do."""
        bound, window, t = self._bound, self._window, self._spare
        if bound is not None and window is self._rows_of_limits:
            u = bound.find(self._peak, window, self._row, self._given_row + self._latency)
            if u is not None:
                return self._return_first(u, start)
        if window is not None:
            window.plan_pages.turn(plan, self._row)
        moving.rows_of_plan.dot(moving.known, t)
        if plan.given is not None:
            self._add_given(t)
        _at_least(t, plan.low, plan.met_low)
        _at_most(t, plan.high, plan.met_high)
        return (self._solve_limited if 0 in plan.met else self._return_free_plan)(t, applied, start)

    def _return_first(self, u: Float[np.ndarray, " nu"], start: float) -> Move:
        """Return the move of a plan of which only the first input is known."""
        self._qps.rest()
        self._kept, self._age, self._planned, self._owes = self._plan, 0, True, True
        self._given, self._given_row = u, self._given_row + 1
        taken = perf_counter() - start
        return Move(u.copy(), _FREE if taken <= self._allowed else Status.TIME_LIMIT, _NONE, taken, 0)

    def _settle(self) -> None:
        """Compute the rest of a plan of which only the first input is known."""
        if self._owes and self._bound is not None:
            self._bound.write_plan(self._plan)
        self._owes = False

    def _take_plan(self, plan: PlanMap) -> None:
        """Go on with another plan of the same sizes; the warm start is kept."""
        self._map, self._read, self._reference_key = plan, plan.moving, None
        if isinstance(self._qps, BallSolver) and plan.ball is not None:
            self._qps.change(plan.qp, plan.ball)
        else:
            self._qps.update(plan.qp)

    def _read_own(self, predictor: LinearPredictor, plan: PlanMap) -> tuple[LimitWindows | None, WeighedPlans | None]:
        """Return the windows of its own limits, and the table of plans of its weights, where these move in time."""
        windows = None
        if self.limits.in_time:
            names = predictor.states, predictor.inputs
            windows = limit_windows(plan, self.limits, *names, self._latency, at_call=False)
        if not plan.track.weighed:
            return windows, None
        weighed = WeighedPlans(plan.track, self._N, WeighedPlan(plan, windows), partial(self._weigh, predictor, plan))
        weighed.check_free_inputs()
        return windows, weighed

    def _weigh(self, model: LinearPredictor, plan: PlanMap, rows: WeightRows) -> WeighedPlan:
        """Return the plan of weights in time."""
        coordinates = "plain" if self.coordinates == "plain" else "riccati"
        buffer = self._initial.buffer
        weighed = plan_map(model, plan.track, self._moves, coordinates, buffer, self._plan_kind, rows, plan)
        if not self.limits.in_time:
            return WeighedPlan(weighed, None)
        windows = limit_windows(weighed, self.limits, model.states, model.inputs, self._latency, at_call=False)
        return WeighedPlan(weighed, windows)

    def _follow_weights(self, weighed: WeighedPlans) -> None:
        """Take the plan of the weights of this step."""
        plan, windows = weighed.find(self._step + self._latency)
        if plan is not self._map:
            self._take_plan(plan)
            plan.restore_limits()
            self._called_with = self._quick = None
            self._window = self._rows_of_limits = windows

    def _make_windows(self, limits: Limits) -> LimitWindows:
        model = self.predictor
        return limit_windows(self._map, limits, model.states, model.inputs, self._latency, at_call=True)

    def _read_windows(self, limits: Limits) -> LimitWindows:
        """Return the windows of the limits of a call: by their numbers alone where they were made by `with_bounds`."""
        quick, found = self._quick, None
        if quick is not None and quick.fits and has_fields_of(limits, self.limits):
            found = quick.make(limits)
        if found is None:
            found = self._make_windows(self.read_limits(limits))
            self._quick = CallWindows(self._map, self._latency)
        return found

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
        self._make_windows(limits)

    def _move_limits(self, limits: Limits | None, moving: MovingMap | None) -> None:
        """Put the limits of this step into the plan, and let targets that they move be found again."""
        window = self._rows_of_limits
        if limits is not None or window is not self._window:
            window = self._change_window(limits)
        if window is None:
            return
        k, plan = self._step, self._map
        if k > window.last:
            k = window.last
        self._row = k
        if moving is not None:
            self._near = self._peak <= window.reaches[k]
        if moving is not None and not self._near:
            (window.single_pages if moving is plan.single else window.moving_pages).turn(moving, k)
            return
        if moving is not None and self._bound is not None and moving is not plan.single:  # see _find_first
            return
        pages = window.plan_pages
        plan.low, plan.high = pages.rows.get(k) or pages.fill(k)  # not by a method, for it costs each free step
        if self._aimed and plan.aims_inside and (self._pushed or not self._free_steps[k]):
            self._aimed = False

    def _change_window(self, limits: Limits | None) -> LimitWindows | None:
        """Return the windows of the limits of a call, or of the controller's own, where the last call had others."""
        if limits is not None and limits is not self._called_with:
            self._at_call, self._called_with = self._read_windows(limits), limits
        window = self._rows_of_limits if limits is None else self._at_call
        if window is not self._window:
            stays = not self._map.aims_inside
            if limits is not None and window is not None and self._window is not None and not (stays or self._pushed):
                stays = self._values is not None and window.leaves_targets(self._values)
                self._free_steps = (True,)
            self._window, self._aimed = window, self._aimed and stays
        if window is None:
            self._map.restore_limits()
        return window

    def _present_limits(self) -> tuple[Interval, Interval | None]:
        window = self._window
        return super()._present_limits() if window is None else window.first_inputs(self._row)

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        if not self._planned:
            return None
        self._settle()
        if self._states is None:
            rates = self._with_rates
            self._states = planned_states(
                self.predictor,
                self._move_of,
                with_rates=rates,
                disturbed=self._disturbed,
                periodic=self._initial.periodic.size > 0,
            )
        moves = self._plan[: len(self._blocks) * self.nu]
        X = self._states.dot(np.concatenate((moves, self._initial.known)))
        return Plan(X.reshape(self._N + 1, -1), moves.reshape(-1, self.nu)[self._move_of])

    @property
    def _reference(self) -> Float[np.ndarray, "N1 nr"]:
        """The rows r_k … r_{k+N} of the last call."""
        rows = self._rows if self._read is None else self._read.rows
        return rows if len(rows) > self._N else np.repeat(rows, self._N + 1, axis=0)

    def _take_reference(self, reference: Float[np.ndarray, "..."], key: bytes) -> MovingMap | None:
        """Keep the rows of the reference that the plan reads; return the map that reads them.

        The first step after `reset` gets None, as does a row that is not finite. `key` holds the bytes of the rows.
        """
        plan, shape = self._map, reference.shape
        if shape == plan.row_shape:
            self._read = read = plan.single
            read.raw[:] = key
        else:
            self._read = read = plan.moving
            if shape == plan.rows_shape and read is not None and not self._latency:
                read.raw[:] = key
            else:
                R = self._rows if read is None else read.rows
                R[:] = checks.reference_rows(reference, self._N, R.shape[1], self._latency)
        if read is None:
            return None
        flat = read.flat
        self._peak = peak = abs(flat.item(idamax(flat)))  # what is NaN gives a plan of NaN, which meets no limit
        self._near = peak <= read.reach
        return read if peak < HUGE and self._going else None

    def _add_given(self, t: Float[np.ndarray, " nt"]) -> None:
        """Add the share of the rows of a given u_target that belong to this step, and go on to the next one."""
        plan, k = self._map, self._given_row
        given, n = plan.given, plan.planned
        assert given is not None, "the caller knows"
        planned = t if n == len(t) else t[:n]
        planned += given.at(k + self._latency)  # `t[:n] +=` would copy the sum onto itself
        self._given_row = k + 1

    def _aim(self) -> None:
        """Write the part of the plan that depends on the reference into the last column of the plan's matrix.

        Where a row of the reference is not finite, the column is NaN: no limit is met then, and the step ends in
        BAD_MEASUREMENT.
        """
        plan, maps, targets, R = self._map, self._map.maps, self._map.targets, self._reference
        column, self._aimed = plan.matrix[:, -1], True
        if not (np.abs(R) < HUGE).all():
            column[:] = np.nan
            self._pushed = True  # no steps are known in which limits in time would leave it as it is
            return
        self._values = None
        v = maps.from_reference.dot(R.reshape(-1))
        v += plan.offset
        if plan.aimed:
            alpha, window = targets.nearest(R), self._window
            if plan.disturbance.shape[1]:
                values = (alpha @ targets.rows.T)[:, plan.checked]
                column[plan.planned :] = np.concatenate([values.min(axis=0), values.max(axis=0)])
            elif window is None:
                v += maps.from_target @ (targets.coordinates(R) - alpha).ravel()
            else:
                k = self._row
                self._values = alpha @ targets.rows.T
                self._free_steps = window.find_free_steps(self._values).tolist()
                self._pushed = not self._free_steps[k]
                if self._pushed:
                    v += maps.from_target @ (targets.coordinates(R, box=window.target_box(k)) - alpha).ravel()
        column[: plan.planned] = v

    def _return_free_plan(self, t: Float[np.ndarray, " nt"], applied: ArrayLike | None, start: float) -> Move:
        if self._levels is not None and not self._levels.accepts(t):
            return self._solve_qp(t, applied, start)
        self._qps.rest()
        self._plan, self._spare = t, self._plan
        self._kept, self._age, self._planned, self._owes = t, 0, True, False
        self._given = u = t[: self.nu]
        taken = perf_counter() - start  # in this step a call of `_keep` and of `_move` would take 5 % of the time
        return Move(u.copy(), _FREE if taken <= self._allowed else Status.TIME_LIMIT, _NONE, taken, 0)

    def _solve_moving(self, t: Float[np.ndarray, " nt"], applied: ArrayLike | None, start: float) -> Move:
        """Handle a step like `_solve_limited`, of a plan t from one product with the reference."""
        plan, moving, n, window = self._map, self._read, self._map.planned, self._window
        if window is not None:
            window.plan_pages.turn(plan, self._row)
        if moving is not None and moving.met_low[n:].all() and moving.met_high[n:].all():
            t[n:] = plan.inside if window is None else np.clip(0.0, plan.low[n:], plan.high[n:])
        else:
            self._aim()
            plan.matrix.dot(self._initial.known, t)
            if plan.given is not None:
                t[:n] += plan.given.at(self._given_row - 1 + self._latency)
            if (t >= plan.low).all() and (t <= plan.high).all():
                return self._return_free_plan(t, applied, start)
        return self._solve_limited(t, applied, start)

    def _solve_limited(self, t: Float[np.ndarray, " nt"], applied: ArrayLike | None, start: float) -> Move:
        """Handle a step in which the plan or its target breaks a limit, or something is not finite."""
        plan, origin, window = self._map, self._initial, self._window
        # entry by entry, as in C; a product shows in a fifth of that time that no entry can be so large
        if not (t.dot(t) < HUGE * HUGE or np.abs(t).max() < HUGE):
            self._qps.cool()
            return self._fail(None, applied, Status.BAD_MEASUREMENT, 0, start)
        n, v = plan.planned, t[: plan.planned]
        if n < len(t) and not ((t[n:] >= plan.low[n:]).all() and (t[n:] <= plan.high[n:]).all()):
            # the disturbance puts a target outside its limits: use the nearest one inside
            e = plan.disturbance @ origin.drive
            box = None if window is None else window.target_box(self._row)
            moved = plan.targets.coordinates(self._reference, e, box) - plan.targets.nearest(self._reference, e)
            v += plan.maps.from_target @ moved.ravel()
            if (v >= plan.low[:n]).all() and (v <= plan.high[:n]).all():
                return self._return_free_plan(t, applied, start)
        if plan.ball is not None and isinstance(self._qps, BallSolver) and self._qps.contains(v):
            n = plan.ball.rows.start
            if (v[:n] >= plan.low[:n]).all() and (v[:n] <= plan.high[:n]).all():
                return self._return_free_plan(t, applied, start)
        return self._solve_qp(t, applied, start)

    def _solve_qp(self, t: Float[np.ndarray, " nt"], applied: ArrayLike | None, start: float) -> Move:
        """Return the move of the QP of the deviation from the plan t."""
        plan, u_prev, v = self._map, self._initial.u_prev, t[: self._map.planned]
        window = self._window
        inputs, room, hard_rates, bounds, conflict = plan.track.inputs, None, self._hard_rates, None, 0.0
        if window is not None:
            (bounds, conflict), k = window.find_bounds(self._row, u_prev), self._row
            inputs, hard_rates = window.first_inputs(k)[0], None if hard_rates is None else window.hard_rates(k)
        if hard_rates is not None:
            room = Interval(inputs.low - u_prev, inputs.high - u_prev)
        deadline = None if np.isinf(self._allowed) else start + self._allowed
        found, gave_way = self._qps.solve(v, room, deadline, bounds)
        gave_way = max(gave_way, conflict)
        status = Status.FAILED if self.solver_fails else found.status
        if status is not Status.OPTIMAL:
            self._qps.cool()
            return self._fail(v[: self.nu], applied, status, found.iterations, start, found.solver)
        U, (low, high) = t[: plan.moves], plan.box if window is None else window.input_box(self._row)
        U += plan.deviation.dot(found.v)
        if gave_way and self._levels is None and found.solver == FINISHER.name and found.y.dot(found.y) > _FAR:
            self._meet_limits(U, found.y, Interval(low, high), bounds)
        np.maximum(U, low, out=U)
        np.minimum(U, high, out=U)
        u = U[: self.nu]
        if hard_rates is not None:
            u[:] = clip_input(u, inputs, hard_rates, u_prev)
        gap = 0.0
        if self._levels is not None:
            gap = self._levels.place(U)
        self._plan, self._spare, self._owes = t, self._plan, False  # swap: the last plan's array becomes the spare
        self._keep(t)
        status = Status.SOFTENED if gave_way else Status.OPTIMAL
        move = self._move(u.copy(), status, found.iterations, start, gave_way, found.solver)
        if gap:
            move.status, move.gap = Status.TIME_LIMIT, gap
        return move

    def _meet_limits(
        self, U: Float[np.ndarray, " moves"], y: Float[np.ndarray, " m"], box: Interval, rows: Interval | None
    ) -> None:
        """Put the moves that hard limits and rates determine where these say; y are the multipliers of the QP's rows.

        Soft rows that are missed by far push by 1e12 and more. Rounding of their sum is 1e-4 of an input's range, where
        its limit is known to the last digit. `box` has the limits of the moves, `rows` those of the QP, None for its
        own.
        """
        plan, nu, last = self._map, self.nu, self._initial.u_prev
        qp, count = plan.qp, plan.moves if plan.track.rates is None else 2 * plan.moves
        low, high = (qp.low, qp.high) if rows is None else rows
        known, changes = set[int](), dict[int, float]()
        for i in np.flatnonzero(y[: np.searchsorted(qp.source, count)]).tolist():
            at = int(qp.source[i])
            if at < plan.moves:
                U[at] = (box.high if y[i] > 0 else box.low)[at]
                known.add(at)
            elif np.isinf(qp.softness.linear[i]):
                changes[at - plan.moves] = float((high if y[i] > 0 else low)[i] / qp.scale[i])
        for j, change in changes.items():
            if j not in known and (j < nu or j - nu in known):
                U[j] = (last[j] if j < nu else U[j - nu]) + change
                known.add(j)
        for j, change in reversed(changes.items()):
            if j in known and j >= nu and j - nu not in known:
                U[j - nu] = U[j] - change
                known.add(j - nu)


class _PriorityWeights(KoopmanMPC):
    """A KoopmanMPC in which weights stand for priorities, as in C."""

    _weighs_priorities = True


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
