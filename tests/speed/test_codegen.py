"""Controllers in C: a step, beside Python's step and DAQP's own solve; whole runs; many observables; a build.

All figures are CPU time of this process, in turns of what is compared, so that other work on the machine weighs alike.
"""

import time

import casadi as ca
import daqp
import numpy as np
import pytest
from scipy.signal import cont2discrete

import koopmpc as km
from tests.speed.test_control import CHAIN, model, pendulum, report, timed

__all__ = ["model"]
pytestmark = pytest.mark.speed


def cpu(call, *arguments, count=500):
    """Return the median CPU time of a call [s], of eleven rows of calls."""
    rows = []
    for _ in range(11):
        start = time.process_time()
        for _ in range(count):
            call(*arguments)
        rows.append((time.process_time() - start) / count)
    return float(np.median(rows))


def test_c_step_with_nothing_active(benchmark, model):
    slow = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(-25, 25), 40, solver="daqp")
    spent, fast = timed(km.compiled, slow)
    x, reference = np.array([0.01, 0.02]), np.zeros(2)
    assert fast(x, reference).status is km.Status.UNCONSTRAINED
    benchmark(fast, x, reference)
    ours, theirs = cpu(fast, x, reference), cpu(slow, x, reference)
    plant, steps = pendulum(), 20_000
    X, U = np.zeros((steps + 1, 2)), np.zeros((steps, 1))
    X[0] = 0.01
    found = fast.whole_run(plant, np.zeros((steps + 41, 2)), None, X, X, U, preview=True)
    empty = cpu(time.perf_counter)
    report(
        benchmark,
        **{
            "C step, with its clock µs": float(np.median(found["solve_time"])) * 1e6,
            "from Python µs": ours * 1e6,
            "Python's step µs": theirs * 1e6,
            "a look at the clock µs": empty * 1e6,
            "built in s": spent,
        },
    )


def test_c_step_with_limits_active_against_daqp(benchmark):
    """The chain of 20 inputs and 20 hard rows more: a whole step from Python, beside the time that DAQP says it takes."""
    B, end = np.array([[0.0], [0.05], [0.1], [0.1]]), np.array([6.0, np.inf, np.inf, np.inf])
    chain = km.LinearPredictor(CHAIN, B, np.eye(4), km.State(), 0.1, tuple("abcd"), ("u",))
    slow = km.KoopmanMPC(
        chain, km.Cost(np.ones(4), 0.1), km.Limits(-1, 1, x_min=-end, x_max=end, slack=None), 20, solver="daqp"
    )
    fast, rng, states = km.compiled(slow), np.random.default_rng(0), []
    for _ in range(12):
        x = rng.normal(size=4) * [2, 0.5, 0.5, 0.5]
        for _ in range(40):
            states.append(x)
            x = CHAIN @ x + B @ slow(x, np.zeros(4)).u
    qp = slow._step.solver.qps.qp
    bare = daqp.Model()
    bare.setup(qp.P, qp.q, qp.A, np.minimum(qp.high, 1e30), np.maximum(qp.low, -1e30))
    rows, zero = [], np.zeros(4)
    for _ in range(7):
        slow.reset()
        fast.reset()
        for x in states:
            theirs, move = timed(slow, x, zero)
            ours, other = timed(fast, x, zero)
            assert move.status is other.status
            if move.status is not km.Status.OPTIMAL:
                continue
            by = slow._step.solver.qps._moved
            start = time.perf_counter()
            bare.update(bupper=np.minimum(qp.high - by, 1e30), blower=np.maximum(qp.low - by, -1e30))
            info = bare.solve()[3]
            spent = time.perf_counter() - start
            rows.append((ours, theirs, spent, info["solve_time"]))
    ours, theirs, called, solved = np.median(np.array(rows), axis=0) * 1e6
    benchmark(fast, states[0], zero)
    report(
        benchmark,
        **{
            "from Python µs": ours,
            "Python's step µs": theirs,
            "DAQP called from Python µs": called,
            "DAQP's own time µs": solved,
            "to DAQP called": ours / called,
            "to DAQP's own time": ours / solved,
        },
    )


def cart_pole():
    """Return the linear cart-pole of LinearMPC.jl's benchmark of generated C (docs/src/manual/benchmark.md)."""
    A = np.array([[0, 1, 0, 0], [0, -10, 9.81, 0], [0, 0, 0, 1], [0, -20, 39.24, 0]])
    A, B, *_ = cont2discrete((A, 100 * np.array([[0], [1], [0], [2.0]]), np.eye(4), np.zeros((4, 1))), 0.01)
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 1)
    names = ("p", "v", "theta", "omega")
    plant = km.StepMap(ca.Function("F", [x, u], [ca.DM(A) @ x + ca.DM(B) @ u]), 0.01, states=names, inputs=("u",))
    return km.LinearPredictor(A, B, np.eye(4), km.State(), 0.01, names, ("u",)), plant


class TimedSolver:
    """DAQP's model, which sums the seconds that DAQP says its solves take."""

    def __init__(self, model):
        self.model, self.seconds, self.iterations = model, 0.0, 0

    def __getattr__(self, name):
        return getattr(self.model, name)

    def solve(self, *arguments, **options):
        answer = self.model.solve(*arguments, **options)
        self.seconds += answer[3]["solve_time"]
        self.iterations += answer[3]["iterations"]
        return answer


@pytest.mark.parametrize("N", [50, 75, 100, 125])
def test_c_steps_of_the_cart_pole_of_other_generators(benchmark, N):
    """Weights, limits and references of the published table; beside it the time of DAQP alone on the same QPs."""
    model, plant = cart_pole()
    cost, end = km.Cost(Q=[1.44, 0, 1, 0], R=0.0, R_delta=0.01, tail=0), np.array([np.inf, np.inf, 0.3, np.inf])
    slow = km.KoopmanMPC(model, cost, km.Limits(-2, 2, x_min=-end, x_max=end, slack=(0.0, 1e3)), N)
    fast, steps = km.compiled(slow), 500
    rows = np.zeros((steps + 1 + N, 4))
    rows[:, 0] = np.where(np.arange(len(rows)) < 250, 1.0, -0.5)
    X, U, ours, alone = np.zeros((steps + 1, 4)), np.zeros((steps, 1)), [], []
    X[0, 2] = 0.2
    solver = slow._step.solver.qps.first
    solver._model = TimedSolver(solver._model)
    for _ in range(5):
        fast.reset()
        slow.reset()
        ours.append(np.array(fast.whole_run(plant, rows, None, X, X, U, preview=False)["solve_time"]))
        spent = [0.0]
        for x, row in zip(X, rows[:steps], strict=False):
            slow(x, row)
            spent.append(solver._model.seconds)
        solver._model.seconds = 0.0
        alone.append(np.diff(spent))
    ours, alone = np.min(ours, axis=0), np.min(alone, axis=0)
    limited, slowest = alone > 0, steps // 5
    benchmark(fast, X[0], rows[0])
    report(
        benchmark,
        **{
            "median µs": float(np.median(ours)) * 1e6,
            "mean of the slowest fifth µs": float(np.sort(ours)[-slowest:].mean()) * 1e6,
            "steps with a QP": int(limited.sum()),
            "these to DAQP's own time": float(ours[limited].sum() / alone[limited].sum()),
        },
    )


def test_cold_steps(benchmark, model):
    """A step after 4 ms of sleep over the same step at once, in C and in Python, and after a rehearsal.

    Beside it the floor: what a call of a function that does nothing costs cold.
    """
    slow = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(-25, 25), 40, solver="daqp")
    fast, x, reference, figures = km.compiled(slow), np.array([0.01, 0.02]), np.zeros(2), {}
    ways = {"nothing": lambda x, reference: None, "C": fast, "C, rehearsed": fast, "Python": slow}
    spent = {name: ([], []) for name in ways}
    for _ in range(300):
        for name, one in ways.items():
            time.sleep(0.004)
            if name == "C, rehearsed":
                fast.rehearse()
            spent[name][0].append(timed(one, x, reference)[0])
            for _ in range(20):
                last = timed(one, x, reference)[0]
            spent[name][1].append(last)
    for name, (cold, hot) in spent.items():
        figures[f"{name} cold to hot"] = float(np.median(cold) / np.median(hot))
        figures[f"{name} cold µs"] = float(np.median(cold)) * 1e6
    benchmark(fast, x, reference)
    report(benchmark, **figures)


def test_c_step_of_a_thousand_observables(benchmark):
    """A free step of 1000 Gaussians and N = 40, beside numpy's own lifting of one state and product."""
    rng = np.random.default_rng(0)
    lifting = (km.State() + km.Gaussian(rng.uniform(-2, 2, (998, 2)), 1.0)).bind(("a", "b"))
    A, B = np.diag(np.append([0.9, 0.95], np.full(998, 0.5))), np.zeros((1000, 1))
    B[:2, 0] = 0.1, 0.2
    big = km.LinearPredictor(A, B, np.eye(2, 1000), lifting, 0.05, ("a", "b"), ("u",))
    slow = km.KoopmanMPC(big, km.Cost([1.0, 1.0], 0.1), km.Limits(-9, 9), 40, solver="daqp")
    spent, fast = timed(km.compiled, slow)
    x, zero, matrix = np.array([0.1, 0.2]), np.zeros(2), slow._map.matrix[:, :1000].copy()

    def by_numpy():
        return matrix @ lifting(x)

    assert fast(x, zero).status is km.Status.UNCONSTRAINED
    benchmark(fast, x, zero)
    pairs = [(cpu(fast, x, zero, count=50), cpu(by_numpy, count=50), cpu(slow, x, zero, count=50)) for _ in range(5)]
    ours, theirs, python = np.median(np.array(pairs), axis=0) * 1e6
    report(
        benchmark,
        **{
            "from Python µs": ours,
            "numpy µs": theirs,
            "Python's step µs": python,
            "to numpy": ours / theirs,
            "built in s": spent,
        },
    )


def test_a_thousand_runs(benchmark, model):
    """1000 runs of 200 steps: in one call of C, by simulate with the controller in C, and by simulate in Python."""
    plant, cost = pendulum(), km.Cost(Q=[10, 1], R=0.1)
    slow = km.KoopmanMPC(model, cost, km.Limits(-25, 25), 40, solver="daqp")
    fast, starts = km.compiled(slow), np.random.default_rng(0).uniform(-0.5, 0.5, (1000, 2))

    def by(one, count):
        start = time.process_time()
        for x in starts[:count]:
            km.simulate(plant, one, x0=x, reference=[0.0, 0.0], steps=200)
        return (time.process_time() - start) / count

    def at_once():
        start = time.process_time()
        fast.runs(plant, starts, [0.0, 0.0], steps=200)
        return (time.process_time() - start) / len(starts)

    by(fast, 2)
    benchmark(fast.runs, plant, starts[:10], [0.0, 0.0], steps=200)
    rows = np.array([(at_once(), by(fast, 100), by(slow, 20)) for _ in range(5)])
    one, hooked, python = np.median(rows, axis=0) * 1e6
    report(
        benchmark,
        **{
            "run µs": one,
            "simulate in C µs": hooked,
            "simulate µs": python,
            "ratio": python / one,
            "simulate's ratio": python / hooked,
        },
    )


def test_c_bilinear_step_against_python(benchmark):
    """The swing-up of the cart-pole from hanging: all its steps in C and in Python, in turns; the model is the plant."""
    problem = km.load_problem("cart_pole_swing")
    plant = km.discretize(problem.dynamics, problem.dt)
    data = km.collect(plant, problem.training.x0, problem.training.excitation, episodes=2000, steps=10, rng=0)
    slow = km.BilinearMPC(
        km.bilinear_edmd(data, problem.lifting, difference=True), problem.cost, problem.limits, problem.horizon
    )
    spent, fast = timed(km.compiled, slow)
    case = problem.cases["hang"]
    run = km.simulate(plant, slow, x0=case.x0, reference=case.reference, steps=case.steps)
    rows = {slow: [], fast: []}
    for _ in range(5):
        for one, found in rows.items():
            one.reset()
            start = time.process_time()
            for x in run.X[:-1]:
                one(x, case.reference)
            found.append(time.process_time() - start)
    theirs, ours = (float(np.median(found)) / case.steps for found in rows.values())
    free = {one: cpu(one, run.X[-1], case.reference, count=50) for one in rows}
    benchmark(fast, run.X[-1], case.reference)
    report(
        benchmark,
        **{
            "a step of the swing-up in C µs": ours * 1e6,
            "in Python µs": theirs * 1e6,
            "Python to C": theirs / ours,
            "free step in C µs": free[fast] * 1e6,
            "free step, Python to C": free[slow] / free[fast],
            "built in s": spent,
        },
    )


def test_c_step_of_a_linear_mpc_beside_tinympc(benchmark):
    """TinyMPC's own cart-pole, ±0.45 N, 0.5 m off, N = 60: closed-loop cost of 400 steps and CPU time of a step in both."""
    tinympc = pytest.importorskip("tinympc")
    A = np.array([[1.0, 0.01, 0, 0], [0, 1.0, 0.039, 0], [0, 0, 1.002, 0.01], [0, 0, 0.458, 1.002]])
    B, Q, R = np.array([[0.0], [0.02], [0.0], [0.067]]), np.array([10.0, 1.0, 10.0, 1.0]), np.array([1.0])
    model = km.LinearPredictor(A, B, np.eye(4), km.State(), 0.01, tuple("abcd"), ("u",))
    ours = km.compiled(km.KoopmanMPC(model, km.Cost(Q, R), km.Limits(-0.45, 0.45), 60, solver="daqp"))
    theirs = tinympc.TinyMPC()
    theirs.setup(A, B, np.diag(Q), np.diag(R), 61, rho=1.0, verbose=False, max_iter=100)
    theirs.set_bound_constraints(
        np.full((4, 61), -1e17), np.full((4, 61), 1e17), np.full((1, 60), -0.45), np.full((1, 60), 0.45)
    )

    def asked(x):
        theirs.set_x0(x)
        return np.atleast_1d(theirs.solve()["controls"])

    figures, zero = {}, np.zeros(4)
    for name, law in (("C", lambda x: ours(x, zero).u), ("TinyMPC", asked)):
        x, cost, spent = np.array([0.5, 0.0, 0.0, 0.0]), 0.0, []
        for _ in range(400):
            start = time.process_time()
            u = np.clip(law(x), -0.45, 0.45)
            spent.append(time.process_time() - start)
            cost += float(Q @ x**2 + R @ u**2)
            x = A @ x + B @ u
        figures |= {
            f"{name} cost": cost,
            f"{name} mean µs": 1e6 * float(np.mean(spent)),
            f"{name} worst µs": 1e6 * max(spent),
        }
    benchmark(ours, zero, zero)
    report(benchmark, **figures)
