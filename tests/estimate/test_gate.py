"""The gate of readings by itself: rounding and units decide nothing, and the bound is eight running deviations."""

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koopmpc.estimate.gate import BEYOND, LEAST, REFUSALS, ReadingGate

BIT = 2.0**-52


@pytest.mark.parametrize("leaps", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_a_gate_refuses_what_it_would_refuse_of_predictions_that_differ_in_their_last_bit(seed, leaps):
    """A model that is exact, an output that moves, one that rests away from zero, and at times a real misfit."""
    rng, gates = np.random.default_rng(seed), [ReadingGate(2, leaps) for _ in range(3)]
    judged = []
    for k in range(150):
        y = np.array([np.sin(0.3 * k) + 1.5, 5.0])
        misfit = rng.normal(size=2) * (rng.choice([0.0, 3.0, 50.0], p=[0.8, 0.15, 0.05]) if k > 2 else 0.0)
        bits = BIT * rng.integers(-1, 2, 2)
        judged.append(
            [gate.judge(y + misfit, y * (1 + share * bits)) for gate, share in zip(gates, (0, 1, 3), strict=True)]
        )
    assert all(len(set(row)) == 1 for row in judged)
    assert any(row[0] for row in judged)


@given(st.integers(0, 10**6), st.lists(st.floats(-6, 6), min_size=2, max_size=2), st.booleans())
def test_units_do_not_decide_what_is_refused(seed, powers, leaps):
    rng, scale = np.random.default_rng(seed), 10.0 ** np.array(powers)
    gate, scaled = ReadingGate(2, leaps), ReadingGate(2, leaps)
    for _ in range(80):
        predicted = rng.normal(size=2)
        y = predicted + rng.normal(size=2) * rng.choice([0.1, 0.1, 0.1, 20.0])
        assert gate.judge(y, predicted) == scaled.judge(scale * y, scale * predicted)
        assert gate.lost == scaled.lost


def test_the_bound_follows_the_spread_of_the_innovations_and_the_steps_of_the_output():
    """At rest: eight times the running deviation, or what 1 % of the largest step makes of it."""
    for spread in (1e-3, 1e-2):
        gate, rng = ReadingGate(1), np.random.default_rng(0)
        for _ in range(400):
            assert not gate.judge(spread * rng.normal(size=1), np.zeros(1))
        wild = [
            size for size in (4, 6, 8, 10, 12, 14) if copy.deepcopy(gate).judge(np.array([size * spread]), np.zeros(1))
        ]
        assert 14 in wild
        assert 4 not in wild
    gate = ReadingGate(1)
    for k in range(100):  # exact predictions, and a step of 1 in the middle
        gate.judge(np.array([float(k > 30)]), np.array([float(k > 30)]))
    assert not copy.deepcopy(gate).judge(np.array([1 + 0.9 * BEYOND * LEAST]), np.ones(1))
    assert gate.judge(np.array([1 + 1.1 * BEYOND * LEAST]), np.ones(1))


def test_the_bound_is_eight_times_the_size_above_which_an_innovation_widens_it():
    """Predictions are the last readings, so that no predicted step adds to the bound."""

    def least(holds) -> float:
        low, high = 0.0, 1e3
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (low, middle) if holds(middle) else (middle, high)
        return high

    def is_refused(gate: ReadingGate, size: float) -> bool:
        return copy.deepcopy(gate).judge(np.array([last + size]), np.array([last]))

    def bound_after(gate: ReadingGate, size: float) -> float:
        after = copy.deepcopy(gate)
        assert not after.judge(np.array([last + size]), np.array([last]))
        at = np.array([last + size])
        return least(lambda more: copy.deepcopy(after).judge(at + more, at))

    for seed in range(3):
        gate, rng, last = ReadingGate(1), np.random.default_rng(seed), 0.0
        for _ in range(100):
            y = last + rng.normal()
            gate.judge(np.array([y]), np.array([last]))
            last = y
        bound = least(lambda size, gate=gate: is_refused(gate, size))
        deviation = least(lambda size, gate=gate, bound=bound: size >= bound or bound_after(gate, size) > bound)
        assert abs(bound / deviation - 8.0) < 1e-6


def test_a_reading_that_stays_at_zero_against_every_prediction_is_no_lost_estimate_for_long():
    gate, lost = ReadingGate(2), 0
    for _ in range(50):
        gate.judge(np.array([0.01, 0.0]), np.array([0.01, 1e-3]))
        lost += gate.lost
    assert lost <= 3


def test_an_output_that_falls_beside_its_prediction_starts_the_estimate_again_twelve_times_and_no_more():
    gate, lost = ReadingGate(1), []
    for k in range(30):
        gate.judge(np.array([1e-5 if k % 2 else 1.0]), np.array([1.0]))
        lost.append(gate.lost)
    assert sum(lost) == 2 * REFUSALS
    gate = ReadingGate(1)
    for y in (1.0, 1e-5, 1e-9):  # as predicted
        gate.judge(np.array([y]), np.array([y]))
        assert not gate.lost
