"""A watch in machine code gives the verdicts of the one in Python: with estimates, other inputs, delays, new models."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

import koopmpc as km
from koopmpc.supervise import monitor
from tests.compiler import needs_compiler

pytestmark = needs_compiler


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(20):
        X, U = np.zeros((31, 2)), rng.uniform(-1, 1, (30, 1))
        X[0] = rng.uniform(-1, 1, 2)
        for k, u in enumerate(U):
            X[k + 1] = [X[k, 0] + 0.1 * X[k, 1], 0.9 * X[k, 1] - 0.1 * np.sin(X[k, 0]) + 0.1 * u[0]]
        episodes.append(km.Episode(X=X, U=U))
    return km.Episodes(episodes, 0.1)


def verdicts(data, change, **options):
    """Return (inside, fits) of 60 steps with pushes and far states, and whether machine code gave them."""
    model = km.edmd(data, km.State() + km.Monomials(2) + km.Constant())
    mpc = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(-1, 1), 8, monitor=data, **options)
    rng, x, found = np.random.default_rng(1), np.array([0.5, 0.0]), []
    for k in range(60):
        mpc = change(mpc, k)
        applied = [0.3] if k % 7 == 3 else None
        u = mpc(x, [0, 0], applied).u if applied is None or k else mpc(x, [0, 0]).u
        found.append((mpc.watch.inside, mpc.watch.fits))
        x = np.array([x[0] + 0.1 * x[1], 0.9 * x[1] - 0.1 * np.sin(x[0]) + 0.1 * u[0]])
        x = x + rng.normal(0, 0.3 if k % 9 == 4 else 1e-4, 2) + 3.0 * (k % 13 == 12) - 3.0 * (k % 13 == 0 < k)
    return found, mpc.watch._quick is not None


def keep(mpc, k):
    return mpc


def renew(mpc, k):
    """Copy at step 20, pickle at step 30, take another model at step 40, begin anew at step 50."""
    if k == 40:
        mpc.update(replace(mpc.predictor, A=1.01 * mpc.predictor.A))
    if k == 50:
        mpc.reset()
    return {20: copy.copy, 30: lambda one: pickle.loads(pickle.dumps(one))}.get(k, lambda one: one)(mpc)


@pytest.mark.parametrize("change", [keep, renew])
@pytest.mark.parametrize("options", [{}, {"estimator": km.LiftedDisturbance()}, {"latency": 1}], ids=str)
def test_machine_code_and_python_give_the_same_verdicts(data, monkeypatch, options, change):
    quick, by_machine = verdicts(data, change, **options)
    monkeypatch.setattr(monitor, "load_look", lambda: None)
    slow, by_python = verdicts(data, change, **options)
    assert (by_machine, by_python) == (True, False)
    assert quick == slow
    assert {all(pair) for pair in quick} == {True, False}


def test_the_code_is_there_before_the_first_step(data, monkeypatch):
    model = km.edmd(data, km.State() + km.Constant())
    mpc = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(-1, 1), 8, monitor=data)
    read = pickle.loads(pickle.dumps(mpc))
    monkeypatch.setattr(monitor, "load_look", lambda: pytest.fail("a compiler would hold up a step"))
    for one in (mpc, read):
        one([0.5, 0.0], [0, 0])
        assert one.watch._quick is not None


@pytest.mark.parametrize("command", ["false", "cc '"])
def test_a_compiler_that_fails_leaves_the_watch_in_python(monkeypatch, command):
    monkeypatch.setenv("CC", command)
    monkeypatch.setattr(monitor, "find_private_cache", lambda: None)
    assert monitor.load_look.__wrapped__() is None
