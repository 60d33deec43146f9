"""Equilibria near a guess are those of ipopt, with the same limits active; a moving load takes one step of Newton's."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

import koopmpc as km
from koopmpc.control.nonlinear.equilibrium import CLOSE, Equilibria
from koopmpc.control.nonlinear.stages import learned_map
from koopmpc.control.plan.row_targets import MovingEnd, RowTarget, RowTargets
from koopmpc.control.plan.tracking import state_tracking
from koopmpc.control.riccati import one_step, stationary
from tests.closed_loop.tasks import TASKS
from tests.control.test_bilinear_mpc import UPRIGHT, pendulum
from tests.control.test_nonlinear_mpc import pendulum as hinge

COST = km.Cost(Q=[1, 0.1], R=0.1)
BOX, WIDE = km.Limits(-0.3, 0.4, x_max=[0.7, 5.0]), km.Limits(-4, 4)


def two_tanks() -> km.StepMap:
    """Return two levels that drain faster the higher they are, the second fed by the first too."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    flow = ca.vertcat(u[0] - x[0] - 0.2 * x[0] ** 2, u[1] + 0.5 * x[0] - x[1] - 0.1 * x[1] ** 3)
    return km.StepMap(ca.Function("F", [x, u], [x + 0.1 * flow]), 0.1)


def equilibria(model, limits: km.Limits, cost: km.Cost = COST) -> Equilibria:
    return row_targets(model, limits, cost).equilibria


def row_targets(model, limits: km.Limits = WIDE, cost: km.Cost = COST) -> RowTargets:
    return RowTargets(learned_map(model), state_tracking(model.states, model.inputs, cost, limits), 1000)


def find(targets: RowTargets, row) -> RowTarget:
    """Return the target of a row as the last one of a plan."""
    ((target,), _) = targets.find([np.asarray(row, float)])
    targets.finish_at(target)
    return target


TANK_BOX = km.Limits(0, [1.0, 0.6], x_max=[1.5, 1.2])
SWING_ROWS, TANK_ROWS = row_targets(pendulum(), BOX), row_targets(two_tanks(), TANK_BOX)
SWING, TANKS = SWING_ROWS.equilibria, TANK_ROWS.equilibria


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_near_a_guess_it_is_what_ipopt_finds(seed: int, tanks: bool) -> None:
    rng = np.random.default_rng(seed)
    each = TANKS if tanks else SWING
    nx = each.model.nx
    row = rng.uniform(0.2, 1.6, nx) if tanks else np.array([rng.uniform(-0.5, 1.2), 0.0])
    e = 0.02 * rng.standard_normal(nx)
    begin = each.find(row)
    near, far = each.near(begin, row, e), each.find(row, e, begin)
    if near is None:
        return
    assert np.allclose(near.x, far.x, atol=1e-4)
    assert np.allclose(near.u, far.u, atol=1e-4)
    at = each.linearise(near.x, near.u)
    assert np.allclose(at.F + e, near.x, atol=1e-9)
    values, limits = np.concatenate([near.u, at.g]), each.program()
    assert (values >= limits.low - 1e-8).all()
    assert (values <= limits.high + 1e-8).all()
    again = each.near(near, row, e, CLOSE)
    assert again is not None
    assert np.allclose(again.x, near.x, atol=1e-9)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_disturbance_that_rests_ends_where_full_steps_do(seed: int, tanks: bool) -> None:
    rng = np.random.default_rng(seed)
    targets = TANK_ROWS if tanks else SWING_ROWS
    each, nx = targets.equilibria, targets.equilibria.model.nx
    row = rng.uniform(0.2, 0.8, nx) if tanks else np.array([rng.uniform(-0.5, 1.2), 0.0])
    e = 2e-3 * rng.standard_normal(nx)
    target, moving = find(targets, row), MovingEnd(targets)
    exact = each.near(target.equilibrium, row, e)
    if exact is None or exact.active.any():
        return
    moving.at(find(targets, row + 1e-3), np.zeros(nx))  # its factors serve for what follows
    ends = [moving.at(target, e) for _ in range(8)]
    np.testing.assert_allclose(ends[-1].equilibrium.x, exact.x, atol=1e-9)
    np.testing.assert_allclose(ends[-1].equilibrium.u, exact.u, atol=1e-9)


@pytest.mark.parametrize("limits", [km.Limits(-4, 4), km.Limits(-0.35, 0.4), km.Limits(-4, 4, x_max=[0.5, np.inf])])
@pytest.mark.parametrize("reference", [0.3, 0.9])
def test_a_target_under_a_load_is_found_without_ipopt_and_no_offset_is_left(
    monkeypatch: pytest.MonkeyPatch, limits: km.Limits, reference: float
) -> None:
    """Where the reference is out of reach the state ends at the limit, and the input where it is inside its own."""
    model = pendulum()
    F, found = model.step_map(), []
    mpc = km.BilinearMPC(model, COST, limits, 30, estimator=km.LiftedDisturbance(0.3))
    x = np.array([0.1, 0.0])
    find = Equilibria.find
    monkeypatch.setattr(Equilibria, "find", lambda self, *rest: found.append(1) or find(self, *rest))
    load = np.array([0.0, 0.004])
    for k in range(300):
        move = mpc(x, [reference, 0.0])
        assert (move.u >= limits.inputs(1).low).all()
        assert (move.u <= limits.inputs(1).high).all()
        x = F(x, move.u) + load * (1 + 0.1 * np.sin(0.1 * k) if k < 100 else 1.0)
    assert len(found) <= 3
    # at rest u cos θ holds the load and gravity: what θ needs is u(θ) = −(0.05 sin θ + 0.004) / (0.1 cos θ)
    need = -(0.05 * np.sin(reference) + 0.004) / (0.1 * np.cos(reference))
    top = limits.states(2).high[0]
    if limits.inputs(1).low[0] < need and reference < top:
        assert abs(x[0] - reference) < 1e-6
    elif reference > top:
        assert abs(x[0] - top) < 1e-4


def test_the_end_costs_the_same_at_every_turn_and_is_riccatis_near_the_target() -> None:
    plant, cost = hinge(), km.Cost(Q=[1, 1, 0.1], R=0.1, of=UPRIGHT)
    target, price = ends(plant, cost, [0.0, 1.0, 0.0], km.Limits(-2, 2))
    (x, u, _), nothing = target.equilibrium, np.zeros(1)
    assert np.allclose(np.sin(x[0]), 0, atol=1e-6)
    assert np.cos(x[0]) > 0.99
    far = np.array([1.0, 0.5])
    assert price(far + np.array([2 * np.pi, 0]), nothing) == pytest.approx(price(far, nothing), rel=1e-9)
    affine = plant.linearize(x, u)
    P = stationary(one_step(affine.A, affine.B, np.diag([1.0, 0.1]), np.array([[0.1]])), 1000).P
    for d in np.array([[1e-3, 0], [0, 1e-3], [1e-3, -2e-3]]):
        assert price(x + d, nothing) == pytest.approx(d @ P @ d, rel=1e-2)
    assert price(x + np.array([np.pi, 0]), nothing) > price(x + np.array([0.5, 0]), nothing)  # hanging is no target
    down, _ = ends(plant, cost, [0.0, -1.0, 0.0], km.Limits(-2, 2))
    assert np.cos(down.equilibrium.x[0]) < -0.99  # at the guess x = 0 the slope of the distance is zero


def test_what_a_reference_says_of_states_without_weight_does_not_move_its_equilibrium():
    """A reactor has several equilibria, and from a wall at 0 K, which is far off the data, the wrong one is found."""
    task = TASKS["stiff"]
    data = task.data(0)
    lifting = km.State() + km.Constant() + km.lifting.Standardized.of(data, km.Monomials(2))
    model = km.bilinear_edmd(data, lifting, ridge=1e-8, difference=True)
    cost = km.Cost(Q=task.Q, R=task.R)
    tracking = state_tracking(model.states, model.inputs, cost, task.limits)
    silent, told = (
        Equilibria(learned_map(model), tracking).find(np.array([0.676, 340.0, wall])) for wall in (0.0, 302.8)
    )
    np.testing.assert_allclose(silent.u, told.u, rtol=1e-6)
    assert abs(silent.x[1] - 340.0) < 0.2


def test_ipopt_is_asked_once_for_rows_that_equilibria_hold(monkeypatch):
    targets = row_targets(two_tanks(), TANK_BOX)
    asked, own = [], targets.equilibria.find
    monkeypatch.setattr(targets.equilibria, "find", lambda row: asked.append(row) or own(row))
    t = np.linspace(0, 3, 60)
    rows = np.column_stack([0.8 + 0.6 * np.sin(t), 0.7 + 0.5 * np.cos(t)])  # some ask for more than the limits allow
    followed = targets.find(list(rows))[0] + targets.find([np.array([0.1, 0.1])])[0]  # far from the last row, and held
    assert len(asked) == 1
    for target in followed:
        alone = find(row_targets(two_tanks(), TANK_BOX), target.row)
        np.testing.assert_allclose(target.u, alone.u, atol=1e-4)
        np.testing.assert_allclose(target.equilibrium.x, alone.equilibrium.x, atol=1e-4)
    find(targets, [3.0, 3.0])  # far off, and out of reach
    assert len(asked) == 2


def test_with_another_model_the_last_target_goes_on_from_where_it_was_without_ipopt(monkeypatch):
    before, row = pendulum(), np.array([0.2, 0.0])
    after = replace(before, A=before.A * np.where(before.A == 0.05, 1.02, 1.0))  # gravity
    targets, alone = row_targets(before), find(row_targets(after), row)
    find(targets, [0.7, 0.0])
    old = find(targets, row)
    monkeypatch.setattr(Equilibria, "find", None)
    targets.update(learned_map(after))
    new = find(targets, row)
    assert np.abs(new.u - old.u).max() > 1e-4
    np.testing.assert_allclose(new.u, alone.u, atol=1e-6)
    np.testing.assert_allclose(new.equilibrium.x, alone.equilibrium.x, atol=1e-6)


@pytest.mark.parametrize("each", [SWING, TANKS], ids=["swing", "tanks"])
def test_the_slope_of_an_equilibrium_is_how_its_input_moves_with_a_disturbance(each: Equilibria) -> None:
    row = np.array([0.3, 0.0]) if each is SWING else np.array([0.6, 0.5])
    here = each.near(each.find(row), row, np.zeros(2))
    slope, h = each.slope(each.linearise(here.x, here.u)), 1e-5
    for i, step in enumerate(h * np.eye(2)):
        ahead, back = each.near(here, row, step), each.near(here, row, -step)
        np.testing.assert_allclose(slope[:, i], (ahead.u - back.u) / (2 * h), rtol=1e-4, atol=1e-6)


def ends(plant: km.StepMap, cost: km.Cost, row, limits: km.Limits):
    """Return the target of a row, and what a plan that ends in x after the input u pays for its end."""
    target = find(row_targets(plant, limits, cost), row)
    tracked = state_tracking(plant.states, plant.inputs, cost, limits).tracked
    M, L, V, m = target.end

    def price(x: np.ndarray, u: np.ndarray) -> float:
        missed = M @ tracked(x).full().ravel() + L @ x + V @ u - m
        return float(missed @ missed)

    return target, price


@pytest.mark.parametrize("u_target", ["equilibrium", "zero"])
@pytest.mark.parametrize("R_delta", [None, [0.4, 0.2]])
@pytest.mark.parametrize("of_b", [2.0, 0.0])
def test_where_states_are_tracked_the_end_costs_the_solution_of_the_riccati_equation(of_b, R_delta, u_target) -> None:
    """With R_delta that of the state and the last input: ‖u − u_last‖² weighs their difference."""
    plant = two_tanks()
    cost = km.Cost(Q=[1, of_b], R=[0.3, 0.5], R_delta=R_delta, u_target=u_target)
    limits = km.Limits(0, [1.0, 0.6], x_max=[1.5, 1.2])
    target, price = ends(plant, cost, [0.6, 0.5], limits)
    x, u = target.equilibrium.x, target.equilibrium.u
    np.testing.assert_allclose(x[: 1 + (of_b > 0)], [0.6, 0.5][: 1 + (of_b > 0)], atol=1e-5)
    np.testing.assert_allclose(plant(x, u), x, atol=1e-6)
    np.testing.assert_array_equal(target.u, u if u_target == "equilibrium" else 0 * u)
    local = plant.linearize(x, u)
    Q, R = np.diag([1.0, of_b]), np.diag([0.3, 0.5])
    P = solve_discrete_are(local.A, local.B, Q, R)
    if R_delta is not None:
        D, none = np.diag(R_delta), np.zeros((2, 2))
        A, B = np.block([[local.A, none], [none, none]]), np.vstack([local.B, np.eye(2)])
        P = solve_discrete_are(A, B, np.block([[Q, none], [none, D]]), R + D, s=np.vstack([none, -D]))
    rng = np.random.default_rng(0)
    for d, p in rng.standard_normal((6, 2, 2)):
        both = d if R_delta is None else np.concatenate([d, p])
        assert price(x + d, target.u + p) == pytest.approx(both @ P @ both, rel=1e-5)


def test_what_no_small_motion_changes_of_the_tracked_outputs_keeps_its_weight_at_the_end() -> None:
    """Upright, cos θ does not change at first order: far away it costs Q, by the mean of P over that of the others."""
    plant, cost, limits = hinge(), km.Cost(Q=[3, 2, 0.1], R=0.1, of=UPRIGHT), km.Limits(-2, 2)
    target, price = ends(plant, cost, np.array([0.0, 1.0, 0.0]), limits)
    local = plant.linearize(target.equilibrium.x, target.u)
    seen = np.diag([3, 0.1])
    P = solve_discrete_are(local.A, local.B, seen, np.array([[0.1]]))
    mean = np.trace(P @ np.linalg.inv(seen)) / 2
    assert mean > 1
    for theta, omega in ((0.1, 0.2), (np.pi / 2, -0.3), (np.pi, 0.0), (4.0, 1.0)):
        d = np.array([np.sin(theta), omega])
        wanted = d @ P @ d + mean * 2 * (np.cos(theta) - 1) ** 2
        assert price(np.array([theta, omega]), target.u) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("Q_N", [None, [2.0, 5.0]])
def test_a_disturbance_moves_the_target_to_the_equilibrium_that_it_allows(Q_N) -> None:
    plant, e, row = two_tanks(), np.array([0.01, -0.008]), np.array([0.6, 0.5])
    targets = row_targets(plant, TANK_BOX, km.Cost(Q=[1, 2], R=0.3, Q_N=Q_N, R_delta=None if Q_N else 0.1))
    moving, target = MovingEnd(targets), find(targets, row)
    for _ in range(4):
        end = moving.at(target, e)
    (x, u, _), (M, L, V, m) = end.equilibrium, end.cost
    np.testing.assert_allclose(plant(x, u) + e, x, atol=1e-9)
    np.testing.assert_allclose(x, row, atol=1e-5)
    np.testing.assert_array_equal(end.u, u)
    np.testing.assert_allclose(M @ x + L @ x + V @ u, m, atol=1e-5)
    assert np.abs(u - target.u).max() > 1e-3


def test_a_row_whose_equilibrium_is_not_found_is_aimed_at_itself_until_it_is_looked_for_again(monkeypatch) -> None:
    row = np.array([0.6, 0.5])
    for cost, weight in ((km.Cost(Q=[1, 2], R=0.3, R_delta=0.1), [1, 2]), (km.Cost(1, 0.3, Q_N=[4, 9]), [4, 9])):
        targets = row_targets(two_tanks(), km.Limits([0.1, -1], 1), cost)
        with monkeypatch.context() as patch:
            patch.setattr(targets.equilibria, "find", lambda *rest: None)
            target = find(targets, row)
            assert MovingEnd(targets).at(target, np.array([0.01, 0.0])).cost is target.end
        assert find(targets, row) is target
        M, L, V, m = target.end
        for x in np.random.default_rng(0).standard_normal((3, 2)):
            missed = M @ x + L @ x + V @ np.ones(2) - m
            assert missed @ missed == pytest.approx((x - row) ** 2 @ weight)
        np.testing.assert_array_equal(target.u, [0.1, 0.0])
        targets.reset()
        np.testing.assert_allclose(find(targets, row).equilibrium.x, row, atol=1e-5)


def test_a_disturbance_that_allows_no_equilibrium_leaves_the_target_of_the_row() -> None:
    """A position and a speed: where the position is pushed by more than the speed may make up for, nothing rests."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    cart = km.StepMap(ca.Function("F", [x, u], [ca.vertcat(x[0] + 0.2 * x[1], 0.9 * x[1] + 0.3 * u)]), 0.2)
    targets = row_targets(cart, km.Limits(-1, 1, x_max=[np.inf, 0.4]))
    moving, target = MovingEnd(targets), find(targets, [0.3, 0.0])
    np.testing.assert_allclose(moving.at(target, np.array([-0.07, 0.0])).equilibrium.x, [0.3, 0.35], atol=1e-6)
    assert moving.at(target, np.array([-0.09, 0.0])).equilibrium is target.equilibrium


@pytest.mark.parametrize(
    ("row", "active"),
    [
        ([0.6, 0.5], [0, 0, 0, 0]),
        ([3.0, 0.5], [1, 0, 0, 0]),
        ([0.6, -3.0], [0, -1, 0, 0]),
        ([0.8, 9.0], [0, 0, 0, 1]),
        ([-0.5, 0.3], [-1, 0, 0, 0]),
    ],
)
def test_what_is_at_its_limit_is_known_of_an_equilibrium_that_is_found(row, active) -> None:
    """[u_1, u_2, x_1, x_2] at their lower (−1) and upper (1) limits, by ipopt and by steps from another equilibrium."""
    each = equilibria(two_tanks(), km.Limits(0, [1.0, 1.9], x_max=[1.5, 1.2]))
    found = each.find(np.array(row))
    assert found.active.tolist() == active
    np.testing.assert_allclose(two_tanks()(found.x, found.u), found.x, atol=1e-6)
    near = each.near(each.find(np.array([0.6, 0.5])), np.array(row), np.zeros(2))
    if near is not None:
        assert near.active.tolist() == active
        np.testing.assert_allclose(near.x, found.x, atol=1e-4)


def test_of_all_equilibria_that_hold_a_reference_the_least_is_found() -> None:
    """Two inputs do the same: each does half of it."""
    x, u = ca.SX.sym("x", 1), ca.SX.sym("u", 2)
    plant = km.StepMap(ca.Function("F", [x, u], [0.5 * x + u[0] + u[1]]), 0.1)
    each = equilibria(plant, km.Limits(-4, 4), km.Cost(1, 0.1))
    found = each.find(np.array([2.0]))
    near = each.near(found, np.array([3.0]), np.zeros(1))
    np.testing.assert_allclose(found.u, [0.5, 0.5], atol=1e-3)
    np.testing.assert_allclose(near.u, [0.75, 0.75], atol=1e-6)
    np.testing.assert_allclose(each.slope(each.linearise(near.x, near.u)), [[-0.5], [-0.5]], atol=1e-6)


def test_an_equilibrium_that_was_not_found_is_looked_for_again_after_a_reset(monkeypatch):
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, 0.05)
    controller, fresh = (km.BilinearMPC(plant, problem.cost, km.Limits(u_min=-10, u_max=10), 10) for _ in range(2))
    find, asked = Equilibria.find, []

    def lost(self, *arguments, **options):
        asked.append(arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Equilibria, "find", lost)
        moves = [controller([0.3, 0.0], [0.0, 0.0]) for _ in range(3)]
    assert len(asked) == 1  # it is not looked for at each step
    assert all(np.isfinite(move.u).all() for move in moves)
    assert Equilibria.find is find
    controller.reset()
    assert np.array_equal(controller([0.3, 0.0], [0.0, 0.0]).u, fresh([0.3, 0.0], [0.0, 0.0]).u)


@pytest.mark.parametrize(("target", "most"), [("zero", 1), ("equilibrium", 2)])
def test_a_preview_is_searched_by_ipopt_only_where_nothing_close_is_known(monkeypatch, target, most):
    """Rows before the last need no equilibrium where no input is asked for; others go on from the one before."""
    A, B = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[0.0], [0.3]])
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("x0", "x1"), ("u",))
    limits = km.Limits(-5, 5, x_max=[2.0, 2.0])
    controller = km.BilinearMPC(model, km.Cost(Q=[1.0, 1.0], R=0.1, u_target=target), limits, 20)
    rows = 0.5 * np.cos(0.2 * np.arange(21))[:, None] * [1.0, 0.0]  # through zero
    find, asked = Equilibria.find, []

    def count(self, *arguments, **options):
        asked.append(arguments)
        return find(self, *arguments, **options)

    monkeypatch.setattr(Equilibria, "find", count)
    controller([0.3, 0.0], rows)
    assert 1 <= len(asked) <= most
    targets = controller.find_targets(rows)  # as exact as if each had been sought from afar
    alone = [km.BilinearMPC(model, controller.cost, limits, 20).find_targets(row[None])[0] for row in rows[::5]]
    np.testing.assert_allclose(targets[::5], alone, atol=1e-6)


def test_of_the_inputs_that_hold_a_row_the_smallest_are_found_wherever_the_search_begins():
    """x = −0.9 x − 1.3 u₀ − 0.25 u₁ + (0.13 u₀ + 0.34 u₁) x leaves one direction of u free."""
    model = km.BilinearPredictor(
        [[-0.9]], [[-1.3, -0.25]], [[[0.13]], [[0.34]]], np.eye(1), km.State(), 0.1, ["x"], ["u0", "u1"]
    )
    for row in (np.array([0.55]), np.array([-0.58])):
        fresh, moved = (row_targets(model, km.Limits(-1, 1), km.Cost(Q=1, R=0.5)) for _ in range(2))
        find(moved, row * 0.98)
        slope = np.array([-1.3, -0.25]) + row * [0.13, 0.34]
        smallest = slope * 1.9 * row / (slope @ slope)
        assert find(fresh, row).u == pytest.approx(smallest, abs=1e-7)
        assert find(moved, row).u == pytest.approx(smallest, abs=1e-7)
