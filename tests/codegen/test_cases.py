"""Steps at which C and Python once differed, or might: both are told the same, and answer alike."""

import copy

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.codegen import plants
from tests.codegen.test_parity import COST, random_linear
from tests.compiler import needs_compiler
from tests.control.test_levels import TANK, draw_model
from tests.synthesis.test_loops import make
from tests.tiers import few

pytestmark = needs_compiler
BOX = {"u_min": -8.0, "u_max": 8.0}


def both(own, **options):
    fast = km.compiled(own, **options)
    assert fast is not own
    return own, fast


def step(pair, *told, within=1e-6, **more):
    """Step both and return the move of Python."""
    one, other = (each(*told, **more) for each in pair)
    assert (other.status, other.fallback) == (one.status, one.fallback)
    np.testing.assert_allclose(other.u, one.u, rtol=0, atol=within)
    return one


def linear(A, B, **more):
    names = ("a", "b", "c")[: len(A)], ("u", "v")[: np.shape(B)[1]]
    return km.LinearPredictor(A, B, np.eye(len(A)), km.State(), 0.1, *names, **more)


def test_floats_find_the_target_out_of_reach_of_two_inputs_on_one_state():
    """Which of the two inputs acts has next to no weight in the search of a target; rounding had hidden it."""
    A, B = np.array([[0.29]]), np.array([[0.77, 1.52]])
    limits = km.Limits([-0.46, -1.3], [0.86, 1.87], du_max=[0.44, 0.39], x_min=-3.6)
    own = km.KoopmanMPC(linear(A, B), km.Cost(0.013, [0.017, 0.17]), limits, 10, solver="daqp")
    pair, x = both(own, precision="float"), np.array([0.7])
    for _ in range(6):
        move = step(pair, x, [-4.3], within=3e-3)
        x = A @ x + B @ move.u
    np.testing.assert_allclose(move.u, [-0.46, -1.3], atol=1e-6)


def test_readings_near_the_largest_that_count_end_alike():
    """Many entries of a plan may be below 1e30 while the length of all is above."""
    model = linear([[0.9, 0.2], [0.0, 0.9]], [[0.0], [0.1]])
    pair = both(km.KoopmanMPC(model, km.Cost([1.0, 1.0], 0.1), km.Limits(-1, 1, x_max=[2, 2]), 8, solver="daqp"))
    seen = set()
    for size in 10.0 ** np.linspace(28, 30.5, 26):
        for each in pair:
            each.reset()
        seen.add(step(pair, [size, -size], [0.0, 0.0], within=1e3).status.name)
    assert "BAD_MEASUREMENT" in seen
    assert len(seen) > 1


def test_inputs_at_their_limits_are_there_to_the_last_digit_however_far_soft_limits_are_missed():
    own = random_linear(np.random.default_rng(183)).controller
    low, high = own.limits.u_min, own.limits.u_max
    move = own([1e6, 0.1, -0.2, 0.3][: own.predictor.nx], np.zeros(own.predictor.nx))
    assert move.status.name == "SOFTENED"
    U = own.plan().U
    gap = np.minimum(np.abs(U - low), np.abs(U - high)) / (high - low)
    assert ((gap == 0) | (gap > 1e-2)).all(), gap


@pytest.mark.parametrize(
    "rule", [km.LiftedDisturbance(), km.LiftedKalman(["a", "b"], disturbance="output", patience=2)]
)
def test_a_disturbance_beyond_all_numbers_is_not_learned_and_readings_are_bridged_as_long_as_in_python(rule):
    """Of a filter all readings are missing for 0 to 5 steps in a row, or one entry; an observer is told w of 1e29."""
    A, B, E = np.zeros((3, 3)), np.array([[0.0], [0.5], [0.0]]), np.array([[0.0], [0.0], [1e3]])
    A[:2, :2], A[0, 2] = [[0.9, 0.1], [0.0, 0.8]], 0.05
    lifting = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["a²"])  # w acts there: the gate sees nothing of it
    model = km.LinearPredictor(A, B, np.eye(2, 3), lifting, 0.1, ["a", "b"], ["u"], E=E)
    pair = both(km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), km.Limits(-1, 1), 4, estimator=rule, solver="daqp"))
    rng, filtered = np.random.default_rng(0), isinstance(rule, km.LiftedKalman)
    x, u, missed = np.array([1.0, 0.0]), None, 0
    for k in range(60):
        y, w = x.copy(), 1e-4 * rng.normal(size=1)
        told = np.full(1, [3e28, np.nan, -1e29][k // 9 % 3]) if not filtered and k % 9 == 4 else w
        if filtered and k % 8 >= 3:
            y[slice(2) if k % 8 < 3 + k // 8 % 6 else k // 8 % 2] = np.nan
        missed = missed + 1 if np.isnan(y).all() else 0
        move = step(pair, y, [0.5, 0.0], u, w=told, within=1e-9)
        assert not filtered or (move.status is km.Status.BAD_MEASUREMENT) == (missed > 2)
        u = move.u
        x = A[:2, :2] @ x + B[:2] @ u + [0.05, -0.02]


# long previews


def test_a_step_without_a_measurement_goes_on_along_the_plan_that_was_not_needed():
    A, B = plants.WAVE
    mpc = km.KoopmanMPC(plants.make_wave(), km.Cost([1.0, 0.1], 0.1), km.Limits(-2, 2, x_max=[1.5, np.inf]), 70)
    pair, x = both(mpc), np.array([0.1, 0.0])

    def rows(k):
        return np.stack([0.2 * np.sin(0.15 * (k + np.arange(71))), np.zeros(71)], axis=1)

    for k in range(4):
        x = A @ x + B @ step(pair, x, rows(k), within=1e-9).u
    planned = mpc.plan().U
    for each in (*pair, copy.copy(pair[1])):
        for j in (1, 2, 3):  # another preview, which must not enter
            move = each([np.nan, 0.0], rows(50 + j))
            assert move.fallback.name == "SHIFTED_PLAN"
            assert move.u == pytest.approx(planned[j], abs=1e-9)


# limits in time


def test_constant_rows_give_the_same_inputs_as_the_constant_limits():
    (A, B), model = plants.PAIR, plants.make_pair()[0]
    cost, x = km.Cost(Q=[1, 0.5], R=0.05), np.array([1.0, -0.5])
    ends = (0.7, np.full((3, 2), 0.7))
    plain, rows = (km.compiled(km.KoopmanMPC(model, cost, km.Limits(-1, end, x_max=0.8), 6)) for end in ends)
    for _ in range(15):
        u = plain(x, [1, 0]).u
        np.testing.assert_allclose(rows(x, [1, 0]).u, u, atol=1e-12)
        x = A @ x + B @ u


def test_targets_that_limits_in_time_push_are_pushed_in_c_too():
    """Small references need no look at their targets, large ones do: the border is that of the limits ahead."""
    waves = 0.75 + 0.35 * np.cos(np.arange(40)[:, None] / [3, 2] + [0, 2])
    limits = km.Limits(-waves[::-1], waves, x_min=-waves, x_max=waves)
    pair = both(km.KoopmanMPC(plants.make_pair()[0], km.Cost(Q=[1, 0.5], R=0.05), limits, 6))
    for size in (0.01, 0.1, 0.3, 1.0, 3.0):
        for each in pair:
            each.reset()
        for k in range(12):
            step(pair, [0.1, 0.0], size * np.array([np.cos(k), np.sin(k)]))


def test_a_fallback_keeps_the_limits_of_its_own_step_alone_where_a_move_is_held_for_several():
    (A, B), model, x = plants.PAIR, plants.make_pair()[0], np.array([1.5, -1.5])
    limits = km.Limits(-1, np.random.default_rng(0).uniform(0.1, 1.2, (40, 2)), du_max=0.9)
    moves = {"a": (1, 1, 4), "b": (2, 4)}
    pair = both(km.KoopmanMPC(model, km.Cost(Q=[1, 0.5], R=0.05), limits, 6, moves=moves))
    for k in range(40):
        u = step(pair, x if k % 3 else [np.nan, 0.0], [0.0, -3.0]).u
        x = A @ x + B @ u


@pytest.mark.parametrize("bent", few([False, True], False))
def test_in_c_weights_stand_for_priorities(bent):
    (A, B), (model, equations), rng = plants.PAIR, plants.make_pair(), np.random.default_rng(1)
    limits = km.Limits(u_min=-0.6, u_max=0.6, x_max=[0.2, 0.1], x_min=[-0.3, -0.2], priority=[1, 0])
    kind, cost = km.BilinearMPC if bent else km.KoopmanMPC, km.Cost(Q=[1, 0.5], R=0.3 if bent else 0.05)
    pair, x, seen = both(kind(equations if bent else model, cost, limits, 6)), np.array([1.0, -0.5]), set()
    for k in range(40):
        move = step(pair, x, [1.2 * np.sin(k / 6), 0.2], within=1e-5)
        seen.add(move.status)
        x = A @ x + B @ move.u + rng.normal(0, 0.02, 2)
    assert km.Status.SOFTENED in seen


# levels


def test_single_precision_leaves_out_no_level_on_its_limit():
    """Rounded to single precision, such a limit is up to 4e-6 of the spacing below its level."""
    row = -3.0 + 0.15 * np.arange(40)
    for highest in (33, 34, 38):
        own = km.KoopmanMPC(TANK, km.Cost(Q=1.0, R=0.1), km.Limits(levels=[row], u_max=[[row[highest]], [row[-1]]]), 3)
        for each in both(own, precision="float"):
            assert each([0.0], [50.0]).u == pytest.approx(row[highest], rel=1e-5)


def test_a_run_with_rows_starts_on_a_level_in_c_as_in_python():
    """Zero, where a run starts, is between two levels, and a change of more than 0.5 breaks the rate."""
    limits = km.Limits(levels=[[-0.1, 0.4]], du_max=0.5, u_max=np.full((3, 1), 1.0))
    for each in both(km.KoopmanMPC(TANK, km.Cost(Q=1.0, R=0.1), limits, 3)):
        move = each([0.0], [1.0])
        assert (move.u, move.status, move.slack) == (0.4, km.Status.OPTIMAL, 0.0)


def test_a_step_without_a_plan_has_no_slack_in_c_as_in_python():
    """The last input was far outside its limits, so that its change must be large, and no plan meets x ≤ 1."""
    limits = km.Limits(levels=[[0, 1, 2]], du_max=1, x_max=1, slack=None)
    for each in both(km.KoopmanMPC(TANK, km.Cost(Q=1.0, R=0.1), limits, 4)):
        move = each([9.0], [0.0], [7.0])
        assert (move.status, move.slack) == (km.Status.INFEASIBLE, 0.0)


def test_a_search_that_meets_its_bound_in_c_says_what_its_plan_may_miss(monkeypatch):
    rng, gaps = np.random.default_rng(3), []
    for _ in range(3):
        own = km.KoopmanMPC(draw_model(rng, 1), km.Cost(Q=1.0, R=0.1), km.Limits(levels=[[-1, 1]]), 9)
        best = km.compiled(own)
        monkeypatch.setattr("koopmpc.codegen.programs.NODES", 9)
        cut = km.compiled(own)
        monkeypatch.undo()
        x = rng.standard_normal(3)
        one, other = (each(x, np.zeros(3)) for each in (best, cut))
        assert one.gap == 0
        assert (other.status is km.Status.TIME_LIMIT) == (other.gap > 0)
        gaps.append(other.gap)
    assert 0 < max(gaps) <= 1


# nonlinear models


def test_a_loop_that_learns_what_the_model_lacks_is_that_of_python_to_rounding():
    """Its estimator and its iteration have constants of one name each: where two share one, plans end too early."""
    plant, model = plants.make_swung()
    limits = km.Limits(**BOX, du_max=2.0, x_min=[-np.inf, -1.0], x_max=[np.inf, 1.0])
    pair, rng = (
        both(km.BilinearMPC(model, COST, limits, 20, estimator=km.LiftedDisturbance())),
        np.random.default_rng(0),
    )
    x, reference = np.array([0.4, 0.0]), np.zeros(2)
    for k in range(120):
        if k % 20 == 0:
            reference = np.array([rng.uniform(-0.5, 0.5), 0.0])
        move = step(pair, x + 1e-3 * rng.normal(size=2), reference, within=1e-8)
        x = np.add(plant(x, move.u), [0.0, 0.02])  # a load that the model does not know


@pytest.mark.parametrize("seed", few(range(4), 0, 1))
def test_delays_and_a_disturbance_without_an_equilibrium_are_answered_as_in_python(seed):
    """Readings that no constant load explains: Gauss–Newton leads to an equilibrium at some steps, and at others to none."""
    pair, readings = both(make(bilinear=True, delays=1)[1]), 0.3 * np.random.default_rng(seed).normal(size=(30, 2))
    pair[0].reset(readings[0])
    for y in readings:
        step(pair, y, [0.3, 0.0])


@pytest.mark.parametrize("held", ["equilibrium", "zero"])
def test_a_set_point_met_for_the_first_time_is_held_as_in_python(held):
    """Near ones, far ones, and such that no torque inside the limits holds."""
    cost = km.Cost(Q=[1e-5, 0.1], R=0.1, u_target=held)
    pair = both(km.BilinearMPC(plants.make_thousandths(), cost, km.Limits(**BOX), 10))
    rng, x = np.random.default_rng(1), np.array([50.0, 0.1])
    for k in range(60):
        step(pair, x, [20.0 * k if k % 4 else rng.uniform(-3000, 3000), 0.0])
        x = x + [0.05, 0.01] * rng.normal(size=2)


@pytest.mark.slow
def test_new_rows_that_several_inputs_hold_are_aimed_at_by_the_same_in_c_as_in_python():
    model = km.BilinearPredictor(
        [[-0.9]], [[-1.3, -0.25]], [[[0.13]], [[0.34]]], np.eye(1), km.State(), 0.1, ["x"], ["u0", "u1"]
    )
    pair = both(km.BilinearMPC(model, km.Cost(Q=1, R=0.5), km.Limits(-1, 1), 5))
    for row in (0.0, 0.5, 0.55, -0.45, -0.58, 0.3):
        for y in (0.1, 0.9 * row):
            step(pair, [y], [row], within=1e-9)


def push(A, B, E, cost, limits, N, *products):
    """Return a BilinearMPC of x⁺ = A x + B u + E w and products (factor, map, of), each factor · (map · of)."""
    nx, nu, nw = len(A), np.shape(B)[1], np.shape(E)[1]
    v = {"x": ca.SX.sym("x", nx), "u": ca.SX.sym("u", nu), "w": ca.SX.sym("w", nw)}
    f = ca.DM(A) @ v["x"] + ca.DM(B) @ v["u"] + ca.DM(E) @ v["w"]
    for factor, maps, of in products:
        for i, by in enumerate(maps):
            f = f + v[factor][i] * (ca.DM(by) @ v[of])
    plant = km.StepMap(ca.Function("F", list(v.values()), [f]), 0.1)
    return both(km.BilinearMPC(plant, cost, limits, N))


def test_targets_that_a_jump_of_w_moves_to_other_limits_are_those_of_python():
    """Rows that no equilibrium holds, products u·w, limits active: whole Gauss–Newton steps swing from limit to limit."""
    A, B = [[0.28, -1.09], [0.76, 0.37]], [[0.58, 0.36], [0.29, 0.03]]
    N = [[[0.16, -0.22], [-0.05, -0.14]], [[0.18, 0.01], [-0.09, -0.23]]]
    P = [[[-0.11, 0.61], [0.19, 0.20]], [[-0.15, -0.49], [0.05, 0.03]]]
    cost, limits = km.Cost(Q=[0.6, 0.1], R=[0.7, 0.7]), km.Limits(u_min=-1.1, u_max=1.0)
    pair = push(A, B, [[-0.08, 0.0], [-0.08, 0.39]], cost, limits, 3, ("u", N, "x"), ("w", P, "u"))
    used = [
        step(pair, [-0.6, 0.1], row, w=W).u
        for W in ([0, 0], [-0.75, 0.93], [0.75, -0.5], [0, 0], [-0.7, 0.9])
        for row in ([0.4, -0.6], [-0.5, 0.6])
    ]
    np.testing.assert_allclose(used[-2], [-1.032, -0.871], atol=1e-3)  # not where no target was found, [-.099, -.027]


def test_a_target_that_w_takes_off_a_limit_is_found_in_c_as_in_python():
    """Close to the w that frees the input, no piece of the way settled in 40 steps: ipopt found it, and C nothing."""
    N, P, S = [[-0.25, -0.02], [0.16, 0.03]], [[-0.03], [-0.38]], [[0.13, -0.13], [-0.06, 0.08]]
    cost, limits = km.Cost(Q=[0.17, 0.9], R=0.11), km.Limits(u_min=-1.43, u_max=1.19)
    parts = ("u", [N], "x"), ("w", [P], "u"), ("w", [S], "x")
    pair = push([[0.27, -0.63], [0.26, 0.08]], [[-1.11], [0.0]], [[0.4], [0.23]], cost, limits, 6, *parts)
    for W in (0.0, -0.32):
        for _ in range(3):
            step(pair, [-0.78, -0.18], [0.96, -1.07], w=[W])


def test_a_target_in_a_corner_of_limits_is_left_in_c_as_in_python():
    """x at its limit, an input at its own: nothing is free to move, and C found no target where ipopt found one."""
    limits = km.Limits(u_min=-0.71, u_max=1.4, x_max=[0.87], x_min=[-1.41])
    parts = ("x", [[[0.15, 0.063]]], "u"), ("w", [[[-0.33, 0.24]]], "u")
    pair = push([[-0.95]], [[0.25, 0.74]], [[-0.47]], km.Cost(Q=0.5, R=[0.5, 0.5]), limits, 6, *parts)
    for y, row in ((0.21, [[-1.33], [0.85]]), (0.83, [[1.63]]), (0.5, [[0.85]]), (0.83, [[1.63]])):
        step(pair, [y], row, w=[-0.744])


def test_a_controller_that_has_seen_w_is_compiled_with_the_table_of_none():
    plant, _ = plants.make_scheduled()
    own = km.BilinearMPC(plant, km.Cost(Q=[1, 0.1], R=0.01), km.Limits(-2, 2), 8)
    own([0.4, 0.1], [0.3, 0.0], w=[0.7])
    pair = both(own)
    for each in pair:
        each.reset()
    step(pair, [0.2, 0.1], [0.3, 0.0], w=[0.7])


@pytest.mark.slow
def test_it_swings_up_in_c_as_it_does_in_python():
    plant, model = plants.make_swung()
    cost = km.Cost(Q=[5.0, 5.0, 0.1], R=0.05, of=km.Fourier(1, states=[0]) + km.State([1]))
    own, fast = both(km.BilinearMPC(model, cost, km.Limits(**BOX), 30))
    found = fast.runs(plant, [[np.pi, 0.1], [2.5, 0.0]], [0.0, 1.0, 0.0], steps=120)
    for X, U in zip(found.X, found.U, strict=True):
        run = km.simulate(plant, own, x0=X[0], reference=[0.0, 1.0, 0.0], steps=120)
        np.testing.assert_allclose(X, run.X, atol=1e-5)
        np.testing.assert_allclose(U, run.U, atol=1e-5)
        assert abs(np.cos(X[-1, 0]) - 1) < 1e-3
