"""NonlinearMPC: multiple shooting and a nonlinear program a step; the oracle that others are measured against."""

from dataclasses import fields, replace
from typing import Any

from numpy.typing import ArrayLike

from koopmpc.base.interrupts import raise_swallowed
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.kinds import BenchEntry, ControllerKind, register_controller
from koopmpc.control.nonlinear.shooting import NLP, NLPSolver
from koopmpc.control.nonlinear.shooting_solver import ShootingSolver
from koopmpc.control.nonlinear.staged_mpc import StagedMPC
from koopmpc.control.nonlinear.stages import ModelOrMap
from koopmpc.control.nonlinear.task import StagedTask
from koopmpc.control.plan.task import Moves
from koopmpc.control.program import Program, Restored, SavedController, no_export
from koopmpc.control.solvers.levels import LevelSearch
from koopmpc.control.watching import StepMonitor
from koopmpc.data.episodes import Episodes
from koopmpc.estimate.observer import Estimator


class NonlinearMPC(StagedMPC):
    """Minimise the Cost over N steps of x⁺ = F(x, u) within the Limits, by multiple shooting.

    The states x_1 … x_N and the inputs u_0 … u_{N−1} are the variables and F the constraints; where changes of the
    inputs count they are the variables. Every step starts from the last solution moved on by one step, multipliers
    included. Without a Q_N the terminal weight is the Riccati solution of the linearisation at the equilibrium that
    holds the last reference row. It finds a local optimum, as every method of its kind.

    With a hard terminal set that knows its feedback it keeps accepted plans as BilinearMPC does.

    One thread at a time may call it: a second one gets a ThreadError, and needs a copy of its own.

    Parameters
    ----------
    model
        A StepMap; a predictor stands for its re-lifted `step_map()`, and where it has an embedding y is the plant's
        state and the controller keeps the past.
    cost, limits
        As for KoopmanMPC; the observables are taken from their own liftings.
    horizon
        N steps of the model's dt.
    solver
        "ipopt", "fatrop" or "sqpmethod"; or one with its settings and several starts, ``km.control.NLP("fatrop",
        starts=3)``.
    estimator, latency, moves
        As for BilinearMPC.
    time_limit
        Wall-clock time a step may take [s]. Ipopt and sqpmethod stop after the iteration in which it is over, and a
        fallback stands in; fatrop knows no such limit. What is late although it was solved is used. Either way the
        status is TIME_LIMIT.
    monitor
        As for BilinearMPC.

    Raises
    ------
    DataError, ShapeError, DefinitenessError
        A horizon below 1, settings that the solver does not know, an estimator that needs a linear predictor, a
        model for fatrop that may be no number, or weights and limits that do not fit.

    References
    ----------
    Wächter & Biegler, "On the implementation of an interior-point filter line-search algorithm for large-scale
    nonlinear programming", Math. Prog. 106, 2006.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> mpc = km.NonlinearMPC(plant, cost, limits, horizon=20, solver="fatrop")
    >>> mpc([0.5, 0.0], [0.0, 0.0]).status.name
    'OPTIMAL'
    """

    @raise_swallowed()  # CasADi swallows a Ctrl-C while it builds expressions
    def __init__(
        self,
        model: ModelOrMap,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        *,
        solver: NLPSolver | NLP = "ipopt",
        estimator: Estimator | None = None,
        latency: int = 0,
        moves: Moves = None,
        time_limit: float | None = None,
        monitor: StepMonitor | Episodes | None = None,
        **moved: object,
    ) -> None:
        for word in moved:
            known = f"stands with the solver now: pass solver=km.control.NLP({solver!r}, {word}=…)"
            raise TypeError(f"{word}= {known if word in ('starts', 'settings') else 'is not an argument'}")
        self._nlp = solver if isinstance(solver, NLP) else NLP(solver)
        super().__init__(model, cost, limits, horizon, moves, estimator, latency, time_limit, monitor)

    def _make_solver(self, task: StagedTask, levels: LevelSearch | None) -> ShootingSolver:
        fixes = {} if levels is None else {"inputs_check": False}  # it warns of nodes that fix all inputs
        nlp = replace(self._nlp, settings={**fixes, **self._nlp.settings})
        return ShootingSolver(task, nlp, levels)

    def _made_of(self) -> tuple[str, ModelOrMap, dict[str, Any]]:
        return "NonlinearMPC", self.model, {field.name: getattr(self._nlp, field.name) for field in fields(NLP)}

    @classmethod
    def from_data(cls: type[Restored], saved: SavedController) -> Restored:
        """Return the controller that is made of these data."""
        made: Any = super()
        return made.from_data(replace(saved, options={"solver": NLP(**saved.options)}))

    def build_program(self, reference: ArrayLike | None) -> Program:
        """Raise the DataError that says why no C code can be generated."""
        raise no_export(
            self,
            "it uses ipopt or a CasADi solver",
            "a KoopmanMPC, or a BilinearMPC of the same model",
        )


def _build_oracle(parts: Any, limits: Limits) -> NonlinearMPC:
    """Plan with the model itself, from the best of twelve initial guesses: the oracle where the model is the plant."""
    return NonlinearMPC(parts.step_map, parts.problem.cost, limits, parts.problem.horizon, solver=NLP(starts=12))


register_controller(
    ControllerKind(
        NonlinearMPC,
        bench=(
            BenchEntry(
                "nonlinear-mpc",
                "Predictive control on your equations as they are, solved to the end: slow, and the measure for all.",
                "equations",
                _build_oracle,
            ),
        ),
    )
)
