"""BilinearMPC: real-time iteration on a bilinear predictor, or on any map, in the dimension of the state."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.kinds import BenchEntry, ControllerKind, register_controller
from koopmpc.control.nonlinear.iteration import RealTimeIteration
from koopmpc.control.nonlinear.real_time_solver import RealTimeSolver
from koopmpc.control.nonlinear.staged_mpc import StagedMPC
from koopmpc.control.nonlinear.staged_program import StagedProgram, find_targets, first_gain, trace_functions
from koopmpc.control.nonlinear.stages import ModelOrMap
from koopmpc.control.nonlinear.stagewise import list_sides, weights
from koopmpc.control.nonlinear.task import StagedTask, describe_stage_bounds
from koopmpc.control.plan.task import Moves
from koopmpc.control.program import no_export, reference_table, refuse_time_limit, trace_lifting
from koopmpc.control.solvers.daqp import daqp_settings
from koopmpc.control.solvers.levels import LevelSearch
from koopmpc.control.step.aim import BEYOND
from koopmpc.control.watching import StepMonitor
from koopmpc.data.episodes import Episodes
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.estimate.observer import Estimator, estimator_program
from koopmpc.models.predictors import BilinearPredictor


class BilinearMPC(StagedMPC):
    """Minimise the Cost over N steps of x⁺ = F(x, u) within the Limits, by one linearisation a step.

    This is real-time iteration, and it works on any map F. Of a predictor F is the re-lifted map
    x⁺ = C(A ψ(x) + B u + Σ uᵢ Nᵢ ψ(x)), so the problem has the dimension of x whatever the dictionary. Under an
    embedding x is the point ζ of the plant's state and its past, which the controller keeps: y, the cost, the limits
    and the disturbance are those of the plant's state.

    The controller keeps the planned states X_k as well as the inputs U_k and moves both on by one step. Each iteration
    linearises at (X_k, U_k), with defects c_k = F(X_k, U_k) − X_{k+1} and δx_0 = x − X_0. The solution of that
    quadratic program (Gauss–Newton in the tracked outputs) is added to the plan, halved until F is near its
    linearisation along the step. The planned inputs are never simulated over the horizon: on an unstable plant that
    multiplies the model's error a thousandfold. The first step, and one after a failure, compares the plans to which
    several starts lead, for a swing has several local optima: rest at x, the line from x to the equilibrium, and, of
    given equations, the free motion.

    A Riccati recursion solves the program; where that plan breaks a limit, an interior-point method does whose steps
    are Riccati recursions, and where that ends early DAQP, on the condensed program. Where changes of the inputs
    count, or moves are blocked, the changes are the inputs of the program, and the last input is part of its state.

    If a hard terminal set knows its feedback, as a Certificate does, the accepted plan is moved on by a step and
    prolonged by this feedback. A new plan replaces it that keeps the limits on the model and costs no more.

    One thread at a time may call it: a second one gets a ThreadError, and needs a copy of its own.

    Parameters
    ----------
    model
        A bilinear or linear predictor, or a StepMap, learned or not.
    cost, limits
        As for KoopmanMPC; the observables are taken from their own liftings.
    horizon
        N steps of the model's dt.
    sqp_iterations
        Linearisations a step. The first step may take up to twelve from each of its starts, and ten more.
    estimator
        A `LiftedDisturbance`: x⁺ = F(x, u) + d with d filtered from what F misses, so that no offset is left.
    latency, moves
        As for KoopmanMPC.
    time_limit
        Wall-clock time a step may take [s]. An iteration that has not ended by then is given up for the fallback, and
        its plan is improved in the next step; what is late although it was found is used. Either way the status is
        TIME_LIMIT.
    monitor
        As for KoopmanMPC, where the model is learned.

    Raises
    ------
    DataError, ShapeError, DefinitenessError
        A horizon or sqp_iterations below 1, an estimator that needs a linear predictor, or weights and limits that do
        not fit.

    References
    ----------
    Diehl, Bock & Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control",
    SIAM J. Control Optim. 43, 2005.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=60, steps=30)
    >>> model = km.bilinear_edmd(data, km.State() + km.Fourier(2, states="theta"), difference=True)
    >>> upright = km.Fourier(1, states="theta") + km.State("omega")
    >>> cost, limits = km.Cost(Q=[10, 10, 1], R=0.1, of=upright), km.Limits(u_min=-10, u_max=10)
    >>> mpc = km.BilinearMPC(model, cost, limits, horizon=40)
    >>> mpc([0.5, 0.0], [0, 1, 0]).status.name
    'OPTIMAL'
    """

    _compiles_model = True  # a subclass that is used briefly leaves it to the interpreter

    @raise_swallowed()  # CasADi swallows a Ctrl-C while it builds expressions
    def __init__(
        self,
        model: ModelOrMap,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        sqp_iterations: int = 1,
        estimator: Estimator | None = None,
        latency: int = 0,
        moves: Moves = None,
        time_limit: float | None = None,
        monitor: StepMonitor | Episodes | None = None,
    ) -> None:
        if isinstance(moves, Mapping):
            raise DataError(
                f"moves is {dict(moves)}; a BilinearMPC holds all inputs in the same blocks: pass a number or lengths"
            )
        self._sqp_iterations = checks.count(sqp_iterations, "sqp_iterations")
        super().__init__(model, cost, limits, horizon, moves, estimator, latency, time_limit, monitor)

    def _make_solver(self, task: StagedTask, levels: LevelSearch | None) -> RealTimeSolver:
        self._iteration = RealTimeIteration(task.problem, compiles_model=self._compiles_model)
        return RealTimeSolver(self._iteration, task, self._sqp_iterations, levels)

    def _made_of(self) -> tuple[str, ModelOrMap, dict[str, Any]]:
        return "BilinearMPC", self.model, {"sqp_iterations": self._sqp_iterations}

    @property
    def stage_is_convex(self) -> bool:
        """Whether the ``stage`` of the cost was convex along the last plan; else a convex part of it was planned with.

        True where the cost has no stage of its own.
        """
        return self._iteration.stage_is_convex

    def find_targets(self, reference: Float[np.ndarray, "rows nr"]) -> Float[np.ndarray, "found size"]:
        """Return the `table` of the StagedProgram for these reference rows, each row once.

        Where measured disturbances multiply the state, it is that of w = 0.
        """
        return find_targets(self._step.aim.targets, self._task.map.nx, reference)

    def _refuse_export(self) -> None:
        """Raise a DataError where the controller has what its C does not know."""
        problem, outputs = self._task.problem, self._task.outputs
        priced = outputs.shift is not None or outputs.pull is not None
        levels = "its inputs are on levels, and the search over them has no C code"
        for obstacle, why, instead in (
            (priced, "its cost has a price, which its C does not know", "one without a price"),
            (problem.timed, "its weights move in time, and its C keeps one set", "one without Q_rows and R_rows"),
            (
                problem.stage is not None,
                "its cost has a stage of its own, which its C does not know",
                "one without a stage",
            ),
            (self._step.levels is not None, levels, "one without levels"),
            (problem.ends > 0, "its C has no terminal set", "a LinearMPC or a KoopmanMPC with a terminal polytope"),
        ):
            if obstacle:
                raise no_export(self, why, instead)

    def build_program(self, reference: ArrayLike | None) -> StagedProgram:
        """Return the data of a step."""
        task = self._task
        problem, outputs, model = task.problem, task.outputs, task.map
        self._refuse_export()
        refuse_time_limit(self._time_limit, "sqp_iterations=1")
        estimator = estimator_program(self._initial.observer, self._estimator)
        rows, terminal, cost = reference_table(reference, len(outputs.Q)), self._step.aim.targets, self.cost
        R, held = weights(problem), int((~problem.free).argmax()) * (not problem.free.all())
        return StagedProgram(
            controller=type(self).__name__,
            model=model.model,
            lifting=trace_lifting(lambda zeta: zeta, model.nx, model.embedding, model.nu),
            inputs=outputs.inputs,
            rates=outputs.rates,
            given=outputs.given,
            reference=rows,
            sizes=terminal.equilibria.size[: model.nx],
            gain=first_gain(terminal, outputs, task.N, rows[0]) if len(rows) else np.zeros((self.nu, model.nx)),
            settings=daqp_settings(),
            functions=trace_functions(problem, outputs, model),
            N=task.N,
            affine=problem.affine,
            latency=task.latency,
            iterations=self._sqp_iterations,
            nx=model.nx,
            ny=model.ny,
            ns=problem.nx,
            E=model.E,
            scheduled=problem.scheduled > 0,
            with_rates=problem.with_rates,
            weighs_changes=outputs.R_delta is not None,
            soft_rates=problem.soft_rates,
            free=problem.free,
            held_from=problem.held_from[:, 0],
            hard_rates=outputs.hard_rates,
            Q=problem.Q,
            R=problem.R,
            R_held=R[:, self.nu * held :][:, : self.nu],
            Q_root=outputs.Q_root,
            R_root=outputs.R_root,
            v_limits=problem.inputs,
            box=problem.box,
            stage_limits=problem.stage_limits,
            softness=problem.softness,
            sides=list_sides(problem),
            stage_sizes=problem.sizes,
            input_sizes=problem.input_sizes,
            holds=terminal.holds,
            end="given" if cost.Q_N is not None else "stage" if cost.tail == 0 else "tail",
            beyond=BEYOND * task.N * (cost.moves_on and outputs.given is None),
            table=self.find_targets(rows) if len(rows) else np.zeros((0, 1)),
            disturbed=task.disturbed,
            rest=terminal.equilibria.program(),
            tail=terminal.program(),
            estimator=estimator,
            bounds=describe_stage_bounds(outputs, problem) if self.limits.in_time or self.limits.rows else None,
        )


class BriefMPC(BilinearMPC):
    """A BilinearMPC whose model runs in the interpreter: for some hundred steps compiling takes longer than it saves.

    All that does not depend on the model is still machine code, which later controllers find in the cache. The numbers
    are the same.
    """

    _compiles_model = False


def _build_mpc(parts: Any, limits: Limits, estimator: Estimator | None = None) -> BilinearMPC:
    problem, monitor = parts.problem, parts.monitor_data
    return BilinearMPC(parts.bilinear, problem.cost, limits, problem.horizon, estimator=estimator, monitor=monitor)


register_controller(
    ControllerKind(
        BilinearMPC,
        bench=(
            BenchEntry(
                "bilinear-mpc",
                "Predictive control on the bilinear lifted model that was learned from data. It linearises the model "
                "along its plan once a step.",
                "bilinear",
                _build_mpc,
            ),
            BenchEntry(
                "bilinear-offset",
                "bilinear-mpc with an estimate of what the model misses, so that no error remains at rest.",
                "bilinear",
                lambda parts, limits: _build_mpc(parts, limits, LiftedDisturbance()),
            ),
        ),
        designed_for=BilinearPredictor,
        brief=BriefMPC,
    )
)
