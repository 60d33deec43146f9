"""A Mender: single wrong measurements are found and replaced, and sound data stay as they are."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.data.test_smoother import linear_data, noisy, pendulum_data, spread
from tests.searches import select


def spoilt(clean: km.Episodes, places: list[tuple[int, int, int]], size: float) -> km.Episodes:
    """Return the data with `size` spreads added to these (episode, row, state)."""
    X, own = [episode.X.copy() for episode in clean], spread(clean)
    for i, k, j in places:
        X[i][k, j] += size * own[j]
    return clean.with_episodes([km.Episode(X=x, U=e.U) for x, e in zip(X, clean, strict=True)])


def found(data: km.Episodes) -> list[tuple[int, int, int]]:
    return [(one.episode, one.row, one.state) for one in km.data.Mender.of(data).glitches(data)]


@pytest.mark.parametrize("size", [5.0, -50.0, 1e4])
@pytest.mark.parametrize("share", [0.0, 0.02])
def test_a_wrong_measurement_is_found_and_nearly_undone(size: float, share: float) -> None:
    clean, places = noisy(pendulum_data(), share), [(3, 11, 0), (17, 25, 1), (29, 4, 0)]
    data = spoilt(clean, places, size)
    mender = km.data.Mender.of(data)
    assert [(one.episode, one.row, one.state) for one in mender.glitches(data)] == places
    for one, whole in zip(mender(data), clean, strict=True):
        assert (np.abs(one.X - whole.X) < 0.5 * spread(clean)).all()


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4), st.sampled_from([0.0, 0.02, 0.2]))
def test_random_linear_plants_have_no_glitches_but_those_that_were_made(seed: int, nx: int, process: float) -> None:
    rng = np.random.default_rng(seed)
    clean = noisy(linear_data(rng, nx, process), 0.01, seed)
    assert found(clean) == []
    place = (int(rng.integers(40)), int(rng.integers(5, 35)), int(rng.integers(nx)))
    assert place in found(spoilt(clean, [place], 30.0))


def test_a_plant_that_jumps_and_goes_on_from_there_is_no_glitch() -> None:
    """After a kick in the middle of an episode all later rows are where it went."""
    clean = linear_data(np.random.default_rng(2), 2)
    kicked = clean[5].X.copy()
    step = np.eye(2)
    model = km.dmdc(clean)
    for k in range(20, 41):
        kicked[k] += step @ (6 * spread(clean))
        step = model.A @ step
    data = clean.with_episodes([*clean[:5], km.Episode(X=kicked, U=clean[5].U), *clean[6:]])
    assert found(data) == []


def test_units_and_origin_do_not_count() -> None:
    data = spoilt(noisy(pendulum_data(), 0.02), [(3, 11, 0), (7, 20, 1)], 6.0)
    other = data.with_episodes([km.Episode(X=e.X * [1e3, 1e-4] + [5e3, -2e-4], U=1e-2 * e.U + 7) for e in data])
    assert found(other) == found(data) == [(3, 11, 0), (7, 20, 1)]


def test_a_measurement_is_trusted_to_a_tenth_of_what_the_model_misses_at_best() -> None:
    exact, noisy_one = (km.data.Mender.of(noisy(pendulum_data(), share)).smoother for share in (0.0, 0.2))
    assert (exact.noise / exact.missed).min() == pytest.approx(0.1, rel=1e-9)
    assert (exact.noise < 0.3 * exact.missed).all()
    assert (noisy_one.noise > noisy_one.missed).all()


def test_glitches_of_a_long_episode_are_found_wherever_they_are() -> None:
    long = noisy(pendulum_data(episodes=2, steps=2500), 0.01)
    places = [(0, 7, 0), (0, 1001, 1), (0, 1249, 0), (1, 2490, 1)]
    assert found(spoilt(long, places, 8.0)) == places


def test_what_is_told_of_a_sample_mends_the_rest() -> None:
    data = spoilt(noisy(pendulum_data(), 0.01), [(3, 11, 0), (31, 11, 1)], 20.0)
    mender = km.data.Mender.of(data[:20])
    assert [(one.episode, one.row) for one in mender.glitches(data[20:])] == [(11, 11)]


def test_a_model_of_spoilt_data_is_nearly_that_of_sound_ones_and_the_notes_say_why() -> None:
    clean = pendulum_data()
    data = spoilt(clean, [(5, 9, 0), (12, 21, 1)], 40.0)
    options: Any = {"candidates": [km.State() + km.Constant() + km.Monomials(3)], "delays": [0], "horizon": 10}
    held_out = pendulum_data(episodes=50)[40:]
    errors = [km.score(select(each, **options).linear, held_out, 10).rmse.mean() for each in (clean, data)]
    assert errors[1] < 1.1 * errors[0]
    with pytest.warns(km.FitWarning, match="run away"):
        select(data, smooth=False, **options)
    note = next(note for note in select(data, **options).notes if "replaced" in note)
    assert "theta" in note
    assert "row 9 of episode 5" in note
