"""Coverage: every sample was seen, no empty region holds one, and the words say where."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.example_plants import random_episodes
from tests.roundtrip import returned

NAMES = ("theta [rad]", "omega [rad/s]")


def cloud(rows: np.ndarray, states: tuple[str, ...] | None = None) -> km.Episodes:
    """Rows as the starts of one-step episodes."""
    return km.Episodes([km.Episode(X=[row, row]) for row in rows], 0.1, states)


@settings(max_examples=15)
@given(st.integers(0, 99), st.integers(1, 3), st.integers(0, 2), st.integers(1, 12))
def test_every_sample_was_seen_and_counted(seed: int, nx: int, nu: int, bins: int) -> None:
    data = random_episodes(seed, [30, 7, 50], nx, nu)
    found = km.validate.coverage(data, bins=bins)
    pairs = data.snapshots()
    X, V = pairs.X, np.hstack([pairs.X, pairs.U])
    assert found.seen(X, pairs.U).all()
    assert found.seen(X).all()
    assert bool(found.seen(X[0], pairs.U[0]))
    n = nx + nu
    assert np.array_equal(found.counts.sum(axis=1), np.full(n, len(X)))
    assert found.samples == len(X)
    for i in range(n):
        assert np.array_equal(found.counts[i], np.histogram(V[:, i], bins, (V[:, i].min(), V[:, i].max()))[0])
    p = 0
    for i in range(n):
        for j in range(i + 1, n):
            assert found.pairs[p].sum() == len(X)
            assert np.array_equal(found.pairs[p].sum(axis=1), found.counts[i])
            assert np.array_equal(found.pairs[p].sum(axis=0), found.counts[j])
            p += 1
    outside = V.max(axis=0) + 1e-9
    assert not found.seen(outside[:nx], outside[nx:])
    assert not found.seen(np.full(nx, np.nan))


@settings(max_examples=15)
@given(st.integers(0, 99))
def test_no_empty_region_holds_a_sample_and_none_is_larger(seed: int) -> None:
    rng = np.random.default_rng(seed)
    held = rng.uniform(size=(5, 5)) < 0.4
    cells = np.argwhere(held) + 0.5
    found = km.validate.coverage(cloud(cells), low=[0, 0], high=[5, 5], bins=5).empty
    best = 0
    for a in range(5):
        for b in range(a + 1, 6):
            for c in range(5):
                for d in range(c + 1, 6):
                    if not held[a:b, c:d].any():
                        best = max(best, (b - a) * (d - c))
    assert (found[0].share if found else 0) == pytest.approx(best / 25 if best / 25 >= 0.05 else 0)
    for region in found:
        low, high = np.maximum(region.low, 0).astype(int), np.minimum(region.high, 5).astype(int)
        assert not held[low[0] : high[0], low[1] : high[1]].any()


def test_the_words_say_where() -> None:
    rng = np.random.default_rng(0)
    rows = rng.uniform([0, -5], [3, 5], (1500, 2))
    rows = np.vstack([rows, [[0, -5], [3, 5]]])
    hole = (rows[:, 0] > 1.2) & (rows[:, 0] < 2.1) & (rows[:, 1] > 3)
    found = km.validate.coverage(cloud(rows[~hole], NAMES))
    assert str(found.empty[0]) == "theta in [1.2, 2.1] rad with omega > 3 rad/s was never visited"
    assert found.empty[0].share == pytest.approx(0.06)
    assert not found.seen([1.65, 4])
    assert found.seen([1.65, 0])
    assert found.share([1.65, 4]) == pytest.approx(2 / 3)  # theta was seen, omega too, both at once not
    gap = km.validate.coverage(cloud(rows[(rows[:, 0] < 0.9) | (rows[:, 0] > 1.8)], NAMES))
    assert str(gap.empty[0]) == "theta in [0.9, 1.8] rad was never visited"
    assert gap.occupied[0] == pytest.approx(0.7)
    wide = km.validate.coverage(cloud(rows[:-1], NAMES), low=[0, -5], high=[6, np.inf])
    assert str(wide.empty[0]) == "theta > 3 rad was never visited"
    assert wide.high[0] == 6
    assert not wide.seen([4, 0])


def test_bins_are_fewer_where_samples_are() -> None:
    rng = np.random.default_rng(1)
    for samples, bins in ((20, 2), (90, 3), (250, 5), (5000, 10)):
        assert km.validate.coverage(random_episodes(1, [samples], 1, 0)).bins == bins
    flat = km.validate.coverage(cloud(np.column_stack([rng.uniform(size=200), np.full(200, 3.0)])))
    assert flat.seen([0.5, 3.0])
    assert not flat.seen([0.5, 3.1])
    assert flat.empty == ()


def test_many_coordinates_are_looked_at_one_by_one() -> None:
    found = km.validate.coverage(random_episodes(2, [300], 41, 0))
    assert found.pairs.shape == (0, 5, 5)
    assert found.empty == ()
    assert found.seen(np.zeros(41))


def test_it_is_a_value_and_refuses_what_does_not_fit() -> None:
    data = random_episodes(3, [100], 2, 1)
    found = km.validate.coverage(data)
    assert returned(found) == found
    with pytest.raises(km.errors.ShapeError, match=r"x and u have shapes \(3,\) and \(1,\), the coverage has 2 states"):
        found.seen([0, 0, 0], [0])
    with pytest.raises(km.errors.ShapeError, match="pass"):
        found.seen(np.zeros((4, 2)), np.zeros((3, 1)))
    with pytest.raises(km.errors.DataError, match="coverage limits cross at index 0"):
        km.validate.coverage(data, low=[1, 0, 0], high=[0, 1, 1])
    with pytest.raises(km.errors.DataError, match="bins is 0"):
        km.validate.coverage(data, bins=0)
