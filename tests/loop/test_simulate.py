import numpy as np
import pytest

import koopmpc as km
from tests.control.models import linear, step_map
from tests.gathered import of_loop

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


def run_map(controller, steps, reference=(0, 0), x0=(0.5, 0), **options):
    """Return a run on the map of A and B."""
    return km.simulate(step_map(A, B), controller, x0=x0, reference=reference, steps=steps, **of_loop(**options))


def test_simulate_is_the_loop_that_one_would_write():
    plant, controller, other = step_map(A, B), mpc(), mpc()
    steps = 20
    t = np.arange(steps + 1)
    reference = np.column_stack([0.4 * np.sin(0.3 * t), 0.0 * t])
    cost, limits = km.Cost(1, 0.1), km.Limits(-0.5, 0.5)
    run = run_map(controller, steps, reference, [0.5, -0.2], cost=cost, limits=limits, plans=True)
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
def test_the_controller_gets_the_references_ahead_and_what_was_applied(preview):
    controller = Recorded()
    reference = np.arange(12.0).reshape(6, 2)
    run = run_map(controller, 5, reference, [1, 2], preview=preview)
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


def test_rows_behind_the_run_are_seen_ahead_and_never_reached():
    reference = np.arange(18.0).reshape(9, 2)  # 5 steps, and 3 rows behind them
    controller = Recorded()
    run = km.simulate(step_map(A, B), controller, x0=[1, 2], reference=reference, steps=5)
    np.testing.assert_array_equal(run.reference, reference[:6])
    for k, (_, ahead, _) in enumerate(controller.calls):
        np.testing.assert_array_equal(ahead, reference[k : k + 4])
    with pytest.raises(km.errors.ShapeError, match="expected"):
        km.simulate(step_map(A, B), controller, x0=[1, 2], reference=reference[:8], steps=5)


def test_one_reference_is_held_throughout():
    one = km.simulate(step_map(A, B), mpc(), x0=[0.5, 0], reference=[0.2, 0], steps=8)
    many = km.simulate(step_map(A, B), mpc(), x0=[0.5, 0], reference=[[0.2, 0]] * 9, steps=8)
    np.testing.assert_array_equal(one.U, many.U)
    np.testing.assert_array_equal(one.reference, many.reference)


def test_noise_is_on_the_measurement_alone_and_comes_from_the_seed():
    def noisy(rng, noise):
        return run_map(mpc(), 60, noise=noise, rng=rng)

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
    run = run_map(Recorded(), 10, x0=[1, 2], disturbance=disturbance)
    np.testing.assert_allclose(run.X[1:] - run.X[:-1] @ A.T - run.U @ B.T, expected, atol=1e-12)


def test_the_plant_may_differ_from_the_model():
    stiff = step_map(A + 0.05, B)
    run = km.simulate(km.plants.SimulatedPlant(stiff), mpc(), x0=[0.5, 0], reference=[0, 0], steps=8)
    np.testing.assert_allclose(run.X[1:], run.X[:-1] @ (A + 0.05).T + run.U @ B.T, atol=1e-12)


def test_observers_see_each_step_once():
    seen = []
    reference = np.column_stack([np.arange(7.0), np.zeros(7)])
    run = run_map(mpc(), 6, reference, noise=0.01, observers=[lambda step: seen.append((step, step.plan))])
    assert [step.k for step, _ in seen] == list(range(6))
    for k, (step, plan) in enumerate(seen):
        for got, row in (
            (step.x, run.X[k]),
            (step.y, run.Y[k]),
            (step.u, run.U[k]),
            (step.reference, run.reference[k]),
            (step.x_next, run.X[k + 1]),
            (step.y_next, run.Y[k + 1]),
            (step.reference_next, run.reference[k + 1]),
            (plan.U[0], run.U[k]),
            (step.move.u, run.U[k]),
        ):
            np.testing.assert_array_equal(got, row)
        assert step.move.status is run.status[k]


@pytest.mark.parametrize("given", [None, 0.3, [0.3], 0.1 * np.arange(6.0)[:, None]])
def test_the_inputs_that_hold_the_reference_are_kept_and_shown(given):
    seen = []
    run = run_map(mpc(), 6, u_reference=given, observers=[seen.append])
    expected = np.broadcast_to(0.0 if given is None else given, (6, 1))
    np.testing.assert_array_equal(run.u_reference, expected)
    np.testing.assert_array_equal([step.u_reference for step in seen], expected)


class Counted(km.KoopmanMPC):
    """A controller that counts how often its plan is asked for."""

    asked = 0

    def plan(self):
        self.asked += 1
        return super().plan()


def test_a_plan_is_found_where_somebody_asks_for_it():
    loop = {"x0": [0.5, 0], "reference": [0, 0], "steps": 6}
    controller = Counted(linear(A, B), km.Cost(1, 0.1), km.Limits(-0.5, 0.5), 6)
    km.simulate(step_map(A, B), controller, **loop, observers=[lambda step: None])
    assert controller.asked == 0
    km.simulate(step_map(A, B), controller, **loop, observers=[lambda step: step.plan if step.k == 3 else None])
    assert controller.asked == 1
    run = km.simulate(
        step_map(A, B), controller, **loop, options=km.loop.LoopOptions(plans=True), observers=[lambda step: step.plan]
    )
    assert controller.asked == 7
    assert run.plans.X.shape == (6, 7, 2)


def test_a_plan_that_nobody_asked_for_in_time_is_refused_and_not_another():
    late, kept = [], []
    loop = {"x0": [0.5, 0], "reference": [0, 0], "steps": 4}
    km.simulate(step_map(A, B), mpc(), **loop, observers=[late.append])
    with pytest.raises(km.errors.DataError, match="the controller has gone on: read"):
        late[0].plan.U  # noqa: B018
    run = km.simulate(step_map(A, B), mpc(), **loop, observers=[kept.append], options=km.loop.LoopOptions(plans=True))
    for k, step in enumerate(kept):
        np.testing.assert_array_equal(step.plan.X, run.plans.X[k])
    km.simulate(step_map(A, B), Recorded(), **loop, observers=[late.append])
    assert late[-1].plan is None


def test_a_step_map_runs_as_the_plant_that_remembers_its_state():
    loop = {"x0": [0.5, 0], "reference": [0, 0], "steps": 9, "rng": 3}
    more = {"noise": 0.01, "disturbance": lambda k, rng: 0.01 * rng.standard_normal(2)}
    for own in ({}, more, {**more, "faults": [km.faults.NaNSensor(probability=0.2)]}):
        one = km.simulate(step_map(A, B), Recorded(), **of_loop(**loop, **own))
        other = km.simulate(km.plants.SimulatedPlant(step_map(A, B)), Recorded(), **of_loop(**loop, **own))
        assert one == other
        assert np.array_equal(one.X, one.Y) == (not own)


class Careless(Recorded):
    """A controller that writes into what it is given."""

    def __call__(self, y, reference, applied=None):
        move = super().__call__(y, reference, applied)
        y[:] = 1e9
        if applied is not None:
            applied[:] = 1e9
        return move


def test_a_controller_that_writes_into_its_arguments_moves_neither_plant_nor_record():
    for noise in (None, 0.01):
        careful, careless = (run_map(each, 6, noise=noise) for each in (Recorded(), Careless()))
        np.testing.assert_array_equal(careless.X, careful.X)
        np.testing.assert_array_equal(careless.Y, careful.Y)
        np.testing.assert_array_equal(careless.U, careful.U)


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
    run = km.simulate(
        Outside(), mpc(), x0=[0.5, 0], reference=[0, 0], steps=12, options=km.loop.LoopOptions(plans=True)
    )
    bad = [status is km.Status.BAD_MEASUREMENT for status in run.status]
    assert bad == [3 <= k < 6 for k in range(12)]
    assert [run.fallback[k] for k in (3, 4, 5)] == [km.control.Fallback.SHIFTED_PLAN] * 3
    assert np.isfinite(run.U).all()
    assert np.isnan(run.X).all()
    assert np.isnan(run.Y[3:6, 0]).all()
    assert np.isfinite(run.Y[6:]).all()
    assert np.isnan(run.plans.U[3:6]).all()
    np.testing.assert_array_equal(run.U[3:6], run.plans.U[2, 1:4])


P, Q, E = np.array([[1.05, 0.1], [0.08, 1.0]]), np.array([[0.005], [0.1]]), np.array([[0.02], [0.1]])


class Told:
    """A controller that keeps what w it was told."""

    dt, nu = 0.1, 1

    def __init__(self, horizon):
        self.horizon, self.told = horizon, []

    def reset(self, x0=None, u_prev=None):
        pass

    def __call__(self, y, reference, applied=None, w=None):
        self.told.append(None if w is None else np.array(w))
        return km.Move(np.zeros(1), km.Status.OPTIMAL, km.control.Fallback.NONE, 0.0, 0)


def told_run(controller, **more):
    return km.simulate(step_map(P, Q), controller, x0=[0.0, 0.0], reference=[0.0, 0.0], steps=6, **of_loop(**more))


def test_a_controller_is_told_the_measured_disturbances_ahead():
    W = np.arange(12.0).reshape(6, 2)
    whole = np.vstack([W, np.tile(W[-1], (3, 1))])
    controller = Told(3)
    result = told_run(controller, measured=W)
    for k, told in enumerate(controller.told):
        np.testing.assert_array_equal(told, whole[k : k + 3])
    assert result.metadata["measured"] == W.tolist()
    controller = Told(3)
    told_run(controller, measured=W, preview=False)
    np.testing.assert_array_equal(controller.told, W)
    controller = Told(0)
    told_run(controller, measured=[4.0])
    assert all(told.tolist() == [[4.0]] for told in controller.told)
    controller = Told(3)
    assert "measured" not in told_run(controller).metadata
    assert controller.told == [None] * 6


def test_a_disturbance_that_is_told_ahead_costs_less():
    """A pulse that is measured costs less than one that is not, and least with its preview."""
    base = linear(P, Q)
    model = km.LinearPredictor(P, Q, np.eye(2), base.lifting, 0.1, base.states, base.inputs, E=E)
    cost, steps = km.Cost([2, 1], 0.01), 60
    W = np.where((np.arange(steps) >= 25) & (np.arange(steps) < 40), 0.5, 0.0)[:, None]
    costs = []
    for more in ({}, {"measured": W, "preview": False}, {"measured": W}):
        result = km.simulate(
            step_map(P, Q),
            km.KoopmanMPC(model, cost, km.Limits(-3, 3), 15),
            x0=[0.0, 0.0],
            reference=[0.0, 0.0],
            steps=steps,
            cost=cost,
            **of_loop(disturbance=W @ E.T, **more),
        )
        costs.append(km.metrics(result).cost)
    assert costs[2] < costs[1] < costs[0]


class Ending(Outside):
    """It ends the run at its third step, and says so again afterwards."""

    ended, count = "", 0

    def step(self, u):
        self.count += 1
        self.ended = "" if self.count < 3 else "it fell"
        return super().step(u)


@pytest.mark.parametrize("steps", [3, 4, 8])
def test_a_run_is_as_long_as_the_plant_goes_on(steps):
    observed = []
    if steps == 3:  # it ends with the run itself
        run = km.simulate(Ending(), Recorded(), x0=[0.5, 0], reference=[0, 0], steps=3, observers=[observed.append])
        assert "ended" not in run.metadata
    else:
        with pytest.warns(UserWarning, match=f"the plant ended the run after 3 of {steps} steps: it fell"):
            run = km.simulate(
                Ending(), Recorded(), x0=[0.5, 0], reference=[0, 0], steps=steps, observers=[observed.append]
            )
        assert run.metadata["ended"] == "it fell"
    assert run.steps == len(observed) == 3
    assert len(run.X) == len(run.Y) == len(run.reference) == 4
    assert len(run.U) == len(run.status) == len(run.solve_time) == len(run.slack) == len(run.known) == 3


def test_a_map_has_no_state_of_its_own_to_begin_in():
    with pytest.raises(km.errors.DataError, match="a simulated plant has no state of its own to begin in; pass x0"):
        km.simulate(step_map(A, B), Recorded(), x0=None, reference=[0.0, 0.0], steps=3)
