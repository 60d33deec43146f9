"""A reference that moves: the plan is the one that is computed afresh, whatever was computed before."""

import copy
import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.control.models import linear

A, B = np.array([[1.0, 0.1], [0.15, 0.98]]), np.array([[0.005], [0.1]])
N = 12
COSTS = {
    "equilibria as targets": km.Cost([1, 0.1], 0.1),
    "no target": km.Cost([1, 0.1], 0.1, u_target="zero"),
    "given targets": km.Cost([1, 0.1], 0.1, u_target=0.3 * np.sin(np.arange(25.0))[:, None]),
    "rates": km.Cost([1, 0.1], 0.1, R_delta=0.4),
}
LIMITS = {"wide": km.Limits(-50, 50), "narrow": km.Limits(-1, 1, x_min=[-0.5, -5], x_max=[0.5, 5])}


def preview(kind, k):
    rows = 0.6 * np.sin(0.3 * (k + np.arange(N + 2)))[:, None] * [1.0, 0.0]
    return {"rows": rows, "few rows": rows[:3], "many rows": np.vstack([rows, rows]), "one row": rows[0]}[kind]


def test_a_moving_reference_that_is_not_finite_ends_in_bad_measurement():
    mpc = km.KoopmanMPC(linear(A, B), COSTS["no target"], LIMITS["wide"], N)
    rows = preview("rows", 0)
    assert mpc([0, 0], rows).status is km.Status.UNCONSTRAINED
    for bad in (np.nan, np.inf, 1e31, 1e308):
        rows = rows.copy()
        rows[3, 0] = bad
        assert mpc([0, 0], rows).status is km.Status.BAD_MEASUREMENT
        rows[3, 0] = 0.0
        assert mpc([0, 0], rows).status is km.Status.UNCONSTRAINED


@pytest.mark.parametrize("kind", ["one row", "rows"])
def test_a_reference_that_stays_not_finite_ends_in_bad_measurement_under_limits_in_time(kind):
    limits = km.Limits(-2 - np.arange(30.0)[:, None] / 9, 2 + np.arange(30.0)[:, None] / 9)
    good, bad = preview(kind, 0), np.array(preview(kind, 0))
    bad[..., 0] = np.nan
    mpc, alone = (km.KoopmanMPC(linear(A, B), COSTS["equilibria as targets"], limits, N) for _ in range(2))
    for reference in (bad, bad, good, bad, bad, bad, good):
        move, other = mpc([0.1, 0], reference), alone([0.1, 0], good)
        assert move.status is (km.Status.BAD_MEASUREMENT if reference is bad else other.status)
    np.testing.assert_allclose(move.u, other.u, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["one row", "rows"])
def test_a_reference_that_is_refused_leaves_the_last_one_as_it_was(kind):
    mpc, fresh = (km.KoopmanMPC(linear(A, B), COSTS["no target"], LIMITS["wide"], N) for _ in range(2))
    last = preview(kind, 3)[: N + 1] if kind == "rows" else preview(kind, 3)
    mpc([0, 0], preview("one row", 1))
    mpc([0, 0], last)
    for refused in (np.zeros(3), np.zeros((4, 3))):
        with pytest.raises(km.errors.ShapeError, match="reference has shape"):
            mpc([0, 0], refused)
        np.testing.assert_allclose(mpc([0, 0], last).u, fresh([0, 0], last).u, rtol=0, atol=1e-12)


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    cost=st.sampled_from(list(COSTS)),
    rows=st.sampled_from([1, 3, N + 1, N + 2]),
    in_time=st.booleans(),
    narrow=st.booleans(),
    latency=st.integers(0, 1),
)
def test_a_plan_on_the_way_is_the_one_that_is_computed_afresh(seed, cost, rows, in_time, narrow, latency):
    """The first call after a reset reads its reference part by part: later calls have the same plan, to 1e-9."""
    rng, room = np.random.default_rng(seed), 0.6 if narrow else 50.0
    model, base = linear(A, B), COSTS[cost]
    steps = 4
    signal = rng.uniform(0.1, 1.0) * np.cumsum(rng.normal(size=(steps + N + 2, 2)), axis=0) * [0.2, 0.0]
    ends = room * (1 + 0.2 * rng.random((steps + N + 2, 1))) if in_time else room

    def build(k):
        targets = base.u_target
        own = base if np.ndim(targets) < 2 else replace(base, u_target=np.asarray(targets)[k:])
        later = ends[k:] if in_time else ends
        return km.KoopmanMPC(model, own, km.Limits(-later, later, x_min=[-2, -9], x_max=[2, 9]), N, latency=latency)

    mpc, x, last = build(0), rng.normal(size=2) * 0.3, np.zeros(1)
    for k in range(steps):
        reference = signal[k] if rows == 1 else signal[k : k + rows]
        fresh = build(k)
        fresh.reset(u_prev=last)
        move, other = mpc(x, reference), fresh(x, reference)
        assert move.status is other.status
        size = 1 + np.abs(other.u).max()
        np.testing.assert_allclose(move.u, other.u, rtol=0, atol=1e-9 * size)
        if fresh.plan() is not None:
            np.testing.assert_allclose(mpc.plan().U, fresh.plan().U, rtol=0, atol=1e-9 * size)
        last, x = move.u, A @ x + B @ (last if latency else move.u)


@pytest.mark.parametrize("duplicate", [copy.copy, lambda mpc: pickle.loads(pickle.dumps(mpc))])
@pytest.mark.parametrize("rows", [1, N + 1])
def test_steps_of_a_copy_and_of_its_original_do_not_meet(duplicate, rows):
    """Both read where a step starts and its reference from one array: each needs one of its own."""
    signal = 0.2 * np.sin(0.3 * np.arange(N + 8))[:, None] * [1.0, 0.0]
    references = [signal[k] if rows == 1 else signal[k : k + rows] for k in range(6)]
    alone, mpc = (km.KoopmanMPC(linear(A, B), COSTS["no target"], LIMITS["wide"], N) for _ in range(2))
    for k in range(3):
        alone([0.1, 0.0], references[k])
        mpc([0.1, 0.0], references[k])
    twin = duplicate(mpc)
    for k in range(3, 6):
        expected = alone([0.1 * k, 0.0], references[k])
        mpc([-5.0, 3.0], references[k - 3])
        move = twin([0.1 * k, 0.0], references[k])
        np.testing.assert_array_equal(move.u, expected.u)
        mpc([7.0, 1.0], references[k - 2])
        np.testing.assert_array_equal(twin.plan().X, alone.plan().X)


def test_what_noise_looks_like_to_an_estimator_sends_no_target_far_away():
    """A disturbed target may be out of the inputs' reach: where it meets their limits, the row's own target stays."""

    def plant(x, u):
        return np.array([x[0] + 0.2 * x[1], 0.9 * x[1] + 0.3 * u[0] - 0.1 * np.sin(x[0])])

    rng, runs = np.random.default_rng(0), []
    for _ in range(12):
        X, U = [rng.uniform(-1, 1, 2)], rng.uniform(-1, 1, (40, 1))
        for u in U:
            X.append(plant(X[-1], u))
        runs.append(km.Episode(X=np.array(X), U=U))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)  # of a delay, one column follows from the others
        model = km.bilinear_edmd(km.Episodes(runs, 0.1), km.State() + km.Constant(), embedding=km.Delay(1), ridge=1e-6)
    weights, limits = np.array([1, 0.1]), km.Limits(u_min=-1, u_max=1, x_max=[np.inf, 0.4])
    rows = np.column_stack([0.3 * np.sin(np.arange(70) / 5), np.zeros(70)])
    spent = []
    for estimator in (None, km.LiftedDisturbance()):
        mpc = km.BilinearMPC(model, km.Cost(Q=weights, R=0.1), limits, 8, estimator=estimator)
        noise, x, total = np.random.default_rng(1), np.zeros(2), 0.0
        mpc.reset(x)
        for k in range(60):
            u = mpc(x + noise.normal(size=2) * [0.01, 0.02], rows[k : k + 9]).u
            total += float(weights @ (x - rows[k]) ** 2 + 0.1 * u @ u)
            x = plant(x, u)
        spent.append(total)
    assert spent[1] < 2 * spent[0]
