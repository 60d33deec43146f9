"""A Koopman MPC step from x to u: nothing active, limits active against bare OSQP, many observables; and start-up."""

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
    sys.stdout.write(f"\n{benchmark.name}: " + ", ".join(f"{k} {v:.3g}" for k, v in figures.items()) + "\n")


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


def test_step_with_nothing_active(benchmark, model):
    mpc = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(-25, 25), 40)
    rng = np.random.default_rng(0)
    states, reference = 0.05 * rng.normal(size=(4000, 2)), np.zeros(2)
    times = []
    for x in states:
        t, move = timed(mpc, x, reference)
        assert move.status is km.Status.UNCONSTRAINED
        times.append(t)
    benchmark(mpc, states[0], reference)
    half, high = np.quantile(times, [0.5, 0.99]) * 1e6
    report(benchmark, **{"median µs": half, "p99 µs": high})


@pytest.mark.parametrize("N", [20, 40, 100])
def test_step_with_a_moving_reference(benchmark, model, N):
    """Resting and moving steps by turns: the ratio is what a reference that moves costs."""
    cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(-25, 25)
    rest, rows, row = (km.KoopmanMPC(model, cost, limits, N) for _ in range(3))
    signal = 0.01 * np.sin(0.1 * np.arange(4001 + N))[:, None] * np.ones(2)
    x, times = np.array([0.02, 0.0]), []
    for k in range(4000):
        ahead, now = signal[k : k + N + 1], signal[k]
        times.append([timed(rest, x, np.zeros(2))[0], timed(rows, x, ahead)[0], timed(row, x, now)[0]])
    benchmark(rest, x, np.zeros(2))
    resting, moving, single = np.median(times, axis=0) * 1e6
    report(benchmark, **{"resting µs": resting, "rows": moving / resting, "one row": single / resting})


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


@pytest.mark.parametrize("limits", ["inputs", "inputs and soft states"])
def test_step_with_limits_active(benchmark, model, limits):
    """The same QPs, one after the other, by the controller and by OSQP's own Python interface."""
    plant = pendulum()
    ends = {} if limits == "inputs" else {"x_min": [-np.inf, -1.5], "x_max": [np.inf, 1.5]}
    mpc = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(-10, 10, **ends), 40)
    x, states = np.array([1.4, 0.0]), []
    for _ in range(300):
        states.append(x)
        x = plant(x, mpc(x, np.zeros(2)).u)
        x[0] = np.mod(x[0] + np.pi, 2 * np.pi) - np.pi
    found = beside_the_bare_solver(mpc, "osqp", states, 1)
    assert len(found[0]) > 100
    benchmark(mpc, states[1], np.zeros(2))
    compared(benchmark, *found)


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


class Lifted:
    """A lifting that costs nothing: z is there already."""

    def __init__(self, z):
        self.arguments, self.results, self.evaluate = (np.zeros(2),), (z,), lambda: None


def controller(nz, rng):
    A = np.diag(rng.uniform(0.2, 0.9, nz)) + 0.1 / nz * rng.normal(size=(nz, nz))
    lifting = km.State() + km.Gaussian(rng.normal(size=(nz - 2, 2)), 0.5)
    B = rng.normal(size=(nz, 1))
    predictor = km.LinearPredictor(A, B, np.eye(2, nz), lifting, 0.05, ("a", "b"), ("u",))
    mpc = km.KoopmanMPC(predictor, km.Cost(1, 1, Q_N=np.eye(nz)), km.Limits(-1e6, 1e6), 40)
    mpc.observer.lift = Lifted(0.1 * rng.normal(size=nz))
    return mpc


def test_step_with_many_observables(benchmark):
    rng = np.random.default_rng(0)
    small, large = controller(10, rng), controller(1000, rng)
    M, z = rng.normal(size=(40, 1000)), rng.normal(size=1000)
    out, x, reference = np.empty(40), np.zeros(2), np.zeros(2)
    calls = (
        lambda: small(x, reference),
        lambda: large(x, reference),
        lambda: np.dot(M, z, out=out),
    )
    times = [[timed(call)[0] for call in calls] for _ in range(3000)]
    benchmark(large, x, reference)
    few, many, product = 1e6 * np.median(times, axis=0)
    report(
        benchmark,
        **{
            "µs at 10": few,
            "µs at 1000": many,
            "product µs": product,
            "ratio to step at 10 + product": many / (few + product),
        },
    )


@pytest.mark.parametrize("what", ["import", "help"])
def test_start_up(benchmark, what):
    command = {"import": ["-c", "import koopmpc"], "help": ["-m", "koopmpc", "--help"]}[what]

    def run():
        subprocess.run([sys.executable, *command], check=True, capture_output=True, env=dict(os.environ))

    run()
    benchmark.pedantic(run, rounds=7)
    report(benchmark, **{"median s": benchmark.stats.stats.median})
