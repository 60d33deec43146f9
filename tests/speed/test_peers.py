"""A whole step beside peers: the same MPC written in CVXPY with parameters, and do-mpc on the same plants."""

import time

import casadi as ca
import numpy as np
import pytest

import koopmpc as km

pytestmark = pytest.mark.speed

LIMITS = {
    "inputs": km.Limits(-12, 12),
    "inputs and soft states": km.Limits(-12, 12, x_min=[-np.inf, -0.25], x_max=[np.inf, 0.25], slack=(100, 100)),
}


def report(benchmark, **figures):
    benchmark.extra_info.update(figures)


def timed(call, *arguments):
    """Time of the processor, not of the wall: on a busy machine long steps are interrupted, and short ones are not."""
    start = time.thread_time()
    result = call(*arguments)
    return time.thread_time() - start, result


class InCVXPY:
    """The QP of KoopmanMPC in CVXPY: ψ(x) and r are parameters (DPP), solved by OSQP from its last solution.

    Sparse as one writes it down, with z_0 … z_N as variables; or condensed to the inputs, which CVXPY does faster.
    """

    def __init__(self, model, cost, limits, N, condensed):
        import cvxpy as cp

        self.model, nx, nu, nz = model, model.nx, model.nu, model.nz
        self.z0, self.r = cp.Parameter(nz), cp.Parameter(nx)
        self.U = cp.Variable((N, nu))
        rows = [self.U >= float(limits.u_min), self.U <= float(limits.u_max)]  # noqa: SIM300
        if condensed:
            free, forced = np.zeros((N + 1, nx, nz)), np.zeros((N + 1, nx, N * nu))
            power, drive = np.eye(nz), np.zeros((nz, N * nu))
            for k in range(N + 1):
                free[k], forced[k] = model.C @ power, model.C @ drive
                power, drive = model.A @ power, model.A @ drive
                if k < N:
                    drive[:, k * nu : (k + 1) * nu] += model.B
            flat = free.reshape(-1, nz) @ self.z0 + forced.reshape(-1, N * nu) @ cp.vec(self.U, order="C")
            X = cp.reshape(flat, (N + 1, nx), order="C")
        else:
            Z = cp.Variable((N + 1, nz))
            rows += [Z[0] == self.z0, Z[1:] == Z[:-1] @ model.A.T + self.U @ model.B.T]
            X = Z @ model.C.T
        Q, R = (np.linalg.cholesky(weight) for weight in cost.matrices(nx, nu))
        error = X - np.ones((N + 1, 1)) @ cp.reshape(self.r, (1, nx), order="C")
        objective = cp.sum_squares(error[1:N] @ Q) + cp.sum_squares(self.U @ R)
        objective += cp.sum_squares(error[N] @ np.linalg.cholesky(cost.Q_N))
        if limits.x_max is not None:
            slack = cp.Variable(N, nonneg=True)
            linear, quadratic = limits.slack
            objective += linear * cp.sum(slack) + quadratic * cp.sum_squares(slack)
            rows += [X[1:, 1] <= limits.x_max[1] + slack, X[1:, 1] >= limits.x_min[1] - slack]
        self.problem = cp.Problem(cp.Minimize(objective), rows)
        assert self.problem.is_dcp(dpp=True)

    def __call__(self, x, r):
        self.z0.value, self.r.value = self.model.lift(x), r
        self.problem.solve(solver="OSQP", warm_start=True, eps_abs=1e-4, eps_rel=1e-4, max_iter=20000)
        return self.U.value[0]

    def exactly(self, x, r):
        self.z0.value, self.r.value = self.model.lift(x), r
        self.problem.solve(solver="CLARABEL")
        return self.U.value[0]


@pytest.fixture(scope="module")
def pendulum():
    problem = km.load_problem("pendulum")
    parts = km.bench.Prepared(problem)
    near = parts.step_map.linearize(*problem.equilibrium)
    Q, R = problem.cost.matrices(2, 1)
    cost = km.Cost(Q=Q, R=R, Q_N=km.dlqr(near.A, near.B, Q, R).P, u_target="zero")
    return parts, cost, problem.horizon


@pytest.mark.parametrize("name", list(LIMITS))
@pytest.mark.parametrize("condensed", [False, True], ids=["sparse", "condensed"])
def test_against_cvxpy(benchmark, pendulum, condensed, name):
    """The states of closed loops from 12 starts: ours takes a loop, with OSQP and DAQP, then CVXPY the same one."""
    parts, cost, N = pendulum
    limits, reference, rows = LIMITS[name], np.zeros(2), []
    ours, other = (km.KoopmanMPC(parts.model, cost, limits, N, solver=each) for each in ("osqp", "daqp"))
    theirs = InCVXPY(parts.model, cost, limits, N, condensed)
    theirs(np.zeros(2), reference)  # CVXPY compiles at the first solve

    def loops():
        for x in np.random.default_rng(0).uniform([-0.5, -0.1], [0.5, 0.1], (12, 2)):
            ours.reset()
            other.reset()
            states, mine = [], []
            for _ in range(20):
                states.append(x)
                mine.append(timed(ours, x, reference))
                x = parts.step_map(x, mine[-1][1].u)
            second = [timed(other, x, reference) for x in states]
            third = [timed(theirs, x, reference) for x in states]
            for x, (a, move), (b, _), (c, u) in zip(states, mine, second, third, strict=True):
                rows.append((a, b, c, move.status is km.Status.UNCONSTRAINED, move.u[0], u[0], *x))

    benchmark.pedantic(loops, rounds=1)
    with_osqp, with_daqp, cvxpy, free, u, u_other, *states = np.array(rows).T
    exact = [theirs.exactly(x, reference)[0] for x in np.transpose(states)]
    figures = {"largest error of u": abs(u - exact).max(), "CVXPY's": abs(u_other - exact).max()}
    for which, chosen in (("active", free == 0), ("free", free == 1)):
        a, b, c = (np.median(times[chosen]) * 1e6 for times in (with_osqp, with_daqp, cvxpy))
        figures |= {f"{which} steps": chosen.sum(), f"{which} µs": a, f"{which} µs DAQP": b}
        figures |= {f"{which} µs CVXPY": c, f"{which} ratio": c / a, f"{which} ratio DAQP": c / b}
        a, b, c = (np.quantile(times[chosen], 0.99) * 1e6 for times in (with_osqp, with_daqp, cvxpy))
        figures |= {f"{which} p99 µs": a, f"{which} p99 µs DAQP": b, f"{which} p99 µs CVXPY": c}
    report(benchmark, **figures)
    assert figures["largest error of u"] < 0.12  # 1 % of the limit: the same MPC, to OSQP's tolerance
    assert min(figures["active steps"], figures["free steps"]) > 20


class DoMPC:
    """do-mpc on a step map: its own `make_step`, with the cost, the limits and the horizon of a problem."""

    def __init__(self, step_map, cost, limits, horizon, P, reference):
        do_mpc = pytest.importorskip("do_mpc", reason="do-mpc is not installed: pip install koopmpc[peers]")
        self.dt, self.nu, self.horizon = step_map.dt, step_map.nu, horizon
        model = do_mpc.model.Model("discrete", "SX")
        x = model.set_variable("_x", "x", (step_map.nx, 1))
        u = model.set_variable("_u", "u", (step_map.nu, 1))
        model.set_rhs("x", step_map.F(x, u))
        model.setup()
        mpc = do_mpc.controller.MPC(model)
        mpc.settings.n_horizon, mpc.settings.t_step = horizon, self.dt
        mpc.settings.store_lagr_multiplier, mpc.settings.store_solver_stats = False, ["success"]
        mpc.settings.supress_ipopt_output()
        mpc.settings.nlpsol_opts["record_time"] = True
        Q, R = (ca.DM(weight) for weight in cost.matrices(step_map.nx, step_map.nu))
        error = x - ca.DM(reference)
        stage, end = ca.mtimes([error.T, Q, error]), ca.mtimes([error.T, ca.DM(P), error])
        mpc.set_objective(lterm=stage + ca.mtimes([u.T, R, u]), mterm=end)
        mpc.set_rterm(u=0.0)
        mpc.bounds["lower", "_u", "u"] = float(limits.u_min)
        mpc.bounds["upper", "_u", "u"] = float(limits.u_max)
        mpc.setup()
        self.mpc, self.ipopt = mpc, []

    def reset(self, x0=None, u_prev=None):
        self.mpc.reset_history()
        self.mpc.x0, self.mpc.u0 = np.asarray(x0), np.zeros(self.nu)
        self.mpc.set_initial_guess()

    def __call__(self, y, reference, applied=None):
        taken, u = timed(self.mpc.make_step, np.asarray(y).reshape(-1, 1))
        self.ipopt.append(self.mpc.solver_stats["t_wall_total"])
        good = self.mpc.solver_stats["success"]
        status = km.Status.OPTIMAL if good else km.Status.FAILED
        return km.Move(u.ravel().copy(), status, km.control.Fallback.NONE, taken, 0)


@pytest.mark.filterwarnings("ignore")  # what do-mpc's own imports warn of
@pytest.mark.parametrize("name", ["pendulum:upright", "cart_pole:shift", "cart_pole:recover"])
def test_against_do_mpc(benchmark, name):
    """The stabilising cases of the bench: Koopman MPC knows the plant from data alone, do-mpc has its equations.

    Ours is timed by the wall, do-mpc by the processor: on a busy machine that is in do-mpc's favour.
    """
    pytest.importorskip("do_mpc", reason="do-mpc is not installed: pip install koopmpc[peers]")
    problem = km.load_problem(name)
    parts, case = km.bench.Prepared(problem), problem.cases[name.split(":")[1]]
    limits, plant = problem.limits, parts.step_map
    near = plant.linearize(*problem.equilibrium)
    P = km.dlqr(near.A, near.B, *problem.cost.matrices(plant.nx, plant.nu)).P
    sides = (
        km.KoopmanMPC(parts.model, problem.cost, limits, problem.horizon),
        DoMPC(plant, problem.cost, limits, problem.horizon, P, case.reference),
    )
    found = [[], []]

    def both():
        for side, runs in zip(sides, found, strict=True):
            run = km.simulate(
                plant,
                side,
                x0=case.x0,
                reference=case.reference,
                steps=case.steps,
                cost=problem.cost,
                limits=limits,
            )
            runs.append((run, km.metrics(run)))

    benchmark.pedantic(both, rounds=2, warmup_rounds=1)
    (run, mine), (_, other) = found[0][-1], found[1][-1]
    active = [t for t, s in zip(run.solve_time, run.status, strict=True) if s is not km.Status.UNCONSTRAINED]
    assert other.status.get("FAILED", 0) == 0
    report(
        benchmark,
        **{
            "median µs": mine.solve_time_p50 * 1e6,
            "do-mpc median µs": other.solve_time_p50 * 1e6,
            "ratio": other.solve_time_p50 / mine.solve_time_p50,
            "do-mpc median µs in ipopt": np.median(sides[1].ipopt) * 1e6,
            "active steps": len(active),
            "active median µs": np.median(active) * 1e6 if active else np.nan,
            "active ratio": other.solve_time_p50 / np.median(active) if active else np.nan,
            "p99 µs": mine.solve_time_p99 * 1e6,
            "do-mpc p99 µs": other.solve_time_p99 * 1e6,
            "p99 ratio": other.solve_time_p99 / mine.solve_time_p99,
            "cost": mine.cost,
            "do-mpc cost": other.cost,
            "cost ratio": mine.cost / other.cost,
        },
    )
