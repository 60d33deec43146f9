"""`simulate` of a compiled controller on a StepMap runs in C, and returns the run that Python returns."""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.gathered import of_loop

COST = km.Cost(Q=[10.0, 1.0], R=0.1)
LIMITS = km.Limits(u_min=-25.0, u_max=25.0, x_max=[0.6, 0.4])


@pytest.fixture(scope="module")
def controllers(pendulum):
    controller = km.KoopmanMPC(pendulum[1], COST, LIMITS, 15, solver="daqp")
    return controller, km.compiled(controller)


@pytest.mark.parametrize("preview", [True, False])
def test_a_run_in_c_is_that_of_python(pendulum, controllers, preview):
    plant = pendulum[0]
    phase = 0.05 * np.arange(121)
    reference = np.column_stack([0.5 * np.sin(phase), np.zeros(121)])
    first, second = (
        km.simulate(
            plant,
            one,
            x0=[0.8, 0.0],
            reference=reference,
            steps=120,
            cost=COST,
            options=km.loop.LoopOptions(preview=preview),
        )
        for one in controllers
    )
    np.testing.assert_allclose(second.X, first.X, atol=1e-6)
    np.testing.assert_allclose(second.U, first.U, atol=1e-4)
    assert second.status == first.status
    assert second.fallback == first.fallback
    assert second.iterations.tolist() == first.iterations.tolist()
    np.testing.assert_allclose(second.slack, first.slack, atol=1e-5)
    assert abs(km.metrics(second).cost / km.metrics(first).cost - 1) < 1e-6
    assert (second.solve_time > 0).all()


def test_what_needs_python_between_two_steps_gets_it(pendulum, controllers):
    plant, seen = pendulum[0], []
    fast = controllers[1]
    run = km.simulate(plant, fast, x0=[0.8, 0.0], reference=[0.0, 0.0], steps=5, observers=[seen.append])
    assert len(seen) == 5
    again = km.simulate(plant, fast, x0=[0.8, 0.0], reference=[0.0, 0.0], steps=5)
    np.testing.assert_allclose(again.X, run.X, atol=1e-12)
    noisy = km.simulate(
        plant, fast, x0=[0.8, 0.0], reference=[0.0, 0.0], steps=5, options=km.loop.LoopOptions(noise=[0.1, 0.1])
    )
    assert not np.array_equal(noisy.Y, run.Y)


@pytest.mark.parametrize(
    "signal",
    [
        {"noise": [0.02, 0.02]},
        {"disturbance": [0.0, 0.05]},
        {"faults": [km.faults.FrozenSensor()]},
    ],
    ids=lambda signal: next(iter(signal)),
)
def test_what_disturbs_a_run_disturbs_that_of_a_compiled_controller_as_much(pendulum, controllers, signal):
    told = {"x0": [0.3, 0.0], "reference": [0.0, 0.0], "steps": 8}
    slow, fast = (km.simulate(pendulum[0], one, **told, **of_loop(**signal, rng=0)) for one in controllers)
    np.testing.assert_allclose(fast.Y, slow.Y, atol=1e-6)
    assert np.abs(fast.Y - km.simulate(pendulum[0], controllers[1], **told).Y).max() > 1e-3


def test_a_run_in_c_is_told_disturbances_that_the_plant_does_not_know():
    model = km.LinearPredictor([[0.9]], [[0.2]], [[1.0]], km.State(), 0.05, ["x"], ["u"], E=[[0.5]])
    x, u = ca.MX.sym("x"), ca.MX.sym("u")
    plant = km.StepMap(ca.Function("F", [x, u], [0.9 * x + 0.2 * u]), 0.05)
    mpc = km.KoopmanMPC(model, km.Cost(Q=1.0, R=0.1), km.Limits(-1, 1), 5)
    told = {"x0": [0.5], "reference": [0.0], "steps": 6}
    runs = [
        km.simulate(plant, one, **told, measured=W)
        for one in (mpc, km.compiled(mpc))
        for W in (np.zeros((6, 1)), np.linspace(0.1, 0.6, 6)[:, None])
    ]
    np.testing.assert_allclose(runs[2].U, runs[0].U, atol=1e-6)
    np.testing.assert_allclose(runs[3].U, runs[1].U, atol=1e-6)
    assert np.abs(runs[3].U - runs[2].U).max() > 0.1


def test_a_plant_that_cannot_be_written_in_c_is_driven_from_python(controllers):
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    jump = ca.Function("jump", [x, u], [ca.if_else(x[0] > 0, x, x + 0.05 * ca.vertcat(x[1], u), False)])
    callback = km.StepMap(ca.Function("F", [x, u], [jump(x, u)]), 0.05)
    run = km.simulate(callback, controllers[1], x0=[-0.3, 0.0], reference=[0.0, 0.0], steps=10)
    other = km.simulate(callback, controllers[0], x0=[-0.3, 0.0], reference=[0.0, 0.0], steps=10)
    np.testing.assert_allclose(run.X, other.X, atol=1e-6)


def test_many_runs_leave_nothing_behind_in_each_other(pendulum, controllers):
    plant, fast = pendulum[0], controllers[1]
    starts = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    rows = [km.simulate(plant, fast, x0=x, reference=[0.0, 0.0], steps=30).X for x in starts]
    for x, row in zip(starts[::-1], rows[::-1], strict=True):
        assert np.array_equal(km.simulate(plant, fast, x0=x, reference=[0.0, 0.0], steps=30).X, row)


def test_runs_side_by_side_are_those_of_simulate(pendulum, controllers):
    plant, (slow, fast) = pendulum[0], controllers
    starts = np.random.default_rng(1).uniform(-0.8, 0.8, (5, 2))
    found = fast.runs(plant, starts, [0.1, 0.0], steps=40)
    for i, x in enumerate(starts):
        run = km.simulate(plant, slow, x0=x, reference=[0.1, 0.0], steps=40)
        np.testing.assert_allclose(found.X[i], run.X, atol=1e-6)
        np.testing.assert_allclose(found.U[i], run.U, atol=1e-4)
        assert found.status[i].tolist() == [status.value for status in run.status]
    with pytest.raises(km.errors.ShapeError, match=r"reference has shape \(1, 3\)"):
        fast.runs(plant, starts, [0.1, 0.0, 0.0], steps=40)
