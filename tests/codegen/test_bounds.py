"""Limits in time and prices in C: rows of bounds as arguments give what Python gives, step by step."""

import copy
import pickle
import subprocess

import casadi as ca
import numpy as np
import pytest
from scipy.signal import StateSpace

import koopmpc as km
from tests.compiler import find_compiler, needs_compiler

pytestmark = needs_compiler

A, B = np.array([[1.0, 0.2], [-0.1, 0.9]]), np.array([[0.02, 0.01], [0.2, -0.1]])
MODEL = km.LinearPredictor.from_state_space(StateSpace(A, B, np.eye(2), np.zeros((2, 2)), dt=0.2), inputs=("a", "b"))
COST = km.Cost(Q=[1, 0.5], R=0.05)
ROWS = np.random.default_rng(0).uniform(0.3, 1.2, (40, 2))
WAVES = 0.75 + 0.35 * np.cos(np.arange(40)[:, None] / [3, 2] + [0, 2])
FLAT = 1e-4  # where interior points end, rounding of y moves u by as much: the cost is flat there
slow = pytest.mark.slow


def compile_mpc(limits, N=6, cost=COST, **options):
    mpc = km.KoopmanMPC(MODEL, cost, limits, N, **options)
    fast = km.compiled(mpc)
    assert fast is not mpc
    return mpc, fast


def compile_bilinear(limits, N=6, **options):
    """A BilinearMPC of equations in which an input multiplies a state."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    plant = km.StepMap(ca.Function("F", [x, u], [A @ x + B @ u + 0.1 * u[0] * ca.vertcat(0, x[0])]), 0.2)
    mpc = km.BilinearMPC(plant, km.Cost(Q=[1, 0.5], R=0.3, **options.pop("cost", {})), limits, N, **options)
    fast = km.compiled(mpc)
    assert fast is not mpc
    return mpc, fast


def require_parity(mpc, fast, steps=40, calls=None, within=1e-6):
    rng, x = np.random.default_rng(1), np.array([1.0, -0.5])
    mpc.reset()
    fast.reset()
    seen = set()
    for k in range(steps):
        reference = np.array([1.2 * np.sin(k / 6), 0.2])
        limits = calls(k) if calls else None
        y = np.array([np.nan, 0.0]) if k % 13 == 7 else x
        one, other = mpc(y, reference, limits=limits), fast(y, reference, limits=limits)
        np.testing.assert_allclose(other.u, one.u, atol=within)
        assert (other.status, other.fallback) == (one.status, one.fallback)
        assert other.slack == pytest.approx(one.slack, abs=within)
        seen.add(one.status.name)
        x = A @ x + B @ one.u + rng.normal(0, 0.02, 2)
    return seen


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"latency": 1}, marks=slow),
        {"moves": {"a": (1, 1, 4), "b": (2, 4)}},
        pytest.param({"estimator": km.LiftedDisturbance()}, marks=slow),
    ],
)
@pytest.mark.parametrize(
    "rates", [{}, {"du_max": [0.3, 0.4]}, pytest.param({"du_max": 0.3, "du_slack": (9, 9)}, marks=slow)]
)
def test_rows_of_bounds_in_c_give_what_python_gives(options, rates):
    limits = km.Limits(u_min=-1, u_max=ROWS, x_min=-1.5, x_max=ROWS[::-1], margin=[[0.01, 0.02]], **rates)
    assert {"OPTIMAL", "SOFTENED"} <= require_parity(*compile_mpc(limits, **options))


@pytest.mark.parametrize(
    "options",
    [
        {"estimator": km.LiftedDisturbance()},
        pytest.param({}, marks=slow),
        pytest.param({"cost": {"R_delta": 0.1}, "latency": 1, "estimator": km.LiftedDisturbance()}, marks=slow),
    ],
)
@pytest.mark.parametrize(
    "more",
    [
        {"slack": None, "du_max": 0.4},
        pytest.param({}, marks=slow),
        pytest.param({"du_max": 0.3, "du_slack": (9, 9)}, marks=slow),
    ],
)
def test_rows_of_bounds_in_the_c_of_a_bilinear_mpc_give_what_python_gives(options, more):
    low = np.where(np.arange(40)[:, None] % 9 == 4, -np.inf, -1.1)  # rows without a limit
    bounds = {"u_min": -1, "u_max": WAVES, "x_min": low * [1, 1], "x_max": WAVES[::-1] + 0.1}
    limits = km.Limits(**{"slack": (20.0, 5.0), **bounds, **more}, margin=[[0.01, 0.02]])
    seen = require_parity(*compile_bilinear(limits, **options), within=FLAT)
    assert {"OPTIMAL", "SOFTENED" if more.get("slack", 1) else "INFEASIBLE"} <= seen


def test_limits_of_a_call_reach_the_c_of_a_bilinear_mpc():
    limits = km.Limits(u_min=-1, u_max=1, x_max=2, rows=("u_max",))
    mpc, fast = compile_bilinear(limits)
    at_call = limits.with_bounds(u_max=ROWS, x_max=[0.4, 0.3])
    require_parity(mpc, fast, calls=lambda k: None if k % 3 == 0 else at_call, within=FLAT)
    with pytest.raises(km.errors.DataError, match="lower limit at step 0"):
        fast([0, 0], [0, 0], limits=limits.with_bounds(x_min=-1))


@pytest.mark.parametrize("limits", [{"x_max": ROWS, "du_max": 0.3}, {}])
def test_the_c_of_bounds_has_no_warning(limits, tmp_path):
    mpc = km.KoopmanMPC(MODEL, COST, km.Limits(u_min=-1, u_max=ROWS, **limits), 4, estimator=km.LiftedDisturbance())
    require_strict(mpc, tmp_path / "c")


def test_the_c_of_bounds_of_a_bilinear_mpc_has_no_warning(tmp_path):
    require_strict(compile_bilinear(km.Limits(-1, ROWS, x_max=1, du_max=0.3))[0], tmp_path / "c")


def require_strict(mpc, path):
    folder = km.export(mpc, path)
    compiler = f"CC={' '.join(find_compiler() or ())}"
    done = subprocess.run(["make", "-s", "strict", compiler], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_rows_at_a_call_hold_for_that_call():
    limits = km.Limits(u_min=-1, u_max=1, rows=("x_max",))
    mpc, fast = compile_mpc(limits)
    at_call = limits.with_bounds(u_max=ROWS, x_max=[0.4, 0.3])
    require_parity(mpc, fast, calls=lambda k: None if k % 3 == 0 else at_call)
    with pytest.raises(km.errors.DataError, match="without a limit there"):
        fast([0, 0], [0, 0], limits=limits.with_bounds(du_max=0.1))


def test_constant_rows_give_the_same_inputs_as_the_constant_limits():
    plain, rows = (compile_mpc(km.Limits(u_min=-1, u_max=end, x_max=0.8))[1] for end in (0.7, np.full((3, 2), 0.7)))
    x = np.array([1.0, -0.5])
    for _ in range(15):
        u = plain(x, [1, 0]).u
        np.testing.assert_allclose(rows(x, [1, 0]).u, u, atol=1e-12)
        x = A @ x + B @ u


def test_copies_go_on_at_the_same_row():
    _, fast = compile_mpc(km.Limits(u_min=-1, u_max=ROWS))
    for _ in range(5):
        fast([1.0, -0.5], [1, 0])
    twins = copy.copy(fast), pickle.loads(pickle.dumps(fast))
    u = fast([0.8, -0.5], [1, 0]).u
    for twin in twins:
        np.testing.assert_array_equal(twin([0.8, -0.5], [1, 0]).u, u)


def test_copies_forget_the_limits_of_a_call_as_the_original_does():
    limits = km.Limits(u_min=-1, u_max=1, rows=("x_max",))
    _, fast = compile_mpc(limits)
    at_call = limits.with_bounds(u_max=0.2)
    held = fast([1.0, -0.5], [0, 0], limits=at_call).u
    twin, same = pickle.loads(pickle.dumps((fast, at_call)))
    np.testing.assert_allclose(twin([1.0, -0.5], [0, 0], limits=same).u, held, atol=1e-9)
    fast.rehearse()
    twins = copy.copy(fast), pickle.loads(pickle.dumps(fast))
    u = fast([1.0, -0.5], [1, 0]).u
    assert u.max() > 0.2
    for twin in twins:
        np.testing.assert_array_equal(twin([1.0, -0.5], [1, 0]).u, u)


def test_code_without_rows_refuses_limits_of_a_call():
    _, fast = compile_mpc(km.Limits(u_min=-1, u_max=1))
    with pytest.raises(km.errors.DataError, match="keeps its own"):
        fast([0, 0], [0, 0], limits=km.Limits(u_min=-1, u_max=0.5))


@pytest.mark.parametrize("target", ["equilibrium", "zero", [[0.1, 0.0], [0.2, 0.1]]])
def test_prices_in_c_give_what_python_gives(target):
    price = np.random.default_rng(2).uniform(-0.2, 0.2, (9, 2))
    cost = km.Cost(Q=[1, 0.5], R=0.05, price=price, u_target=target)
    require_parity(*compile_mpc(km.Limits(u_min=-1, u_max=1), cost=cost), steps=20)


def test_pages_of_limits_are_turned_where_one_ends_and_where_a_run_begins_again(monkeypatch):
    monkeypatch.setattr("koopmpc.codegen.compiled._PAGE", 7)
    mpc, fast = compile_mpc(km.Limits(-ROWS, WAVES, x_max=[1.4, np.inf]))
    for _ in range(2):
        assert "UNCONSTRAINED" in require_parity(mpc, fast, 50)
    one, other = mpc([0.1, 0.0], [0.0, 0.0]), pickle.loads(pickle.dumps(fast))([0.1, 0.0], [0.0, 0.0])
    np.testing.assert_allclose(other.u, one.u, atol=1e-6)


def test_the_same_limits_at_a_call_hold_as_long_as_they_are_passed_and_no_longer():
    mpc, fast = compile_mpc(km.Limits(-1, 1, rows=("u_max",)))
    narrow = mpc.limits.with_bounds(u_max=0.2)
    assert "OPTIMAL" in require_parity(mpc, fast, 30, lambda k: narrow if k % 7 in (1, 2, 3) else None)


def test_limits_that_were_refused_do_not_enter_a_copy():
    _, fast = compile_mpc(km.Limits(-1, 1, rows=("u_max",)))
    narrow, short = fast.limits.with_bounds(u_max=0.2), fast.limits.with_bounds(u_max=np.ones((2, 2)))
    y, r = [1.0, 0.0], [0.0, 0.0]
    used = fast(y, r, limits=narrow).u
    with pytest.raises(km.errors.ShapeError):
        fast(y, r, limits=short)
    np.testing.assert_allclose(copy.copy(fast)(y, r, limits=narrow).u, used, atol=1e-9)


def test_targets_that_limits_in_time_push_are_pushed_in_c_too():
    """Small references need no look at their targets, large ones do: the border is that of the limits ahead."""
    limits = km.Limits(-ROWS, WAVES, x_min=-WAVES, x_max=WAVES)
    mpc, fast = compile_mpc(limits)
    for size in (0.01, 0.1, 0.3, 1.0, 3.0):
        mpc.reset()
        fast.reset()
        for k in range(12):
            r = size * np.array([np.cos(k), np.sin(k)])
            np.testing.assert_allclose(fast([0.1, 0.0], r).u, mpc([0.1, 0.0], r).u, atol=1e-6)


@pytest.mark.parametrize("make", [compile_mpc, pytest.param(compile_bilinear, marks=slow)])
def test_in_c_weights_stand_for_priorities(make):
    limits = km.Limits(u_min=-0.6, u_max=0.6, x_max=[0.2, 0.1], x_min=[-0.3, -0.2], priority=[1, 0])
    mpc, fast = make(limits)
    assert "SOFTENED" in require_parity(mpc, fast, within=1e-5)


def test_four_priorities_are_too_many_for_c():
    limits = km.Limits(x_max=0.3, of=km.State(), y_max=0.2, priority=[0, 1, 2, 3])
    with pytest.raises(km.errors.DataError, match="can tell 3 apart"):
        km.KoopmanMPC(MODEL, COST, limits, 6).build_program(None)
