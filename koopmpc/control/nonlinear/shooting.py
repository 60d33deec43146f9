"""Shooting: the nonlinear program of a horizon by multiple shooting, solved by one of CasADi's solvers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Literal, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.control.ask.limits import SOFTENED, Interval
from koopmpc.control.move import Status
from koopmpc.control.nonlinear.ranges import find_undefined_operation
from koopmpc.control.nonlinear.stages import StagedProblem, StageTargets
from koopmpc.control.nonlinear.stagewise import sum_costs, target_symbols, weight_symbols

NLPSolver = Literal["ipopt", "fatrop", "sqpmethod"]
OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "ipopt": {
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 300,
        "ipopt.warm_start_init_point": "yes",
    },
    "fatrop": {"fatrop.print_level": 0, "fatrop.max_iter": 300, "structure_detection": "manual"},
    "sqpmethod": {
        "qpsol": "qrqp",
        "max_iter": 100,
        "convexify_strategy": "eigen-clip",
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False},
    },
}


@dataclass(frozen=True)
class NLP:
    """A solver of nonlinear programs, as `NonlinearMPC` takes one.

    Attributes
    ----------
    solver
        "ipopt"; "fatrop", an interior point method that uses the stages; "sqpmethod", sequential quadratic programs
        solved by qrqp. fatrop may loop for ever where a model returns NaN: models with a root, a logarithm or a
        division that may fail are refused.
    starts
        Solve the first step, and one after a failure, from this many guesses, rest at x_0 and random inputs, and
        keep the best: several where other controllers are judged by this one, which must not be a local optimum.
    settings
        The solver's own settings by CasADi's names, for example ``{"ipopt.tol": 1e-10}``. It works on shares of the
        sizes of inputs, states, limits and cost (see `Sizes`): its tolerances count so.

    Raises
    ------
    DataError
        There is no such solver, or starts is below 1.
    """

    solver: NLPSolver = "ipopt"
    starts: int = 1
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        if self.solver not in OPTIONS:
            raise DataError(f'solver is {self.solver!r}; pass "ipopt", "fatrop" or "sqpmethod"')
        checks.count(self.starts, "starts")


# A step that failed says so by its status; nobody asks how the cost depends on the parameters.
_QUIET = {"show_eval_warnings": False, "calc_lam_p": False}
_STATUS = {
    "Solve_Succeeded": Status.OPTIMAL,
    "Solved_To_Acceptable_Level": Status.OPTIMAL,
    "Maximum_Iterations_Exceeded": Status.MAX_ITERATIONS,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
    "SOLVER_RET_SUCCESS": Status.OPTIMAL,
    "SOLVER_RET_LIMITED": Status.MAX_ITERATIONS,
    "SOLVER_RET_INFEASIBLE": Status.INFEASIBLE,
}
# Keys of the answers of solvers, kept alive: else each step would add new ones to Python's table of names.
_NAMES: set[str] = set()


class Start(NamedTuple):
    """Where a solver begins: its variables, and the multipliers of their bounds and of its constraints."""

    v: Float[np.ndarray, " n"]
    bounds: Float[np.ndarray, " n"]
    constraints: Float[np.ndarray, " m"]


class NLPSolution(NamedTuple):
    """Inputs, states and slacks of the stages, their cost, how the solver ended, and the start of the next step.

    `start_here` is the start of another solve of the same step.
    """

    U: Float[np.ndarray, "N nu"]
    X: Float[np.ndarray, "N nx"]
    slacks: Float[np.ndarray, "N ns"]
    cost: float
    status: Status
    iterations: int
    start: Start
    start_here: Start


class Shooting:
    """The nonlinear program of a horizon: variables (u_k, x_{k+1}, ε_{k+1}) stage by stage, ε ≥ 0 the slacks.

    The constraints are x_{k+1} = F(x_k, u_k) + e_k and the limits. The solver works on shares: of the sizes of inputs,
    states and limits, and of the scale of the cost, so that its tolerances mean the same in all units.

    Parameters
    ----------
    problem, theta
        The stages, and the θ of their F.
    nlp
        The solver and its settings.
    timed
        Whether the solver asks for the time after each iteration.

    Raises
    ------
    DataError
        The solver refuses its settings.

    References
    ----------
    Bock & Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", IFAC 1984.
    """

    @raise_swallowed()
    def __init__(
        self,
        problem: StagedProblem,
        theta: Float[np.ndarray, " nt"],
        nlp: NLP,
        *,
        timed: bool,
    ) -> None:
        solver, settings, p = nlp.solver, nlp.settings, problem
        (N, nu), ng = problem.held_from.shape, len(problem.box.low)
        F, smooth = _fix_theta(p, theta), p.F.is_a("SXFunction")
        soft = np.flatnonzero(np.isfinite(p.softness.linear))
        ns, row = len(soft), p.softness.allowance / SOFTENED
        self.allowance, self._path_row, self._scale = p.softness.allowance[soft], row, p.scale
        self._sizes = np.concatenate([p.input_sizes, p.sizes, row[soft]])
        self._moves_at = nu + p.moved if p.with_rates else 0  # the first column of u_k among the variables of a stage
        self._shape, self._split = (N, len(self._sizes)), (nu, nu + p.nx)
        W = ca.MX.sym("W", len(self._sizes), N)
        U, X, E = ca.vertsplit(ca.DM(self._sizes) * W, [0, *self._split, len(self._sizes)])
        x0, e, schedule = (ca.MX.sym("p", *size) for size in ((p.nx, 1), (p.moved, N), (p.scheduled, N)))
        targets, diagonals, states = target_symbols(p), weight_symbols(p), ca.horzcat(x0, X)
        Q, R = (
            np.tile(full.diagonal(), (N, int(given.numel() > 0)))
            for full, given in zip((p.Q, p.R), diagonals, strict=True)
        )
        self.weights = Q, R
        f = sum_costs(p, states, U, targets, diagonals)
        ahead = F.map(N)(states[:, :N], U, schedule) + ca.vertcat(e, ca.MX(p.nx - p.moved, N))
        gaps, path = W[nu : nu + p.nx, :] - ahead / ca.DM(p.sizes), ca.MX(0, N)
        if ng:  # values − ε ≤ high; values + ε ≥ low
            values, relaxed = p.limited.map(N)(X), ca.DM(np.eye(ng)[:, soft]) @ E if ns else ca.MX(ng, N)
            path = ca.vertcat(values - relaxed, values + relaxed) / ca.DM(np.tile(row, 2))
        if ns:
            linear, quadratic = (ca.DM(weight[soft]) for weight in p.softness[:2])
            f += ca.sum2(linear.T @ E + quadratic.T @ E**2)
        self._bound(p, ns)
        given = [x0, *targets[:2], e, *targets[2:], schedule, *diagonals]
        program = {"x": ca.vec(W), "p": ca.veccat(*given), "f": f / p.scale, "g": _stack(gaps, path)}
        options: dict[str, Any] = {"expand": smooth, "error_on_fail": False, "print_time": False}
        self._start_is_number: ca.Function | None = None
        if solver == "fatrop":
            _demand_numbers(F, p.tracked, p.limited, *(() if p.stage is None else (p.stage,)))
            self._start_is_number = _is_number(program)
            ends = {"nx": [0] + [p.nx] * N, "nu": [nu] + [ns + nu] * (N - 1) + [ns], "ng": [0] + [2 * ng] * N}
            options |= {"N": N, **ends}
        self._clock = _Clock(W.numel(), program["g"].numel()) if timed and solver != "fatrop" else None
        if self._clock is not None:
            options["iteration_callback"] = self._clock
        try:
            with raise_swallowed():
                self._solver = ca.nlpsol(
                    "shooting", solver, program, {**_QUIET, **OPTIONS[solver], **options, **settings}
                )
        except (RuntimeError, NotImplementedError, TypeError) as error:
            reason = [line for line in str(error).splitlines() if line.strip()][-1].strip()
            raise DataError(
                f"{solver} was not built with settings {dict(settings)}: {reason}; pass its own settings by CasADi's "
                'names, for example {"ipopt.tol": 1e-8}'
            ) from error

    def _bound(self, p: StagedProblem, ns: int) -> None:
        """Set the bounds of the variables and of the constraints (see `_stack`), and how both are shifted."""
        N, nu, nx, ng = len(p.held_from), p.held_from.shape[1], p.nx, len(p.box.low)
        path = 2 * ng
        places = np.arange(N)[:, None] * (nx + path)
        gap_at = places - path + np.arange(nx)
        gap_at[0] += path
        path_at = places + nx + nx + np.arange(path)
        path_at[-1] -= nx
        self._path_at = path_at
        self._next_g = np.empty(N * (nx + path), dtype=np.intp)
        for at in (gap_at, path_at):
            self._next_g[at] = np.vstack([at[1:], at[-1:]])
        stages = np.arange(N * len(self._sizes)).reshape(N, -1)
        self._next_v = np.vstack([stages[1:], stages[-1:]]).ravel()
        lbg, ubg = np.zeros(len(self._next_g)), np.zeros(len(self._next_g))
        outputs, infinite = p.stage_limits, np.full((N, ng), np.inf)
        lbg[path_at] = np.hstack([-infinite, outputs.low[:, nu:] / self._path_row])
        ubg[path_at] = np.hstack([outputs.high[:, nu:] / self._path_row, infinite])
        if p.ends:  # a terminal set limits the last stage alone
            ubg[path_at[:-1, ng - p.ends : ng]] = np.inf
        unlimited = np.full(nx, np.inf)
        lbx = np.tile(np.concatenate([p.inputs.low, -unlimited, np.zeros(ns)]), (N, 1))
        ubx = np.tile(np.concatenate([p.inputs.high, unlimited, np.full(ns, np.inf)]), (N, 1))
        held = np.zeros(lbx.shape, dtype=np.bool_)
        held[:, :nu] = p.held_from != np.arange(N)[:, None]
        lbx[held] = ubx[held] = 0.0
        lbx, ubx = lbx / self._sizes, ubx / self._sizes
        self._bounds = {"lbx": lbx.ravel(), "ubx": ubx.ravel(), "lbg": lbg, "ubg": ubg}

    def set_limits(self, inputs: Interval, outputs: Interval) -> None:
        """Set the limits (N, nu) of the inputs of all stages, and those (N, ng) of their outputs."""
        nu, ng = inputs.low.shape[1], outputs.low.shape[1]
        for end, value in zip(("lbx", "ubx"), inputs, strict=True):
            self._bounds[end].reshape(self._shape)[:, :nu] = value / self._sizes[:nu]
        if ng:
            self._bounds["ubg"][self._path_at[:, :ng]] = outputs.high / self._path_row
            self._bounds["lbg"][self._path_at[:, ng:]] = outputs.low / self._path_row

    def set_moves(self, low: Float[np.ndarray, "N nu"], high: Float[np.ndarray, "N nu"]) -> None:
        """Set the limits of the inputs u_k of all stages alone, which a state holds where changes are the variables."""
        first = self._moves_at
        for end, value in zip(("lbx", "ubx"), (low, high), strict=True):
            columns = slice(first, first + value.shape[1])
            self._bounds[end].reshape(self._shape)[:, columns] = value / self._sizes[columns]

    def at(self, X: Float[np.ndarray, "N nx"], U: Float[np.ndarray, "N nu"]) -> Start:
        """Return a start with these states x_1 … x_N and inputs."""
        W = np.zeros(self._shape)
        W[:, : self._split[0]], W[:, self._split[0] : self._split[1]] = U, X
        return Start((W / self._sizes).ravel(), np.zeros(W.size), np.zeros(len(self._next_g)))

    def solve(
        self,
        x0: Float[np.ndarray, " nx"],
        targets: StageTargets,
        e: Float[np.ndarray, "N n"],
        start: Start,
        first: Interval,
        deadline: float = np.inf,
        schedule: Float[np.ndarray, "N ns"] | None = None,
    ) -> NLPSolution:
        """Solve from `start` with u_0 inside `first`; ipopt and sqpmethod end after the iteration of the deadline."""
        if self._clock is not None:
            self._clock.deadline = deadline
        nu, t = self._split[0], targets
        for end, value in zip(("lbx", "ubx"), first, strict=True):
            self._bounds[end][:nu] = value / self._sizes[:nu]
        p = [x0, t.R.ravel(), t.U.ravel(), e.ravel(), t.M.ravel("F"), t.L.ravel("F"), t.m]
        p += [] if schedule is None else [schedule.ravel()]
        p += [rows.ravel() for rows in self.weights]
        begin = {"x0": start.v, "lam_x0": start.bounds, "lam_g0": start.constraints}
        U, X, slacks = np.split(start.v.reshape(self._shape) * self._sizes, self._split, axis=1)
        failed = NLPSolution(U, X, slacks, np.inf, Status.FAILED, 0, start, start)
        if self._start_is_number is not None and not float(self._start_is_number(start.v, np.concatenate(p))):
            return failed
        with raise_swallowed():
            try:
                found = cast("dict[str, Any]", self._solver(p=np.concatenate(p), **self._bounds, **begin))
            except RuntimeError:  # CasADi refuses bounds that overflow
                return failed
            stats = self._solver.stats()
            _NAMES.update(found, stats, stats.get("iterations", ()))
            v, bounds, constraints = (found[name].full().ravel() for name in ("x", "lam_x", "lam_g"))
        unified = str(stats.get("unified_return_status"))
        status = _STATUS.get(str(stats["return_status"]), _STATUS.get(unified, Status.FAILED))
        if self._clock is not None and self._clock.rang:
            status = Status.TIME_LIMIT
        if not np.isfinite(v).all():
            status = Status.FAILED
        U, X, slacks = np.split(v.reshape(self._shape) * self._sizes, self._split, axis=1)
        after = Start(v[self._next_v], bounds[self._next_v], constraints[self._next_g])
        return NLPSolution(
            U,
            X,
            slacks,
            self._scale * float(found["f"]),
            status,
            int(stats.get("iter_count", 0)),
            after,
            Start(v, bounds, constraints),
        )


class _Clock(ca.Callback):
    """What a solver asks after each of its iterations: whether the deadline is over."""

    def __init__(self, nv: int, ng: int) -> None:
        super().__init__()
        self._sizes = {"x": nv, "f": 1, "g": ng, "lam_x": nv, "lam_g": ng}
        self._deadline, self.rang = np.inf, False
        self.construct("clock", {})

    @property
    def deadline(self) -> float:
        """When the solver is stopped [s of `perf_counter`]; a new one lets it run again."""
        return self._deadline

    @deadline.setter
    def deadline(self, value: float) -> None:
        self._deadline, self.rang = value, False

    def get_n_in(self) -> int:
        """Return how many values of an iteration CasADi passes."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Return 1: whether to stop."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the shape of a value, empty for those that this problem has not."""
        return ca.Sparsity.dense(self._sizes.get(ca.nlpsol_out(i), 0), 1)

    def eval(self, _: Any) -> list[float]:
        """Return [1.0] where the deadline is over."""
        self.rang = perf_counter() > self._deadline
        return [float(self.rang)]


def _demand_numbers(*functions: ca.Function) -> None:
    """Raise a DataError where one of these may be no number: fatrop factors a matrix of NaN again and again.

    Nothing stops it then, so that no step of a loop may meet one.
    """
    for function in functions:
        found = find_undefined_operation(function)
        if found is not None:
            raise DataError(
                f"fatrop does not end where a model is not a number, and this one has {found}; "
                'pass solver="ipopt" or "sqpmethod", or write the model so that it is a number everywhere'
            )


def _is_number(nlp: Mapping[str, ca.MX]) -> ca.Function:
    """Return (variables, parameters) → whether cost, constraints and their slope along (1, …, 1) are finite there.

    fatrop does not end where they are not: it factors a matrix of NaN again and again.
    """
    v, values = nlp["x"], ca.vertcat(nlp["f"], nlp["g"])
    size = ca.sumsqr(values) + ca.sumsqr(ca.jtimes(values, v, ca.MX.ones(v.numel())))
    return ca.Function("is_number", [v, nlp["p"]], [size < ca.inf])


def _fix_theta(p: StagedProblem, theta: Float[np.ndarray, " nt"]) -> ca.Function:
    """Return (x, u, w) → F with this θ."""
    x, u, w = ca.MX.sym("x", p.nx), ca.MX.sym("u", len(p.R)), ca.MX.sym("w", p.scheduled)
    F = ca.Function("F", [x, u, w], [p.F(x, u, ca.vertcat(ca.MX(ca.DM(theta[: len(theta) - p.scheduled])), w))])
    return F.expand() if p.F.is_a("SXFunction") else F


def _stack(gaps: ca.MX, path: ca.MX) -> ca.MX:
    """Return gap_1; gap_2, path_1; …; gap_N, path_{N−1}; path_N, the order in which fatrop finds the stages."""
    N = gaps.shape[1]
    parts = [gaps[:, 0]]
    for k in range(1, N):
        parts += [gaps[:, k], path[:, k - 1]]
    return ca.vertcat(*parts, path[:, N - 1])
