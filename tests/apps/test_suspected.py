"""Rows that look faulty are left out of a record only where models do better without them."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.apps.fitting.repair import audit_episodes


def tank(rows, seed=0, quantum=0.0):
    """Return a record of a slow tank with a valve that moves in steps: y⁺ = y + 0.05 (u − √y)."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.6, 1.6, rows // 15 + 1), 15)[:rows] + 0.02 * rng.standard_normal(rows)
    y = np.ones(rows + 1)
    for k in range(rows):
        y[k + 1] = y[k] + 0.05 * (u[k] - np.sqrt(max(y[k], 0.0)))
    y += 1e-3 * rng.standard_normal(rows + 1)
    return (np.round(y / quantum) * quantum if quantum else y), u


def record(y, u):
    return km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 1.0, ["level"], ["valve"])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_fifth_of_a_record_that_is_stuck_goes_from_learned_and_unseen_parts_alike(seed):
    y, u = tank(2000, seed)
    stuck = np.zeros(2001, dtype=bool)
    for first in range(60, 1960, 200):
        stuck[first : first + 40] = True
        y[first : first + 40] = y[first]
    rest, notes, *_ = audit_episodes(record(y, u))
    assert any("were left out" in note for note in notes)
    kept = np.concatenate([e.X[:, 0] for e in rest])
    values, counts = np.unique(kept, return_counts=True)
    assert counts.max() < 12, f"{values[counts.argmax()]} is repeated {counts.max()} times"
    assert len(kept) > 0.75 * 2001


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_equal_neighbours_of_a_slow_and_quantised_sensor_stay(seed):
    y, u = tank(2000, seed, quantum=0.01)
    data = record(y, u)
    rest, notes, *_ = audit_episodes(data)
    assert len(rest) == 1
    assert len(rest[0]) == len(data[0])
    assert not any("left out" in note for note in notes)


def test_rows_at_both_rails_stay_unless_models_do_better_without_them():
    y, u = tank(2000)
    clipped = np.clip(y, np.quantile(y, 0.02), np.quantile(y, 0.98))
    rest, notes, *_ = audit_episodes(record(clipped, u))
    (note,) = [note for note in notes if note.startswith("sensor at its limit")]
    assert ("were kept" in note) == (sum(map(len, rest)) == 2000)
    assert len(rest) < 10 or "were left out" in note


def test_single_wild_readings_always_go_and_leave_the_record_in_one_piece():
    y, u = tank(1500)
    y[[200, 700, 1100]] += 3.0
    rest, notes, *_ = audit_episodes(record(y, u))
    assert max(float(e.X.max()) for e in rest) < 3.0
    assert len(rest) == 1
    assert any(note.startswith("spikes") and "replaced by the line" in note for note in notes)


def test_a_column_that_repeats_another_hides_no_effect_of_an_input():
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, 600), np.zeros(601)
    for k in range(600):
        y[k + 1] = 0.9 * y[k] + 0.5 * u[k]
    y += 0.01 * rng.standard_normal(601)
    twice = km.Episodes([km.Episode(X=np.column_stack([y, y]), U=u[:, None])], 1.0, ["level", "copy"], ["valve"])
    assert audit_episodes(twice).notes == audit_episodes(record(y, u)).notes
    assert audit_episodes(twice).rest.nx == 2  # they are left out later, and that is said


def test_a_coarse_sensor_whose_changes_are_mostly_zero_is_said_to_show_that():
    y, u = tank(2000, quantum=0.05)
    (note,) = [note for note in audit_episodes(record(y, u)).notes if note.startswith("quantised")]
    assert "half of its changes from row to row are zero" in note


def test_a_sensor_at_its_limit_is_no_held_sample_and_makes_no_input_a_feedback():
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, 600), np.zeros(601)
    for k in range(600):
        y[k + 1] = 0.9 * y[k] + 0.5 * u[k]
    y = np.clip(y + 0.01 * rng.standard_normal(601), -0.5, 0.5)
    notes = audit_episodes(record(y, u)).notes
    assert any(note.startswith("sensor at its limit") for note in notes)
    assert not any(note.startswith(("held samples", "rows twice")) or "feedback" in note for note in notes)
