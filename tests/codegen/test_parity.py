"""The C of a controller against the controller: every step is told the same, and both must answer alike."""

from typing import NamedTuple

import numpy as np
import pytest

import koopmpc as km
from tests.codegen.parity_fuzz import SETTLED, STATUSES, compare, make_linear

COST = km.Cost(Q=[10.0, 1.0], R=0.1)
BOX = {"u_min": -25.0, "u_max": 25.0}
CLOSE = 1e-6  # share of the inputs' span: DAQP's answers are good to its tolerance of 1e-8 times the price of slacks


class Asked(NamedTuple):
    """A controller of a model, what its steps are told, and statuses that have to come up.

    Where an estimator runs, both are told the input that acted: else the one whose input did not act would be told lies.
    """

    make: object
    seen: tuple[str, ...]
    preview: int = 0
    bad: bool = True
    applied: bool = False
    acts: bool = False


def mpc(limits, horizon=15, cost=COST, **options):
    return lambda model: km.KoopmanMPC(model, cost, km.Limits(**limits), horizon, solver="daqp", **options)


CONTROLLERS = {
    "inputs": Asked(mpc(BOX), ("UNCONSTRAINED", "OPTIMAL", "BAD_MEASUREMENT")),
    "lqr": Asked(lambda model: km.LQR(model, COST, km.Limits(**BOX, du_max=20.0)), ("SATURATED", "BAD_MEASUREMENT")),
    "soft": Asked(mpc(BOX | {"x_min": [-0.5, -1.0], "x_max": [0.5, 1.0]}), ("SOFTENED",), preview=20),
    "small rows": Asked(mpc(BOX | {"x_max": [0.5, 9.0]}), ("UNCONSTRAINED", "OPTIMAL", "SOFTENED"), preview=6),
    "one row": Asked(mpc(BOX), ("UNCONSTRAINED", "OPTIMAL"), preview=1),
    "hard": Asked(mpc(BOX | {"x_min": [-0.6, -1.0], "x_max": [0.6, 1.0], "slack": None}, 8), ("OPTIMAL", "INFEASIBLE")),
    "rates": Asked(
        mpc(
            BOX | {"du_max": 4.0, "x_max": [0.8, np.inf]},
            cost=km.Cost(Q=[10.0, 1.0], R=0.1, R_delta=0.3),
            moves=(1, 1, 2, 3, 8),
            latency=1,
        ),
        ("OPTIMAL", "SOFTENED"),
        applied=True,
    ),
    "disturbance": Asked(
        mpc(BOX | {"x_max": [0.5, 9.0]}, estimator=km.LiftedDisturbance()),
        ("OPTIMAL", "SOFTENED"),
        preview=4,
        acts=True,
    ),
    "filter": Asked(
        mpc(BOX, estimator=km.LiftedKalman(["theta", "omega"], disturbance="output", delay=2)),
        ("OPTIMAL",),
        acts=True,
    ),
    "given": Asked(
        mpc(BOX, cost=km.Cost(Q=[10.0, 1.0], R=0.1, u_target=np.linspace(0, 5, 30)[:, None]), horizon=10), ("OPTIMAL",)
    ),
}


def steps_of(config, plant, steps, rng):
    """What the steps are told: measurements of a run with noise, missed samples, previews, inputs that did not act."""
    x, u = np.array([np.pi / 4, 0.0]), None
    for k in range(steps):
        y = x.copy()
        if config.bad and k % 19 == 7:
            y[rng.integers(2)] = np.nan
        reference = np.zeros(2)
        if config.preview:
            phase = 0.1 * (k + np.arange(config.preview))
            reference = np.column_stack([0.7 * np.sin(phase), np.zeros(len(phase))])
        applied = rng.uniform(-25, 25, 1) if config.applied and k % 5 == 3 else None
        applied = u if config.acts else applied
        if config.applied and k % 41 == 17:
            applied = np.array([np.nan])
        u = yield y, reference, applied
        x = plant(x, u) + 0.02 * rng.standard_normal(2)
        if np.abs(x).max() > 6 or k % 60 == 59:
            x = rng.uniform(-1.5, 1.5, 2)


def compared(controller, twin, told, steps, within):
    """Drive both with the same; return the statuses that came up."""
    controller.reset()
    twin.reset()
    seen, other = {}, 0
    said = next(told)
    for _ in range(steps):
        y, reference, applied = said
        a, b = controller(y, reference, applied), twin(y, reference, applied)
        assert (a.status, a.fallback) == (b.status, b.fallback)
        np.testing.assert_allclose(b.u, a.u, rtol=0, atol=within)
        if within < 1e-3:
            other += a.iterations != b.iterations
            assert abs(a.slack - b.slack) <= 1e-5 * max(1.0, a.slack)
        seen[a.status.name] = seen.get(a.status.name, 0) + 1
        try:
            said = told.send(a.u)
        except StopIteration:
            break
    # rounding decides where rows are as good as each other; and Python starts DAQP again where too many rows push, C does not
    assert other <= 0.05 * steps
    return seen


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("steps", [300, pytest.param(10_000, marks=pytest.mark.slow)])
def test_c_and_python_answer_alike(name, steps, pendulum):
    plant, model = pendulum
    asked = CONTROLLERS[name]
    controller = asked.make(model)
    twin = km.compiled(controller)
    assert type(twin).__name__ == "Compiled"
    told = steps_of(asked, plant, steps, np.random.default_rng(1))
    seen = compared(controller, twin, told, steps, CLOSE * 50)
    assert set(asked.seen) <= set(seen)


@pytest.mark.parametrize("name", ["inputs", "soft"])
@pytest.mark.parametrize("steps", [200, pytest.param(10_000, marks=pytest.mark.slow)])
def test_floats_answer_to_a_thousandth_of_the_range(name, steps, pendulum):
    plant, model = pendulum
    asked = CONTROLLERS[name]
    controller = asked.make(model)
    twin = km.compiled(controller, precision="float")
    told = steps_of(asked, plant, steps, np.random.default_rng(2))
    controller.reset()
    said, off, other = next(told), [], 0
    for _ in range(steps):
        a, b = controller(*said), twin(*said)
        if a.status is b.status:
            off.append(np.abs(a.u - b.u).max())
        else:
            other += 1
        try:
            said = told.send(a.u)
        except StopIteration:
            break
    assert max(off) <= 1e-3 * 50
    assert other <= 0.002 * steps  # within a tolerance of a limit


def test_floats_find_the_target_out_of_reach_of_two_inputs_on_one_state():
    """Which of the two inputs acts has next to no weight in the search of a target; rounding had hidden it."""
    A, B, names = np.array([[0.29]]), np.array([[0.77, 1.52]]), (("x",), ("a", "b"))
    model = km.LinearPredictor(A, B, np.eye(1), km.State(), 0.1, *names)
    limits = km.Limits([-0.46, -1.3], [0.86, 1.87], du_max=[0.44, 0.39], x_min=-3.6)
    controller = km.KoopmanMPC(model, km.Cost(0.013, [0.017, 0.17]), limits, 10, solver="daqp")
    twin = km.compiled(controller, precision="float")
    x = np.array([0.7])
    for _ in range(6):
        a, b = controller(x, [-4.3]), twin(x, [-4.3])
        np.testing.assert_allclose(b.u, a.u, rtol=0, atol=3e-3)
        x = A @ x + B @ a.u
    np.testing.assert_allclose(a.u, [-0.46, -1.3], atol=1e-6)


def test_a_past_two_inputs_and_a_measured_disturbance_are_told_alike(cart):
    limits = km.Limits(u_min=-2.0, u_max=2.0, du_max=[0.5, 1.0], du_slack=(50.0, 5.0), x_max=[0.6, 1.0])
    cost = km.Cost(Q=[5.0, 0.1], R=[0.1, 0.2])
    controller = km.KoopmanMPC(
        cart, cost, limits, 12, solver="daqp", latency=2, moves=6, estimator=km.LiftedDisturbance(gain=0.3)
    )
    twin = km.compiled(controller)
    rng = np.random.default_rng(4)
    seen = set()
    for k in range(300):
        x = rng.uniform(-1.2, 1.2, 2) if k % 7 else np.full(2, np.nan)
        w = [None, rng.uniform(-1, 1, 1), rng.uniform(-1, 1, (5, 1)), np.array([np.nan])][k % 4 if k % 50 else 3]
        reference = rng.uniform(-2, 2, (3, 2))
        a, b = controller(x, reference, None, w), twin(x, reference, None, w)
        assert (a.status, a.fallback) == (b.status, b.fallback), k
        np.testing.assert_allclose(b.u, a.u, rtol=0, atol=4e-6)
        seen.add(a.status.name)
        first, second = controller.plan(), twin.plan()
        assert (first is None) == (second is None)
        if first is not None:
            np.testing.assert_allclose(second.X, first.X, atol=1e-5)
            np.testing.assert_allclose(second.U, first.U, atol=1e-5)
    assert {"SOFTENED", "BAD_MEASUREMENT"} <= seen


def test_readings_near_the_largest_that_count_end_alike():
    """Many entries of a plan may be below 1e30 while the length of all is above."""
    A, B = np.array([[0.9, 0.2], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("p", "q"), ("u",))
    controller = km.KoopmanMPC(model, km.Cost([1.0, 1.0], 0.1), km.Limits(-1, 1, x_max=[2, 2]), 8, solver="daqp")
    twin, seen = km.compiled(controller), set()
    for size in 10.0 ** np.linspace(28, 30.5, 26):
        controller.reset()
        twin.reset()
        a, b = controller([size, -size], [0.0, 0.0]), twin([size, -size], [0.0, 0.0])
        assert (a.status, a.fallback) == (b.status, b.fallback)
        seen.add(a.status.name)
    assert "BAD_MEASUREMENT" in seen
    assert len(seen) > 1


def test_a_closed_loop_costs_the_same(pendulum):
    plant, model = pendulum
    limits = km.Limits(**BOX, x_max=[1.0, 0.2])
    controller = km.KoopmanMPC(model, COST, limits, 20, solver="daqp")
    runs = [
        km.simulate(plant, one, x0=[np.pi / 4, 0.0], reference=[0.4, 0.0], steps=150, cost=COST, limits=limits)
        for one in (controller, km.compiled(controller))
    ]
    costs = [km.metrics(run).cost for run in runs]
    assert abs(costs[1] / costs[0] - 1) < 1e-6
    assert list(runs[0].status) == list(runs[1].status)


@pytest.mark.slow
def test_random_controllers_answer_alike():
    """Differences and their causes stand in tests/codegen/parity_fuzz.py."""
    steps, differences = 0, []
    for seed in range(24):
        seen, found = compare(seed, 6)
        steps, differences = steps + sum(seen.values()), differences + found
    assert not [one for one in differences if one.kind == "KoopmanMPC"]
    assert not [one for one in differences if not one.wild and one.python.split()[0] != one.c.split()[0]]
    assert sum(one.wild or one.apart > 1e-5 for one in differences) <= 1e-3 * steps


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "episodes"), SETTLED)
def test_soft_limits_missed_by_far_leave_inputs_alike(seed, episodes):
    assert not compare(seed, episodes)[1]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "episodes"), STATUSES)
def test_a_status_that_rounding_decides_changes_no_input(seed, episodes):
    assert all(one.apart <= CLOSE for one in compare(seed, episodes)[1])


def test_inputs_at_their_limits_are_there_to_the_last_digit_however_far_soft_limits_are_missed():
    controller, _, _ = make_linear(np.random.default_rng(183))
    low, high = controller.limits.u_min, controller.limits.u_max
    move = controller([1e6, 0.1, -0.2, 0.3][: controller.predictor.nx], np.zeros(controller.predictor.nx))
    assert move.status.name == "SOFTENED"
    U = controller.plan().U
    gap = np.minimum(np.abs(U - low), np.abs(U - high)) / (high - low)
    assert ((gap == 0) | (gap > 1e-2)).all(), gap


@pytest.mark.parametrize(("growth", "horizon", "more"), [(1.4, 40, {}), (1.4, 60, {"du_max": 0.3})])
def test_an_unstable_plant_whose_hard_rows_are_nearly_dependent_is_solved_alike(growth, horizon, more):
    A, B = np.array([[growth, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.5]])
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("p", "q"), ("u",))
    controller = km.KoopmanMPC(model, km.Cost([1.0, 1.0], 0.1), km.Limits(-1, 1, **more), horizon, solver="daqp")
    assert controller._step.solver.qps._solvers[0]._steep()
    twin, rng, seen = km.compiled(controller), np.random.default_rng(0), set()
    for k in range(60):
        x = rng.uniform(-1, 1, 2) * [0.3, 1.0] * (0.5 if k % 3 else 2.0)
        a, b = controller(x, [0.0, 0.0]), twin(x, [0.0, 0.0])
        assert (a.status, a.fallback) == (b.status, b.fallback)
        np.testing.assert_allclose(b.u, a.u, rtol=0, atol=1e-6)
        seen.add(a.status.name)
    assert "OPTIMAL" in seen


@pytest.mark.parametrize(
    "rule", [km.LiftedDisturbance(), km.LiftedKalman(["a", "b"], disturbance="output", patience=2)]
)
def test_a_disturbance_beyond_all_numbers_is_not_learned_and_readings_are_bridged_as_long_as_in_python(rule):
    """Of a filter all readings are missing for 0 to 5 steps in a row, or one entry; an observer is told w of 1e29."""
    A, B, E = np.zeros((3, 3)), np.array([[0.0], [0.5], [0.0]]), np.array([[0.0], [0.0], [1e3]])
    A[:2, :2], A[0, 2] = [[0.9, 0.1], [0.0, 0.8]], 0.05
    lifting = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["a²"])  # w acts there: the gate sees nothing of it
    model = km.LinearPredictor(A, B, np.eye(2, 3), lifting, 0.1, ["a", "b"], ["u"], E=E)
    own = km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), km.Limits(-1, 1), 4, estimator=rule, solver="daqp")
    fast, rng, filtered = km.compiled(own), np.random.default_rng(0), isinstance(rule, km.LiftedKalman)
    x, u, missed = np.array([1.0, 0.0]), None, 0
    for k in range(60):
        y, w = x.copy(), 1e-4 * rng.normal(size=1)
        told = np.full(1, [3e28, np.nan, -1e29][k // 9 % 3]) if not filtered and k % 9 == 4 else w
        if filtered and k % 8 >= 3:
            y[slice(2) if k % 8 < 3 + k // 8 % 6 else k // 8 % 2] = np.nan
        missed = missed + 1 if np.isnan(y).all() else 0
        moves = [each(y, [0.5, 0.0], u, w=told) for each in (own, fast)]
        assert moves[0].status is moves[1].status
        assert not filtered or (moves[0].status is km.Status.BAD_MEASUREMENT) == (missed > 2)
        assert moves[1].u == pytest.approx(moves[0].u, abs=1e-9)
        u = moves[0].u
        x = A[:2, :2] @ x + B[:2] @ u + [0.05, -0.02]
