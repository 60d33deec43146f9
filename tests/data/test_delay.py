"""Delay: ζ row by row, episodes kept apart, and what it refuses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km


def some(seed: int, lengths: list[int], nx: int = 2, nu: int = 1, nw: int = 0) -> km.Episodes:
    rng = np.random.default_rng(seed)
    return km.Episodes(
        [
            km.Episode(
                X=rng.standard_normal((T + 1, nx)),
                U=rng.standard_normal((T, nu)),
                W=rng.standard_normal((T, nw)),
            )
            for T in lengths
        ],
        0.1,
    )


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 4), st.booleans(), st.integers(1, 3), st.integers(0, 2), st.integers(0, 99))
def test_each_point_holds_the_state_and_its_past_the_newest_first(
    d: int, inputs: bool, nx: int, nu: int, seed: int
) -> None:
    data = some(seed, [d + 3, d + 1], nx, nu, nw=1)
    seen = km.Delay(d, inputs)(data)
    for before, after in zip(data, seen, strict=True):
        assert len(after) == len(before) - d
        assert np.array_equal(after.U, before.U[d:])
        assert np.array_equal(after.W, before.W[d:])
        for k in range(d, len(before.X)):
            expected = list(before.X[k])
            for i in range(1, d + 1):
                expected += [*(before.U[k - i] if inputs else ()), *before.X[k - i]]
            assert after.X[k - d].tolist() == expected


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 4), st.booleans(), st.integers(0, 99))
def test_a_point_a_shift_and_a_rest_agree(d: int, inputs: bool, seed: int) -> None:
    data = some(seed, [d + 4])
    embedding = km.Delay(d, inputs).bind(data.states, data.inputs)
    episode, points = data[0], embedding(data)[0].X
    for k in range(d, len(episode.X)):
        history = km.Episode(X=episode.X[: k + 1], U=episode.U[:k])
        assert np.array_equal(embedding.point(episode.X[k], history), points[k - d])
    for zeta, u, zeta_next in zip(points, episode.U[d:], points[1:], strict=False):
        assert np.array_equal(embedding.shift(zeta, u, zeta_next[:2]), zeta_next)
    x, u = episode.X[0], episode.U[0]
    long = km.Episode(X=np.tile(x, (d + 2, 1)), U=np.tile(u, (d + 1, 1)))
    assert np.array_equal(embedding(km.Episodes([long], 0.1))[0].X[0], embedding.repeat(x, u))


def test_names_say_how_long_ago_and_keep_the_unit() -> None:
    named = km.Delay(2).bind(("theta [rad]", "omega"), ("u [N]",)).names
    assert named == (
        "theta [rad]",
        "omega",
        "u[k-1] [N]",
        "theta[k-1] [rad]",
        "omega[k-1]",
        "u[k-2] [N]",
        "theta[k-2] [rad]",
        "omega[k-2]",
    )
    assert km.Delay(1, inputs=False).bind(("x",), ("u",)).names == ("x", "x[k-1]")


def test_episodes_too_short_are_counted() -> None:
    data = some(0, [5, 2, 3, 1])
    with pytest.warns(km.FitWarning, match="2 of 4 episodes have 2 steps or less and are left out"):
        assert [len(e) for e in km.Delay(2)(data)] == [3, 1]
    with pytest.raises(km.errors.DataError, match="no episode is longer than the 5 steps of the embedding"):
        km.Delay(5)(data)


def test_measured_disturbances_are_no_part_of_the_past() -> None:
    data = some(0, [6], nw=2)
    embedding = km.Delay(1).bind(data.states, data.inputs)
    assert np.array_equal(embedding(data.driven())[0].X, embedding(data)[0].X)
    assert embedding(data.driven()).inputs == ("u0", "w0", "w1")


def test_a_source_of_points_asks_its_parts_for_the_past() -> None:
    data = some(0, [6, 7])
    (part,) = km.Delay(2).source(km.data.Stream([data])).parts()
    assert part.load() == km.Delay(2)(data)


def test_refusals() -> None:
    with pytest.raises(km.errors.DataError, match="steps is 0"):
        km.Delay(0)
    with pytest.raises(km.errors.DataError, match="does not know its plant yet"):
        _ = km.Delay(1).names
    embedding = km.Delay(2).bind(("a", "b"), ("u",))
    X, U = np.ones((3, 2)), np.ones((2, 1))
    with pytest.raises(km.errors.DataError, match="history has 1 steps, Delay\\(2\\) needs the last 2"):
        embedding.point(X[0], km.Episode(X=X[1:], U=U[1:]))
    with pytest.raises(km.errors.DataError, match="does not end at x"):
        embedding.point(X[0] + 1, km.Episode(X=X, U=U))
    with pytest.raises(km.errors.ShapeError, match="history has 2 states and 0 inputs, expected 2 and 1"):
        embedding.point(X[0], km.Episode(X=X))
    with pytest.raises(km.errors.DataError, match="the embedding is of a, b, u; the data hold x0, x1, u0"):
        embedding(some(0, [4]))
