"""NonlinearMPC: multiple shooting and a nonlinear program a step; the oracle that others are measured against."""

import pickle
from collections.abc import Mapping
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.checks import HUGE
from koopmpc.control.cost import Cost
from koopmpc.control.kinds import BenchEntry, ControllerKind, register_controller
from koopmpc.control.limits import Interval, Limits
from koopmpc.control.move import Status
from koopmpc.control.nonlinear.level_rollouts import LevelRollouts, StageData
from koopmpc.control.nonlinear.problem import ModelOrMap
from koopmpc.control.nonlinear.rows import StageLimits
from koopmpc.control.nonlinear.shooting import OPTIONS, NLPSolution, NLPSolver, Shooting, Start
from koopmpc.control.nonlinear.staged_mpc import StagedMPC, StagePlan
from koopmpc.control.program import Program, no_export
from koopmpc.control.stepped.blocks import Moves
from koopmpc.control.stepped.levels import LevelBox
from koopmpc.control.stepped.search import Relaxed
from koopmpc.control.watching import StepMonitor
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.estimate.observer import Estimator
from koopmpc.interrupts import raise_swallowed

Guess = tuple[Float[np.ndarray, "N1 nx"], Float[np.ndarray, "N nu"]]  # states and inputs
_HOLD = 5  # steps for which a random guess holds an input
_WIDE = 1.0  # the range of random inputs where they have no limit


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
        "ipopt"; "fatrop", an interior point method that uses the stages; "sqpmethod", sequential quadratic programs
        solved by qrqp. fatrop does not end where a model is no number, so that it takes only models that provably
        are numbers everywhere: no root, logarithm or division that may fail.
    starts
        Solve the first step, and one after a failure, from this many guesses, rest at x_0 and random inputs, and
        keep the best: several where this controller is the oracle, so that a local optimum is not the reference.
    settings
        The solver's own settings by CasADi's names, for example ``{"ipopt.tol": 1e-10}``. It works on shares of the
        sizes of inputs, states, limits and cost (see `Sizes`): its tolerances count so.
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
        solver: NLPSolver = "ipopt",
        starts: int = 1,
        settings: Mapping[str, Any] | None = None,
        estimator: Estimator | None = None,
        latency: int = 0,
        moves: Moves = None,
        time_limit: float | None = None,
        monitor: StepMonitor | Episodes | None = None,
    ) -> None:
        super().__init__(model, cost, limits, horizon, moves, estimator, latency, time_limit, monitor)
        if solver not in OPTIONS:
            raise DataError(f'solver is {solver!r}; pass "ipopt", "fatrop" or "sqpmethod"')
        self._starts = checks.count(starts, "starts")
        fixes = {} if self._levels is None else {"inputs_check": False}  # it warns of nodes that fix all inputs
        self._options = solver, {**fixes, **(settings or {})}, time_limit is not None
        self._own = {"solver": solver, "starts": self._starts, "settings": dict(settings or {})}
        self._set_up()
        self._e, self._W = np.zeros((self._N, self._map.nx)), np.zeros((self._N, self._map.scheduled))

    def _made_of(self) -> tuple[str, ModelOrMap, dict[str, Any]]:
        return "NonlinearMPC", self.model, self._own

    def build_program(self, reference: ArrayLike | None) -> Program:
        """Raise the DataError that says why no C code can be generated."""
        raise no_export(
            self,
            "it uses ipopt or a CasADi solver",
            "a KoopmanMPC, or a BilinearMPC of the same model",
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> "NonlinearMPC":
        """Return a copy with solvers of its own: CasADi's copies share one, and two threads in one end the process."""
        return pickle.loads(pickle.dumps(self))

    def update(self, model: ModelOrMap) -> None:
        """Go on with another predictor of the same lifting, as `BilinearMPC.update`; the solver is built again."""
        super().update(model)
        self._set_up()

    def _set_up(self) -> None:
        """Build the nonlinear program, and the search over sequences where all inputs are on levels in all steps."""
        self._shooting = Shooting(self._problem, self._map.theta, *self._options)
        self._rollouts: LevelRollouts | None = None
        levels, p = self._levels, self._problem
        self._stage_limits = p.stage_limits  # of this step
        if levels is not None and levels.index.shape == (len(self._blocks), self.nu) and not p.own:
            self._rollouts = LevelRollouts(p, self._map.theta, levels.held, self._blocks)

    def _limit(self, limits: StageLimits | None) -> None:
        self._stage_limits = self._problem.stage_limits if limits is None else limits.stages
        (low, high), nu = self._stage_limits, self.nu
        self._shooting.set_limits(Interval(low[:, :nu], high[:, :nu]), Interval(low[:, nu:], high[:, nu:]))

    def _weigh(self, Q: Float[np.ndarray, "N nr"], R: Float[np.ndarray, "N m"]) -> None:
        self._shooting.weights = Q, R

    def _schedule(self, W: Float[np.ndarray, "N nw"]) -> None:
        self._W[:] = W

    def _solve(
        self,
        s: Float[np.ndarray, " ns"],
        u_prev: Float[np.ndarray, " nu"],
        first: Interval,
        deadline: float,
    ) -> StagePlan:
        x = s[: self._map.nx]
        starts = [self._next] if self._warm else self._guesses(x, u_prev)
        solved: list[NLPSolution] = []
        for start in starts:
            solved.append(self._shooting.solve(s, self._targets, self._e, start, first, deadline, self._W))
            if perf_counter() > deadline:
                break
        good = [found for found in solved if found.status is Status.OPTIMAL]
        if not good and perf_counter() < deadline:  # once more from where inputs at rest lead, which leaves no gaps
            U = np.tile(np.clip(np.zeros(self.nu), *self._outputs.inputs), (self._N, 1))
            guesses = self._stage_guesses(self._roll_out(x, U), u_prev)
            solved += [self._shooting.solve(s, self._targets, self._e, g, first, deadline, self._W) for g in guesses]
            good = [found for found in solved if found.status is Status.OPTIMAL]
        iterations = sum(found.iterations for found in solved)
        found = min(good, key=lambda each: each.cost) if good else solved[0]
        if good and self._levels is not None and not self._rests_on_levels(np.vstack([s, found.X]), found.U):
            found, more = self._search_levels(found, s, first, deadline)
            iterations += more
            good = good if found.status is Status.OPTIMAL else []
        self._next = found.start
        slack = float(found.slacks[found.slacks > self._shooting.allowance].max(initial=0.0))
        status = Status.SOFTENED if good and slack else found.status
        return StagePlan(np.vstack([s, found.X]), found.U, status, iterations, slack)

    def _go_on_from(self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]) -> None:
        self._next = self._shooting.at(np.vstack([S[2:], S[-1:]]), np.vstack([V[1:], V[-1:]]))

    def _search_levels(
        self, relaxed: NLPSolution, s: Float[np.ndarray, " ns"], first: Interval, deadline: float
    ) -> tuple[NLPSolution, int]:
        """Return the best plan on levels, and all iterations.

        Where all inputs are on levels and sequences are few, it is the best of all. Otherwise branch and bound over
        nonlinear programs finds it; a node is a local optimum, so that a plan is the best one as far as these are.
        """
        search, shooting, N = self._levels, self._shooting, self._N
        assert search is not None, "only asked where inputs have levels"
        levels, starts = search.held.levels, np.flatnonzero(self._problem.free)
        low, high = (np.broadcast_to(end, (N, self.nu)) for end in self._box)
        inside = levels.inside(
            Interval(np.maximum.reduceat(low, starts, axis=0), np.minimum.reduceat(high, starts, axis=0))
        )
        count = len(search.index)
        root = LevelBox(inside.low[:count].copy(), inside.high[:count].copy())
        if (root.low > root.high).any():
            return relaxed._replace(status=Status.INFEASIBLE), 0
        blocks = self._blocks[:count]
        steps, rated = sum(blocks), self._with_rates

        def relax(box: LevelBox, answer: NLPSolution, left: float | None) -> Relaxed:
            least, most = low.copy(), high.copy()
            for end, index in ((least, box.low), (most, box.high)):
                end[:steps, levels.which] = levels.values(np.repeat(index, blocks, axis=0))
            shooting.set_moves(least, most)
            here = first if rated else Interval(least[0], most[0])
            found = shooting.solve(s, self._targets, self._e, answer.start_here, here, deadline, self._W)
            late = left is not None and perf_counter() > deadline
            status = Status.TIME_LIMIT if late and found.status is not Status.OPTIMAL else found.status
            _, U = self._trajectory(np.vstack([s, found.X]), found.U)
            return Relaxed(status, found.cost, levels.indices(U[starts[:count]]), found.iterations, found)

        end, found = None if np.isinf(deadline) else deadline, None
        if self._rollouts is not None:
            stages = StageData(self._targets, self._e, self._W, shooting.weights, self._stage_limits, first)
            best = self._rollouts.find(s, stages, root, search.guess())
            if best is not None:
                found = search.find(relax, LevelBox(best, best.copy()), relaxed, end, relaxed.cost)
        if found is None or (found.answer is None and found.status is not Status.TIME_LIMIT):
            found = search.find(relax, root, relaxed, end, relaxed.cost)
        unlimited = np.full((N, self.nu), np.inf)
        shooting.set_moves(*((-unlimited, unlimited) if rated else (low, high)))
        if found.answer is None:
            return relaxed._replace(status=found.status), found.iterations
        return found.answer, found.iterations

    def _guesses(self, x: Float[np.ndarray, " nx"], u_prev: Float[np.ndarray, " nu"]) -> list[Start]:
        """Return the guesses of a first step: rest at x_0, then where random held inputs lead."""
        N, inputs = self._N, self._outputs.inputs
        rest = np.clip(np.zeros(self.nu), *inputs)
        guesses: list[Guess] = [(np.tile(x, (N + 1, 1)), np.tile(rest, (N, 1)))]
        rng = np.random.default_rng(0)
        low, high = np.maximum(inputs.low, rest - _WIDE), np.minimum(inputs.high, rest + _WIDE)
        for _ in range(self._starts - 1):
            U = np.repeat(rng.uniform(low, high, (-(-N // _HOLD), self.nu)), _HOLD, axis=0)[:N]
            guesses += self._roll_out(x, U)
        return self._stage_guesses(guesses, u_prev)

    def _roll_out(self, x: Float[np.ndarray, " nx"], U: Float[np.ndarray, "N nu"]) -> list[Guess]:
        """Return the states to which U leads, and U; nothing where they overflow, or a step has no solution."""
        X = [x]
        for u, e, w in zip(U, self._e, self._initial.W, strict=True):
            X.append(self._map.step(X[-1], u, w) + e)
        return [(np.array(X), U)] if np.abs(X).max() < HUGE else []  # False for NaN

    def _stage_guesses(self, guesses: list[Guess], u_prev: Float[np.ndarray, " nu"]) -> list[Start]:
        stages = [self._stages(X, U, u_prev) for X, U in guesses]
        return [self._shooting.at(S[1:], V) for S, V in stages]


def _build_oracle(parts: Any, limits: Limits) -> NonlinearMPC:
    """Plan with the model itself, from the best of twelve initial guesses: the oracle where the model is the plant."""
    return NonlinearMPC(parts.step_map, parts.problem.cost, limits, parts.problem.horizon, starts=12)


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
