"""A Koopman MPC step from x to u: a monitor, estimators, limits active against bare solvers; and start-up."""

import os
import subprocess
import sys
import time

import casadi as ca
import numpy as np
import osqp
import pytest
from scipy.sparse import csc_matrix

import koopmpc as km

pytestmark = pytest.mark.speed


def report(benchmark, **figures):
    benchmark.extra_info.update(figures)


def timed(call, *arguments):
    start = time.perf_counter()
    result = call(*arguments)
    return time.perf_counter() - start, result


def pendulum():
    """θ̈ = (g/L) sin θ + u / (m L²) by a semi-implicit step of 0.05 s, θ = 0 upright."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    omega = x[1] + 0.05 * (9.81 / 2 * ca.sin(x[0]) + u / 4)
    F = ca.Function("F", [x, u], [ca.vertcat(x[0] + 0.05 * omega, omega)])
    return km.StepMap(F, 0.05, states=("theta [rad]", "omega [rad/s]"), inputs=("torque [N m]",))


def products(x):
    both = [x[1] * trig(k * x[0]) for k in (1, 2) for trig in (ca.sin, ca.cos)]
    return [*both, x[1] ** 2]


@pytest.fixture(scope="module")
def model():
    data = km.collect(pendulum(), km.Uniform([-3.2, -4], [3.2, 4]), km.Noise(-10, 10), episodes=200, steps=40)
    lifting = km.State() + km.Fourier(2, states="theta") + km.Expressions(products, list("abcde")) + km.Constant()
    found = km.edmd(data, lifting)
    assert found.nz == 12
    return found


def test_step_with_a_monitor(benchmark):
    """Plain and watched steps by turns, so that both meet the same machine: the ratio is what a monitor costs."""
    data = km.collect(pendulum(), km.Uniform([-3.2, -4], [3.2, 4]), km.Noise(-10, 10), episodes=200, steps=40)
    lifting = km.State() + km.Fourier(2, states="theta") + km.Expressions(products, list("abcde")) + km.Constant()
    model, cost, limits = km.edmd(data, lifting), km.Cost(Q=[10, 1], R=0.1), km.Limits(-25, 25)
    plain, watched = (km.KoopmanMPC(model, cost, limits, 40, monitor=given) for given in (None, data))
    rng = np.random.default_rng(0)
    states, reference = 0.05 * rng.normal(size=(4000, 2)), np.zeros(2)
    times = np.array([[timed(mpc, x, reference)[0] for mpc in (plain, watched)] for x in states])
    benchmark(watched, states[0], reference)
    half = np.median(times, axis=0) * 1e6
    report(benchmark, **{"median µs": half[1], "plain µs": half[0], "ratio": half[1] / half[0]})


class Kept:
    """A solver that writes down what it is asked, beside the bare solver of the same QP."""

    def __init__(self, solver, qp, asked):
        self.solver, self.qp, self.asked = solver, qp, asked
        self.name, self.exact = solver.name, solver.exact
        self.other = BARE[self.name](self.qp, self.solver)

    def reset(self):
        self.solver.reset()

    def shift(self, by):
        self.limits = self.qp.low - by, self.qp.high - by
        self.solver.shift(by)

    @property
    def resumes(self):
        return self.solver.resumes

    def resume(self, time_limit=None):
        return self.asks(self.solver.resume(time_limit), *(np.zeros(n) for n in self.qp.A.T.shape))

    def solve(self, v, y, time_limit=None):
        return self.asks(self.solver.solve(v, y, time_limit), v, y)

    def asks(self, solution, v, y):
        low, high = np.maximum(self.limits[0], -1e30), np.minimum(self.limits[1], 1e30)
        self.asked.append((self.other, low, high, v.copy(), y.copy(), solution.iterations))
        return solution


ASKED = ("eps_abs", "eps_rel", "sigma", "max_iter", "check_termination", "eps_prim_inf", "eps_dual_inf")


def bare_osqp(qp, ours):
    """Return a step of OSQP with the settings that ours has now."""
    held = ours._solver.get_settings()
    solver, P, A = osqp.OSQP(), csc_matrix(np.triu(qp.P)), csc_matrix(qp.A)
    low, high = np.maximum(qp.low, -1e30), np.minimum(qp.high, 1e30)
    solver.setup(P, qp.q, A, low, high, verbose=False, **{name: getattr(held, name) for name in ASKED})

    def step(low, high, v, y):
        solver.update(l=low, u=high)
        solver.warm_start(x=v, y=y)
        return solver.solve(raise_error=False).info.iter

    return step


def bare_daqp(qp, ours):
    import daqp

    solver = daqp.Model()
    solver.setup(qp.P, qp.q, qp.A, np.minimum(qp.high, 1e30), np.maximum(qp.low, -1e30))

    def step(low, high, v, y):
        solver.update(bupper=high, blower=low)
        return solver.solve()[3]["iterations"]

    return step


BARE = {"osqp": bare_osqp, "daqp": bare_daqp}


def beside_the_bare_solver(mpc, name, states, rounds):
    """Return seconds of whole steps, of the bare solver on their QPs, one after the other, and the iterations."""
    asked, reference = [], np.zeros(len(states[0]))
    solves = mpc._step.solver.qps._solvers
    figures = []
    for _ in range(rounds):
        own = list(solves)  # the bare solvers start afresh, too
        solves[:] = [None if solver is None else Kept(solver, mpc._step.solver.qps.qp, asked) for solver in own]
        mpc.reset()
        questions = []
        for x in states:
            asked.clear()
            mpc(x, reference)
            questions.append(list(asked))
        solves[:] = own
        mpc.reset()
        for x, asks in zip(states, questions, strict=True):
            t, move = timed(mpc, x, reference)
            if not asks or move.status not in (km.Status.OPTIMAL, km.Status.SOFTENED):
                for ask in asks:
                    ask[0](*ask[1:5])
                continue
            spent = 0.0
            for other, *question, count in asks:
                s, iterations = timed(other, *question)
                spent += s
                assert other.__qualname__.startswith("bare_daqp") or iterations == count
            figures.append((t, spent, move.iterations))
    return np.array(figures).T


def compared(benchmark, ours, theirs, iterations):
    quantiles = {
        f"{who}{what} µs": 1e6 * float(np.quantile(times, q))
        for who, times in (("", ours), ("bare ", theirs))
        for what, q in (("median", 0.5), ("p99", 0.99))
    }
    report(
        benchmark,
        steps=len(ours),
        **quantiles,
        **{
            "ratio of medians": float(np.median(ours) / np.median(theirs)),
            "median of ratios": float(np.median(ours / theirs)),
            "median iterations": float(np.median(iterations)),
        },
    )


CHAIN = np.array([[1, 0.1, 0, 0], [0, 1.02, 0.1, 0], [0, 0, 0.95, 0.1], [0, 0, 0, 0.9]])


@pytest.mark.parametrize(("N", "outputs"), [(20, 1), (50, 2)], ids=["20x40", "50x150"])
@pytest.mark.parametrize("name", ["osqp", "daqp"])
def test_whole_step_against_the_bare_solver(benchmark, name, N, outputs):
    """N inputs and `outputs` hard states a step, 12 loops of 40 steps; and the same step where nothing is active."""
    B, end = np.array([[0.0], [0.05], [0.1], [0.1]]), np.array([6.0, 1.5, np.inf, np.inf])
    end[outputs:] = np.inf
    model = km.LinearPredictor(CHAIN, B, np.eye(4), km.State(), 0.1, tuple("abcd"), ("u",))
    limits = km.Limits(-1, 1, x_min=-end, x_max=end, slack=None)
    mpc, states = km.KoopmanMPC(model, km.Cost(np.ones(4), 0.1), limits, N, solver=name), []
    rng = np.random.default_rng(0)
    for _ in range(12):
        x = rng.normal(size=4) * [2, 0.5, 0.5, 0.5]
        for _ in range(40):
            states.append(x)
            x = CHAIN @ x + B @ mpc(x, np.zeros(4)).u
    rows = len(mpc._step.solver.qps.qp.low)
    assert rows == N * (1 + outputs)
    ours, theirs, iterations = beside_the_bare_solver(mpc, name, states, 5)
    free = [timed(mpc, np.array([0.01, 0, 0, 0]), np.zeros(4))[0] for _ in range(2000)]
    benchmark(mpc, states[0], np.zeros(4))
    compared(benchmark, ours, theirs, iterations)
    report(
        benchmark,
        **{
            "free median µs": 1e6 * float(np.median(free)),
            "free to bare": float(np.median(free) / np.median(theirs)),
        },
    )


ESTIMATORS = {"relifted": km.LiftedDisturbance(), "filtered": km.LiftedKalman(("theta", "omega"))}


@pytest.mark.parametrize("name", ESTIMATORS)
def test_step_with_an_estimator(benchmark, model, name):
    """Steps with nothing active, with an estimator and without, one after the other."""
    cost, limits, reference = km.Cost(Q=[10, 1], R=0.1), km.Limits(-25, 25), np.zeros(2)
    sides = [km.KoopmanMPC(model, cost, limits, 40, estimator=chosen) for chosen in (ESTIMATORS[name], None)]
    times = []
    for x in 0.05 * np.random.default_rng(0).normal(size=(8000, 2)):
        found = [timed(mpc, x, reference) for mpc in sides]
        assert all(move.status is km.Status.UNCONSTRAINED for _, move in found)
        times.append([t for t, _ in found])
    benchmark(sides[0], np.zeros(2), reference)
    (half, plain), (high, plain_high) = np.quantile(times, [0.5, 0.99], axis=0) * 1e6
    figures = {"median µs": half, "without µs": plain, "p99 µs": high, "without p99 µs": plain_high}
    report(benchmark, **figures, ratio=half / plain)


@pytest.mark.parametrize("what", ["import", "help"])
def test_start_up(benchmark, what):
    command = {"import": ["-c", "import koopmpc"], "help": ["-m", "koopmpc", "--help"]}[what]

    def run():
        subprocess.run([sys.executable, *command], check=True, capture_output=True, env=dict(os.environ))

    run()
    benchmark.pedantic(run, rounds=7)
    report(benchmark, **{"median s": benchmark.stats.stats.median})
