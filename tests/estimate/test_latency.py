"""latency=1: the input computed now acts one step later; against the optimum of the plant with its delay."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.control.models import PRECISE, Told, random_pair
from tests.estimate.plants import linear

LATE = [km.faults.ActuatorDelay(1)]
INTEGRATOR = linear(np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]]))


def pair(rng, nx, nu, limits):
    """A controller that compensates, and one on the plant with its delay as states: ξ = [x; u_{k−1}]."""
    A, B = random_pair(rng, nx, nu)
    N, Q, R, P = 8, np.ones(nx), np.full(nu, 0.3), 2 * np.eye(nx)
    mine = km.KoopmanMPC(linear(A, B), km.Cost(Q, R, Q_N=P, u_target="zero"), limits, N, latency=1, settings=PRECISE)
    delayed = linear(np.block([[A, B], [np.zeros((nu, nx + nu))]]), np.vstack([np.zeros((nx, nu)), np.eye(nu)]))
    whole = np.zeros((nx + nu, nx + nu))
    whole[:nx, :nx] = P
    cost = km.Cost(np.append(Q, np.zeros(nu)), R, Q_N=whole, u_target="zero")
    return A, B, mine, km.KoopmanMPC(delayed, cost, limits, N + 1, settings=PRECISE)


@pytest.mark.parametrize("bound", [np.inf, 0.4])
@settings(max_examples=15)
@given(nx=st.integers(1, 3), nu=st.integers(1, 2), seed=st.integers(0, 10**6))
def test_it_is_the_optimum_of_the_delayed_plant(bound, nx, nu, seed):
    rng = np.random.default_rng(seed)
    limits = km.Limits(-bound, bound)
    A, B, mine, oracle = pair(rng, nx, nu, limits)
    x, acting = rng.normal(size=nx), np.zeros(nu)
    rows = rng.normal(size=(20, nx))
    for k in range(8):
        preview = rows[k : k + 10]
        u = mine(x, preview).u
        wide = np.hstack([preview, np.zeros((len(preview), nu))])
        best = oracle(np.append(x, acting), wide).u
        np.testing.assert_allclose(u, best, atol=1e-5)
        x, acting = A @ x + B @ acting, u


def run_late(plant, mpc, x0, r, steps, limits, **options):
    """Return a run in which each input acts a step late."""
    how = km.loop.LoopOptions(faults=LATE, **options)
    return km.simulate(plant, mpc, x0=x0, reference=[r, 0], steps=steps, limits=limits, options=how)


@pytest.mark.parametrize("estimator", [None, km.LiftedDisturbance(), km.LiftedKalman(("x0", "x1"))])
def test_on_a_true_model_the_plan_is_what_happens(estimator):
    """The loop that applies u a step late meets the plan of the second step to the end."""
    model = linear(np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]]), [0.0, 0.0])
    cost, limits = km.Cost([1.0, 0.1], 0.1), km.Limits(-2, 2)
    mpc = km.KoopmanMPC(model, cost, limits, 20, latency=1, estimator=estimator, settings=PRECISE)
    run = run_late(model.step_map(), mpc, [1, 0], 0, 80, limits, plans=True)
    for k in (0, 3, 10):
        np.testing.assert_allclose(run.plans.X[k][:2], run.X[k + 1 : k + 3], atol=1e-6)
    np.testing.assert_allclose(run.X[-1], 0, atol=1e-3)
    ignorant = km.KoopmanMPC(model, cost, limits, 20)
    other = run_late(model.step_map(), ignorant, [1, 0], 0, 80, limits)
    assert _cost(run) < _cost(other)


def _cost(run):
    return (run.X**2 * [1.0, 0.1]).sum() + 0.1 * (run.U**2).sum()


def test_a_disturbance_that_is_known_is_predicted_through_too():
    A, B, d = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[0.0], [0.3]]), np.array([0.05, 0.1])
    exact = {"latency": 1, "settings": PRECISE}
    cost = km.Cost([1, 0], 0.1)
    told = km.KoopmanMPC(linear(A, B, [0.0, 0.0]), cost, horizon=15, estimator=Told(np.append(d, 0.0)), **exact)
    knowing = km.KoopmanMPC(linear(A, B, d), cost, horizon=15, **exact)
    for x in ([0.0, 0.0], [1.0, -1.0]):
        np.testing.assert_allclose(told(x, [0.7, 0]).u, knowing(x, [0.7, 0]).u, atol=1e-9)


def test_offset_free_with_latency():
    A, B = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[0.0], [0.3]])
    true = linear(A, 0.8 * B, [0.05, 0.1]).step_map()
    model = linear(A, B, [0.0, 0.0])
    for estimator in (km.LiftedDisturbance(), km.LiftedKalman(("x0", "x1"))):
        mpc = km.KoopmanMPC(model, km.Cost([1, 0], 0.1), km.Limits(-5, 5), 15, latency=1, estimator=estimator)
        run = run_late(true, mpc, [0, 0], 0.7, 150, km.Limits(-5, 5))
        assert abs(run.X[-1, 0] - 0.7) < 1e-6


def test_with_latency_changes_count_from_the_input_that_was_computed_last():
    """What acts meanwhile is an older one: to be told of it changes nothing."""
    limits = km.Limits(-1, 1, du_max=0.2)
    told, untold = (km.KoopmanMPC(INTEGRATOR, km.Cost([1.0, 0.1], 0.1), limits, 10, latency=1) for _ in range(2))
    x, acting, before, changes = np.array([3.0, 0.0]), np.zeros(1), np.zeros(1), []
    for _ in range(12):
        move = told(x, [0.0, 0.0], applied=acting)
        assert np.array_equal(move.u, untold(x, [0.0, 0.0]).u)
        assert move.status is km.Status.OPTIMAL
        changes.append(float(move.u[0] - before[0]))
        x, acting, before = INTEGRATOR.A @ x + INTEGRATOR.B @ acting, before, move.u
    assert np.abs(changes).max() < 0.2 + 1e-6
    assert changes[0] == pytest.approx(-0.2, abs=1e-4)  # the rates are active


@pytest.mark.parametrize("kind", [km.KoopmanMPC, km.BilinearMPC])
def test_a_refused_disturbance_leaves_the_inputs_that_are_on_their_way(kind):
    """The call that raised counts as none: later inputs are those of a controller that was never asked it."""
    A, B, E = INTEGRATOR.A, INTEGRATOR.B, np.array([[0.0], [0.1]])
    model = linear(A, B, E=E)
    asked, unasked = (kind(model, km.Cost([1.0, 0.1], 0.1), km.Limits(-1, 1), 10, latency=2) for _ in range(2))
    x, sent = np.array([1.0, 0.0]), [np.zeros(1)] * 2
    for k in range(8):
        if k in (2, 3):
            with pytest.raises(km.errors.ShapeError, match="w has shape"):
                asked(x, [0.0, 0.0], w=[0.1, 0.2, 0.3])
        move = asked(x, [0.0, 0.0], w=[0.1])
        assert np.array_equal(move.u, unasked(x, [0.0, 0.0], w=[0.1]).u)
        sent.append(move.u)
        x = A @ x + B @ sent.pop(0) + E @ [0.1]
