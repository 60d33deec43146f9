"""Controllers in C: a step, beside Python's step and DAQP's own solve; whole runs; many observables; a build.

All figures are CPU time of this process, in turns of what is compared, so that other work on the machine weighs alike.
"""

import time

import daqp
import numpy as np
import pytest

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
    x, zero, matrix = np.array([0.1, 0.2]), np.zeros(2), slow.build_program(None).M[:, :1000].copy()

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
