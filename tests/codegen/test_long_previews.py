"""A step of a long preview asks for its first input alone where no limit can be met: the same inputs, plans, fallbacks."""

import copy

import numpy as np
import pytest

import koopmpc as km
import koopmpc.codegen.compiled

N = 70
A, B = np.array([[1.0, 0.1], [-0.1, 0.95]]), np.array([[0.0], [0.1]])


@pytest.fixture(scope="module")
def pair():
    """Return a controller whose plans have many numbers, and its twin in C."""
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("a", "b"), ("u",))
    mpc = km.KoopmanMPC(model, km.Cost([1.0, 0.1], 0.1), km.Limits(-2, 2, x_max=[1.5, np.inf]), N)
    return mpc, km.compiled(mpc)


def rows(k: int, size: float, middle: float = 0.0) -> np.ndarray:
    """Return the preview of step k: a sine of this size."""
    return np.stack([middle + size * np.sin(0.15 * (k + np.arange(N + 1))), np.zeros(N + 1)], axis=1)


@pytest.mark.parametrize(("size", "middle"), [(0.05, 0.0), (0.05, 0.8), (0.6, 0.3), (3.0, 0.0)])
def test_python_and_c_have_the_same_inputs_and_plans(pair, size, middle):
    mpc, twin = pair
    for each in pair:
        each.reset()
    x, seen = np.array([middle, 0.0]), set()
    for k in range(30):
        one, other = mpc(x, rows(k, size, middle)), twin(x, rows(k, size, middle))
        assert other.u == pytest.approx(one.u, abs=1e-9)
        assert other.status is one.status
        assert np.abs(twin.plan().U - mpc.plan().U).max() < 1e-9
        seen.add(one.status.name)
        x = A @ x + B @ one.u
    assert ("UNCONSTRAINED" in seen) is (size < 3)
    assert ("OPTIMAL" in seen or "SOFTENED" in seen) is (size > 1)


def test_a_step_without_a_measurement_goes_on_along_the_plan_that_was_not_needed(pair):
    mpc, twin = pair
    for each in pair:
        each.reset()
    x = np.array([0.1, 0.0])
    for k in range(3):
        x = A @ x + B @ mpc(x, rows(k, 0.2)).u
        twin(x, rows(k, 0.2))
    mpc(x, rows(3, 0.2)), twin(x, rows(3, 0.2))
    planned = mpc.plan().U
    fresh = copy.copy(twin)
    for each in (mpc, twin, fresh):
        for j in (1, 2, 3):  # another preview, which must not enter
            move = each([np.nan, 0.0], rows(50 + j, 0.2))
            assert move.fallback.name == "SHIFTED_PLAN"
            assert move.u == pytest.approx(planned[j], abs=1e-9)


def test_a_preview_that_stays_costs_its_product_once_and_no_digit(pair):
    _, twin = pair
    twin.reset()
    x, still = np.array([0.1, 0.0]), rows(5, 0.2)
    first, again = twin(x, still).u, twin(x, still).u
    assert again == pytest.approx(first, abs=1e-12)


@pytest.mark.parametrize(("room", "latency"), [(0, 0), (2**20, 0), (2**20, 2)])
def test_input_targets_and_limits_in_time_enter_such_a_step_as_well(monkeypatch, room, latency):
    """Input targets by their matrix and, where there is room, by a table of their steps."""
    monkeypatch.setattr(koopmpc.codegen.compiled, "_ROOM", room)
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("a", "b"), ("u",))
    waves = 1.0 + 0.5 * np.sin(0.2 * np.arange(120))[:, None]
    cost = km.Cost([1.0, 0.1], 0.1, u_target=0.2 * np.cos(0.1 * np.arange(120))[:, None])
    mpc = km.KoopmanMPC(model, cost, km.Limits(-2 * waves, waves, x_max=[1.5, np.inf]), N, latency=latency)
    twin, seen = km.compiled(mpc), set()
    for size in (0.05, 0.4, 2.0):
        x = np.array([0.1, 0.0])
        mpc.reset()
        twin.reset()
        for k in range(25):
            y = [np.nan, 0.0] if k % 9 == 8 else x
            one, other = mpc(y, rows(k, size)), twin(y, rows(k, size))
            assert other.u == pytest.approx(one.u, abs=1e-9)
            assert (other.status, other.fallback) == (one.status, one.fallback)
            seen.add(one.status.name)
            x = A @ x + B @ one.u
    assert {"UNCONSTRAINED", "BAD_MEASUREMENT"} < seen


def test_an_input_that_nobody_measured_is_replaced_before_the_whole_plan_is_made():
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("a", "b"), ("u",))
    mpc = km.KoopmanMPC(model, km.Cost([1.0, 0.1], 0.1, R_delta=0.1), km.Limits(-2, 2, du_max=0.5), N)
    twin, x = km.compiled(mpc), np.array([0.1, 0.0])
    for k in range(12):
        applied = np.array([np.nan]) if k % 3 else None
        one, other = mpc(x, rows(k, 0.4), applied), twin(x, rows(k, 0.4), applied)
        assert other.u == pytest.approx(one.u, abs=1e-9)
        x = A @ x + B @ one.u
