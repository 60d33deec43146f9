"""A Koopman MPC step from x to u: nothing active, limits active against bare OSQP, many observables; and start-up."""

import os
import subprocess
import sys
import time

import casadi as ca
import numpy as np
import osqp
import pytest

import koopmpc as km
from koopmpc.control.solvers.osqp import DEFAULTS
from koopmpc.plant.buffered import Slot

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
    lifting = (
        km.State() + km.Fourier(2, states="theta") + km.Expressions(products, list("abcde")) + km.Constant()
    )
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


class Kept:
    """A solver that writes down what it is asked, beside the bare solver of the same QP."""

    def __init__(self, solve, asked):
        self.solver, self.asked, self.limits = solve._solver, asked, None
        self.other = bare(solve.program.qp, self.solver._settings)

    def reset(self):
        self.solver.reset()

    def update(self, low, high):
        self.limits = np.maximum(low, -1e30), np.minimum(high, 1e30)
        self.solver.update(low, high)

    def solve(self, v, y, time_limit=None):
        solution = self.solver.solve(v, y, time_limit)
        self.asked.append((self.other, *self.limits, v.copy(), y.copy(), solution.iterations))
        return solution


def bare(qp, settings):
    import scipy.sparse

    solver = osqp.OSQP()
    P = scipy.sparse.csc_matrix(np.triu(qp.P))
    low, high = np.maximum(qp.low, -1e30), np.minimum(qp.high, 1e30)
    solver.setup(P, qp.q, scipy.sparse.csc_matrix(qp.A), low, high, verbose=False, **{**DEFAULTS, **settings})
    return solver


def bare_step(solver, low, high, v, y):
    solver.update(l=low, u=high)
    solver.warm_start(x=v, y=y)
    return solver.solve(raise_error=False)


@pytest.mark.parametrize("limits", ["inputs", "inputs and soft states"])
def test_step_with_limits_active(benchmark, model, limits):
    """The same QPs, one after the other, by the controller and by OSQP's own Python interface."""
    plant = pendulum()
    box = (
        km.Limits(-10, 10)
        if limits == "inputs"
        else km.Limits(-10, 10, x_min=[-np.inf, -1.5], x_max=[np.inf, 1.5])
    )
    mpc = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), box, 40)
    reference, asked, x, states = np.zeros(2), [], np.array([1.4, 0.0]), []
    solves = [s for s in (mpc._constrained._hard, mpc._constrained._soft) if s is not None]
    for solve in solves:
        solve._solver = Kept(solve, asked)
    for _ in range(300):
        asked.clear()
        move = mpc(x, reference)
        states.append((x, list(asked)))
        x = plant(x, move.u)
        x[0] = np.mod(x[0] + np.pi, 2 * np.pi) - np.pi
    for solve in solves:
        solve._solver = solve._solver.solver
    mpc.reset()
    ours, theirs, iterations = [], [], []
    for x, questions in states:
        t, move = timed(mpc, x, reference)
        if not questions:
            continue
        spent = 0.0
        for other, low, high, v, y, count in questions:
            s, result = timed(bare_step, other, low, high, v, y)
            assert result.info.iter == count
            spent += s
        assert move.iterations == sum(question[-1] for question in questions)
        iterations.append(move.iterations)
        ours.append(t)
        theirs.append(spent)
    assert len(ours) > 100
    benchmark(mpc, states[1][0], reference)
    report(
        benchmark,
        **{
            "median µs": 1e6 * float(np.median(ours)),
            "bare median µs": 1e6 * float(np.median(theirs)),
            "ratio of medians": float(np.median(ours) / np.median(theirs)),
            "median of ratios": float(np.median(np.divide(ours, theirs))),
            "median iterations": float(np.median(iterations)),
        },
    )


class Lifted:
    """A lifting that costs nothing: z is there already."""

    def __init__(self, z):
        self._slot = Slot((np.zeros(2),), (z,), lambda: None, None)

    def slot(self):
        return self._slot


def controller(nz, rng):
    A = np.diag(rng.uniform(0.2, 0.9, nz)) + 0.1 / nz * rng.normal(size=(nz, nz))
    lifting = km.State() + km.Gaussian(rng.normal(size=(nz - 2, 2)), 0.5)
    B = rng.normal(size=(nz, 1))
    predictor = km.LinearPredictor(A, B, np.eye(2, nz), lifting, 0.05, ("a", "b"), ("u",))
    mpc = km.KoopmanMPC(predictor, km.Cost(1, 1, Q_N=np.eye(nz)), km.Limits(-1e6, 1e6), 40)
    mpc.observer._lift = Lifted(0.1 * rng.normal(size=nz))
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
