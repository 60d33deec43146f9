import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.control.models import linear, step_map

A, B = np.array([[1.02, 0.1], [0.05, 1.01]]), np.array([[0.005], [0.1]])


class Recorded:
    """A controller that keeps what it gets; u = −0.3 y₀ + the last row's first entry."""

    dt, nu, horizon = 0.1, 1, 3

    def __init__(self):
        self.resets, self.calls = [], []

    def reset(self, x0=None, u_prev=None):
        self.resets.append(np.array(x0))

    def __call__(self, y, reference, applied=None):
        self.calls.append((y.copy(), np.array(reference), None if applied is None else applied.copy()))
        u = np.array([-0.3 * np.nan_to_num(y[0]) + reference[-1][0]])
        return km.Move(u, km.Status.OPTIMAL, km.control.Fallback.NONE, 1e-3, len(self.calls))


def mpc(**kwargs):
    return km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), km.Limits(-0.5, 0.5), 6, **kwargs)


def test_it_is_the_loop_one_would_write():
    plant, controller, other = step_map(A, B), mpc(), mpc()
    steps = 20
    t = np.arange(steps + 1)
    reference = np.column_stack([0.4 * np.sin(0.3 * t), 0.0 * t])
    cost, limits = km.Cost(1, 0.1), km.Limits(-0.5, 0.5)
    run = km.simulate(
        plant,
        controller,
        x0=[0.5, -0.2],
        reference=reference,
        steps=steps,
        cost=cost,
        limits=limits,
        plans=True,
    )
    x, plans = np.array([0.5, -0.2]), []
    ahead = np.vstack([reference, np.tile(reference[-1], (6, 1))])
    for k in range(steps):
        np.testing.assert_array_equal(run.X[k], x)
        np.testing.assert_array_equal(run.Y[k], x)
        move = other(x, ahead[k : k + 7])
        plans.append(other.plan())
        np.testing.assert_array_equal(run.U[k], move.u)
        assert run.status[k] is move.status
        assert run.iterations[k] == move.iterations
        x = plant(x, move.u)
    np.testing.assert_array_equal(run.X[-1], x)
    np.testing.assert_array_equal(run.plans.U, [plan.U for plan in plans])
    np.testing.assert_array_equal(run.plans.X, [plan.X for plan in plans])
    np.testing.assert_array_equal(run.reference, reference)
    np.testing.assert_allclose(run.time, 0.1 * t)
    assert (run.steps, run.dt, run.states, run.outputs) == (steps, 0.1, plant.states, plant.outputs)
    assert run.cost is cost
    assert run.limits is limits
    assert (run.solve_time > 0).all()
    assert len(set(run.status)) > 1
    again = km.simulate(plant, controller, x0=[0.5, -0.2], reference=reference, steps=steps)
    np.testing.assert_array_equal(again.U, run.U)
    assert again.plans is None


@pytest.mark.parametrize("preview", [True, False])
def test_what_the_controller_gets(preview):
    controller = Recorded()
    reference = np.arange(12.0).reshape(6, 2)
    run = km.simulate(step_map(A, B), controller, x0=[1, 2], reference=reference, steps=5, preview=preview)
    np.testing.assert_array_equal(controller.resets, [[1.0, 2.0]])
    assert len(controller.calls) == 5
    for k, (y, rows, applied) in enumerate(controller.calls):
        np.testing.assert_array_equal(y, run.Y[k])
        indices = np.minimum(np.arange(k, k + 4), 5) if preview else np.full(4, k)
        np.testing.assert_array_equal(rows, reference[indices])
        if k:
            np.testing.assert_array_equal(applied, run.U[k - 1])
        else:
            assert applied is None


def test_a_reference_that_is_held():
    one = km.simulate(step_map(A, B), mpc(), x0=[0.5, 0], reference=[0.2, 0], steps=8)
    many = km.simulate(step_map(A, B), mpc(), x0=[0.5, 0], reference=[[0.2, 0]] * 9, steps=8)
    np.testing.assert_array_equal(one.U, many.U)
    np.testing.assert_array_equal(one.reference, many.reference)


def test_noise_is_on_the_measurement_alone_and_comes_from_the_seed():
    def noisy(rng, noise):
        return km.simulate(step_map(A, B), mpc(), x0=[0.5, 0], reference=[0, 0], steps=60, noise=noise, rng=rng)

    run, same = noisy(3, [0.1, 0.0]), noisy(np.random.default_rng(3), [0.1, 0.0])
    np.testing.assert_array_equal(run.Y, same.Y)
    np.testing.assert_array_equal(run.U, same.U)
    assert (noisy(4, [0.1, 0.0]).Y != run.Y).any()
    np.testing.assert_array_equal(run.Y[:, 1], run.X[:, 1])
    assert 0.05 < (run.Y - run.X)[:, 0].std() < 0.2
    np.testing.assert_allclose(run.X[1:], run.X[:-1] @ A.T + run.U @ B.T, atol=1e-12)
    given = 0.01 * np.arange(122.0).reshape(61, 2)
    np.testing.assert_allclose((lambda r: r.Y - r.X)(noisy(0, given)), given, atol=1e-12)
    called = noisy(0, lambda k, rng: [k, -k])
    np.testing.assert_allclose((called.Y - called.X)[:, 0], np.arange(61), atol=1e-12)


@pytest.mark.parametrize("kind", ["constant", "rows", "function"])
def test_a_disturbance_is_added_to_the_next_state(kind):
    rows = 0.01 * np.arange(20.0).reshape(10, 2)
    disturbance = {"constant": [0.1, -0.2], "rows": rows, "function": lambda k, rng: rows[k]}[kind]
    expected = np.tile([0.1, -0.2], (10, 1)) if kind == "constant" else rows
    run = km.simulate(step_map(A, B), Recorded(), x0=[1, 2], reference=[0, 0], steps=10, disturbance=disturbance)
    np.testing.assert_allclose(run.X[1:] - run.X[:-1] @ A.T - run.U @ B.T, expected, atol=1e-12)


def test_the_plant_may_differ_from_the_model():
    stiff = step_map(A + 0.05, B)
    run = km.simulate(km.plants.SimulatedPlant(stiff), mpc(), x0=[0.5, 0], reference=[0, 0], steps=8)
    np.testing.assert_allclose(run.X[1:], run.X[:-1] @ (A + 0.05).T + run.U @ B.T, atol=1e-12)


def test_observers_see_each_step_once():
    seen = []
    controller = mpc()
    reference = np.column_stack([np.arange(7.0), np.zeros(7)])
    run = km.simulate(
        step_map(A, B),
        controller,
        x0=[0.5, 0],
        reference=reference,
        steps=6,
        noise=0.01,
        observers=[seen.append],
    )
    assert [step.k for step in seen] == list(range(6))
    for k, step in enumerate(seen):
        for got, row in (
            (step.x, run.X[k]),
            (step.y, run.Y[k]),
            (step.u, run.U[k]),
            (step.reference, run.reference[k]),
            (step.x_next, run.X[k + 1]),
            (step.y_next, run.Y[k + 1]),
            (step.reference_next, run.reference[k + 1]),
            (step.plan.U[0], run.U[k]),
            (step.move.u, run.U[k]),
        ):
            np.testing.assert_array_equal(got, row)
        assert step.move.status is run.status[k]


@pytest.mark.parametrize("given", [None, 0.3, [0.3], 0.1 * np.arange(6.0)[:, None]])
def test_the_inputs_that_hold_the_reference_are_kept_and_shown(given):
    seen = []
    run = km.simulate(
        step_map(A, B),
        mpc(),
        x0=[0.5, 0],
        reference=[0, 0],
        steps=6,
        u_reference=given,
        observers=[seen.append],
    )
    expected = np.broadcast_to(0.0 if given is None else given, (6, 1))
    np.testing.assert_array_equal(run.u_reference, expected)
    np.testing.assert_array_equal([step.u_reference for step in seen], expected)


class Outside:
    """A plant as hardware offers it: it hides its state, and one sensor fails for a while."""

    dt, states, inputs, outputs = 0.1, ("x0", "x1"), ("u0",), ("x0", "x1")
    state = None

    def reset(self, x0, rng):
        self.k, self.x = 0, np.array(x0, dtype=float)
        return self.x.copy()

    def step(self, u):
        self.k += 1
        self.x = A @ self.x + B @ u
        return self.x * ([np.nan, 1.0] if 3 <= self.k < 6 else [1.0, 1.0])


def test_a_sensor_that_fails_does_not_stop_the_loop():
    run = km.simulate(Outside(), mpc(), x0=[0.5, 0], reference=[0, 0], steps=12, plans=True)
    bad = [status is km.Status.BAD_MEASUREMENT for status in run.status]
    assert bad == [3 <= k < 6 for k in range(12)]
    assert [run.fallback[k] for k in (3, 4, 5)] == [km.control.Fallback.SHIFTED_PLAN] * 3
    assert np.isfinite(run.U).all()
    assert np.isnan(run.X).all()
    assert np.isnan(run.Y[3:6, 0]).all()
    assert np.isfinite(run.Y[6:]).all()
    assert np.isnan(run.plans.U[3:6]).all()
    np.testing.assert_array_equal(run.U[3:6], run.plans.U[2, 1:4])


class Says(Recorded):
    def __init__(self, u):
        super().__init__()
        self.u = np.array(u)

    def __call__(self, y, reference, applied=None):
        move = super().__call__(y, reference, applied)
        move.u = self.u
        return move


def test_messages():
    plant, ones = step_map(A, B), np.ones((5, 2))
    x = ca.SX.sym("x", 2)
    slow = km.StepMap(ca.Function("F", [x, ca.SX.sym("u", 1)], [x]), 0.2)
    two = step_map(A, np.eye(2))

    def run(plant=plant, controller=None, steps=5, reference=(0, 0), x0=(0, 0), **kwargs):
        controller = Recorded() if controller is None else controller
        km.simulate(plant, controller, x0=x0, reference=reference, steps=steps, **kwargs)

    for error, text, call in (
        (
            km.errors.DataError,
            r"the controller has dt = 0.1 s, the plant 0.2 s; use one dt for both",
            lambda: run(slow),
        ),
        (km.errors.ShapeError, r"the controller returns 1 inputs, the plant takes 2", lambda: run(two)),
        (km.errors.DataError, r"steps is 0; it must be at least 1", lambda: run(steps=0)),
        (km.errors.ShapeError, r"x0 has shape \(3,\), expected \(2,\)", lambda: run(x0=[0, 0, 0])),
        (
            km.errors.ShapeError,
            r"reference has shape \(5, 2\), expected \(nr,\) or \(steps\+1, nr\) = \(6, nr\)",
            lambda: run(reference=ones),
        ),
        (km.errors.DataError, r"reference holds 1 NaN or inf", lambda: run(reference=[0, np.nan])),
        (
            km.errors.ShapeError,
            r"reference has 2 columns, the cost tracks 3 outputs; pass one a column",
            lambda: run(cost=km.Cost(1, 1, of=km.State() + km.Constant())),
        ),
        (km.errors.DataError, r"angles holds 2; pass indices of states, 0 to 1", lambda: run(angles=[2])),
        (
            km.errors.ShapeError,
            r"disturbance has shape \(3,\), expected \(2,\) or a scalar",
            lambda: run(disturbance=[1, 1, 1]),
        ),
        (
            km.errors.ShapeError,
            r"disturbance has shape \(6, 2\), expected \(5, 2\)",
            lambda: run(disturbance=np.ones((6, 2))),
        ),
        (
            km.errors.ShapeError,
            r"disturbance has shape \(3,\), expected \(2,\)",
            lambda: run(disturbance=lambda k, r: ones[:3, 0]),
        ),
        (
            km.errors.ShapeError,
            r"u_reference has shape \(6, 1\), expected \(5, 1\)",
            lambda: run(u_reference=np.ones((6, 1))),
        ),
        (
            km.errors.ShapeError,
            r"u_reference has shape \(2,\), expected \(1,\)",
            lambda: run(u_reference=[1.0, 2.0]),
        ),
        (km.errors.ShapeError, r"noise has shape \(3,\), expected \(2,\) or a scalar", lambda: run(noise=[1, 1, 1])),
        (km.errors.ShapeError, r"noise has shape \(5, 2\), expected \(6, 2\)", lambda: run(noise=ones)),
        (
            km.errors.DataError,
            r"a disturbance is added to the next state: pass a StepMap or a SimulatedPlant",
            lambda: run(Outside(), disturbance=0.1),
        ),
        (
            km.errors.DataError,
            r"the controller returned u = \[nan\] at step 0; every input must be finite",
            lambda: run(controller=Says([np.nan])),
        ),
        (
            km.errors.ShapeError,
            r"the controller returned u of shape \(2,\) at step 0, expected \(1,\)",
            lambda: run(controller=Says([1.0, 2.0])),
        ),
    ):
        with pytest.raises(error, match=text):
            call()
