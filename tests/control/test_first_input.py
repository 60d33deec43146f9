"""The first input of a long preview is found alone where a bound shows that no limit is met: it is that of the plan."""

import copy
import pickle

import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.step.observe import FirstInput
from tests.control.models import linear

A, B = np.array([[1.0, 0.1], [0.15, 0.98]]), np.array([[0.005], [0.1]])
TWO = np.array([[0.005, 0.01], [0.1, -0.02]])  # two inputs
N, STEPS = 20, 60
LONG = "koopmpc.control.step.condensed.LONG"
TIMES = np.arange(float(STEPS + N + 3))
SIGNAL = 0.2 * np.sin(0.2 * TIMES)[:, None] * [1.0, 0.0]
ENDS = 6 + 2 * np.sin(0.1 * TIMES)[:, None]
FLOOR = np.column_stack([-1 + 0.3 * np.sin(0.1 * TIMES), np.full(len(TIMES), -np.inf)])
COST, PRICED = km.Cost([1, 0.1], 0.1), km.Cost([1, 0.1], 0.1, R_delta=0.4)
GIVEN = km.Cost([1, 0.1], 0.1, u_target=0.3 * np.sin(TIMES)[:, None])
CASES = {
    "box": (B, COST, km.Limits(-9, 9), SIGNAL, {}),
    "one end": (B, COST, km.Limits(u_max=9, x_min=[-1, -np.inf]), SIGNAL, {}),
    "no end": (B, COST, km.Limits(), SIGNAL, {}),
    "held blocks": (B, COST, km.Limits(-9, 9), SIGNAL, {"moves": (1, 1, 2, 4, 12)}),
    "rates": (B, PRICED, km.Limits(-9, 9, du_max=4), SIGNAL, {"latency": 1}),
    "far from 0": (B, COST, km.Limits(-9, 9), np.add(SIGNAL, [3.0, 0.0]), {}),
    "given targets": (B, GIVEN, km.Limits(-9, 9), SIGNAL, {"latency": 2}),
    "two inputs": (TWO, COST, km.Limits([-9, -8], [9, 8]), SIGNAL, {}),
    "in time": (B, COST, km.Limits(-ENDS, ENDS, x_min=FLOOR), SIGNAL, {"latency": 1}),
    "in time, given targets": (B, GIVEN, km.Limits(-ENDS, ENDS, du_max=np.full_like(ENDS, 4.0)), SIGNAL, {}),
}


@pytest.fixture
def alone(monkeypatch):
    """Previews count as long; the fixture lists of each step whether its first input was found alone."""
    monkeypatch.setattr(LONG, 0)
    found, find = [], FirstInput.find

    def watched(*arguments):
        answer = find(*arguments)
        found.append(answer is not None)
        return answer

    monkeypatch.setattr(FirstInput, "find", watched)
    return found


def make(case):
    gain, cost, limits, _, options = CASES[case]
    return km.KoopmanMPC(linear(A, gain), cost, limits, N, **options)


@pytest.mark.parametrize("case", CASES)
def test_the_first_input_and_the_plan_are_those_of_the_whole_product(case, alone, monkeypatch):
    mpc, (gain, *_, signal, _) = make(case), CASES[case]
    monkeypatch.setattr(LONG, np.inf)
    whole = make(case)
    rng, x = np.random.default_rng(0), signal[0] + [0.5, 0.0]
    for k in range(STEPS):
        reference = signal[k : k + mpc.horizon + 1].copy()
        y = np.full(2, np.nan) if k in (20, 21, 40) else x
        if k == 30:
            reference[5, 0] = np.nan
        move, other = mpc(y, reference), whole(y, reference)
        assert (move.status, move.fallback) == (other.status, other.fallback)
        np.testing.assert_allclose(move.u, other.u, rtol=0, atol=1e-9)
        plan, expected = mpc.plan() if k % 3 else None, whole.plan()
        if plan is not None and expected is not None:
            np.testing.assert_array_equal(plan.U[0], move.u)
            np.testing.assert_allclose(plan.U, expected.U, rtol=0, atol=1e-9)
            np.testing.assert_allclose(plan.X, expected.X, rtol=0, atol=1e-9)
        x = A @ x + gain @ move.u + 0.002 * rng.normal(size=2) * (20 if k % 25 == 24 else 1)
    assert sum(alone) > STEPS / 3


@pytest.mark.parametrize("ends", [(-4, 9), (-9, 4), (-6, 6)])
def test_first_inputs_are_found_alone_as_far_as_limits_reach_on_either_side(ends, alone, monkeypatch):
    mpc, met = km.KoopmanMPC(linear(A, B), COST, km.Limits(*ends), N), 0
    monkeypatch.setattr(LONG, np.inf)
    whole = km.KoopmanMPC(linear(A, B), COST, km.Limits(*ends), N)
    for sign in (1, -1):
        for k, rate in enumerate(np.linspace(0, 3, 61)):  # up to the limit, and beyond
            y, reference = [0.15, sign * rate], 0.02 * SIGNAL[k % STEPS : k % STEPS + N + 1]
            move, other = mpc(y, reference), whole(y, reference)
            met += other.u[0] in ends
            assert move.u == pytest.approx(other.u, abs=1e-9)
    assert np.mean(alone) > 0.4
    assert met > 15


@pytest.mark.parametrize("case", ["far from 0", "in time, given targets"])
def test_runs_repeat_to_the_bit_and_copies_go_on(case, monkeypatch):
    monkeypatch.setattr(LONG, 0)
    signal, mpc = CASES[case][3], make(case)

    def run(controller, first, last):
        return [controller([signal[k, 0] + 0.01 * k, 0.0], signal[k : k + N + 1]).u[0] for k in range(first, last)]

    run(mpc, 0, 25)
    twins, expected = [copy.copy(mpc), pickle.loads(pickle.dumps(mpc))], run(mpc, 25, 40)
    for twin in twins:
        assert run(twin, 25, 40) == expected
    mpc.reset()
    fresh = make(case)
    assert run(mpc, 0, 40) == run(fresh, 0, 40)
    np.testing.assert_array_equal(mpc.plan().U, fresh.plan().U)


def test_a_model_that_is_updated_has_a_bound_of_its_own(monkeypatch):
    monkeypatch.setattr(LONG, 0)
    mpc = make("box")
    for k in range(3):
        mpc([0.1, 0.0], SIGNAL[k : k + N + 1])
    other = km.KoopmanMPC(linear(A, 1.3 * B), COST, CASES["box"][2], N)
    mpc.update(linear(A, 1.3 * B))
    for k in range(3, 6):
        expected = other([0.1, 0.0], SIGNAL[k : k + N + 1]).u
        np.testing.assert_allclose(mpc([0.1, 0.0], SIGNAL[k : k + N + 1]).u, expected, rtol=0, atol=1e-9)
