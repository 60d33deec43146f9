"""Episodes keep runs apart: nothing is paired or split across them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.bare import shown
from tests.roundtrip import returned

LENGTHS = st.lists(st.integers(1, 7), min_size=1, max_size=8)


def numbered(lengths: list[int], nu: int = 2) -> km.Episodes:
    """Episodes whose entries say where they stand: x_k = (episode, k), u_k = (episode, k, …)[:nu]."""
    runs = [
        km.Episode(
            X=[(e, k) for k in range(steps + 1)],
            U=np.array([(e, k, -k) for k in range(steps)], dtype=float)[:, :nu],
        )
        for e, steps in enumerate(lengths)
    ]
    return km.Episodes(runs, dt=0.1, states=["e", "k"])


@given(LENGTHS, st.integers(0, 3))
def test_snapshots_are_what_a_plain_loop_finds(lengths: list[int], nu: int) -> None:
    data = numbered(lengths, nu)
    rows = [(run.X[k], run.U[k], run.X[k + 1]) for run in data.episodes for k in range(len(run.X) - 1)]
    pairs = data.snapshots()
    assert len(pairs) == sum(lengths) == len(rows)
    assert pairs.U.shape == (len(rows), nu)
    for (x, u, x_next), X, U, X_next in zip(rows, pairs.X, pairs.U, pairs.X_next, strict=True):
        assert np.array_equal(x, X)
        assert np.array_equal(u, U)
        assert np.array_equal(x_next, X_next)


@given(LENGTHS)
def test_no_snapshot_crosses_from_one_episode_to_the_next(lengths: list[int]) -> None:
    pairs = numbered(lengths).snapshots()
    assert (pairs.X[:, 0] == pairs.X_next[:, 0]).all()
    assert (pairs.X[:, 0] == pairs.U[:, 0]).all()
    assert (pairs.X[:, 1] + 1 == pairs.X_next[:, 1]).all()
    assert (pairs.X[:, 1] == pairs.U[:, 1]).all()


@given(st.lists(st.integers(1, 4), min_size=2, max_size=12), st.floats(0, 1), st.integers(0, 99))
def test_a_split_deals_out_whole_episodes(lengths: list[int], fraction: float, seed: int) -> None:
    data = numbered(lengths)
    if not 0 < round(fraction * len(data)) < len(data):
        with pytest.raises(km.errors.DataError, match=f"a split of {len(data)} episodes at fraction .* at least one"):
            data.split(fraction, seed)
        return
    train, held_out = data.split(fraction, seed)
    sides = [[int(run.X[0, 0]) for run in side] for side in (train, held_out)]
    assert sorted(sides[0] + sides[1]) == list(range(len(data)))
    assert len(train) == round(fraction * len(data))
    assert all(
        run == data[e]
        for side, side_e in zip((train, held_out), sides, strict=True)
        for run, e in zip(side, side_e, strict=True)
    )
    assert data.split(fraction, seed) == (train, held_out)
    assert (train.dt, train.states, train.inputs) == (data.dt, data.states, data.inputs)


def test_another_seed_splits_otherwise() -> None:
    data = numbered([1] * 30)
    assert data.split(0.5, 1)[0] != data.split(0.5, 2)[0]


@given(LENGTHS, LENGTHS)
def test_joining_and_slicing_undo_each_other(first: list[int], second: list[int]) -> None:
    a, b = numbered(first), numbered(second)
    both = a + b
    assert both[: len(a)] == a
    assert both[len(a) :] == b
    assert list(both) == [*a, *b]


def test_names_count_up_by_default() -> None:
    data = km.Episodes([km.Episode(X=np.zeros((3, 2)), U=np.zeros((2, 1)))], dt=0.1)
    assert (data.states, data.inputs, data.nx, data.nu) == (("x0", "x1"), ("u0",), 2, 1)


def test_autonomous_data_has_no_inputs() -> None:
    run = km.Episode(X=np.zeros((4, 2)))
    assert run.U.shape == (3, 0)
    assert len(run) == 3
    assert km.Episodes([run], 0.1).inputs == ()


def test_episodes_own_their_arrays_and_are_values() -> None:
    X, U = np.arange(6.0).reshape(3, 2), np.zeros((2, 1))
    data = km.Episodes([km.Episode(X=X, U=U)], dt=0.1)
    X[:] = 7
    assert data[0].X[0, 0] == 0
    assert returned(data) == data


def zeros(rows: int, moves: int, nx: int = 2, nu: int = 1) -> km.Episode:
    return km.Episode(X=np.zeros((rows, nx)), U=np.zeros((moves, nu)))


def test_what_is_no_episode_at_all() -> None:
    """What the type hook of the tests would catch first, as users see it."""
    lines = shown(
        """
X = np.zeros((4, 2))
show(lambda: km.Episodes([X], 0.1))
show(lambda: km.Episodes(X, 0.1))
show(lambda: km.Episodes(km.Episode(X=X), 0.1))
data = km.Episodes([km.Episode(X=X)] * 3, 0.1)
show(lambda: data.split(float("nan")))
show(lambda: data.split("half"))
show(lambda: data.split(0.5, rng="a"))
show(lambda: km.edmd([X], km.State()))
show(lambda: km.edmd(X, km.State()))
show(lambda: km.dmd(X))
show(lambda: km.dmdc(X))
show(lambda: km.bilinear_edmd(X, km.State()))
"""
    )
    episodes = "; pass Episodes([Episode(X=…, U=…), …], dt), what collect returns, km.data.Files(folder) or km.data.Stream(episodes)"
    assert lines == [
        "DataError episode 0 is a ndarray; pass Episode(X=…, U=…)",
        "DataError episodes is a ndarray; pass a list of Episode(X=…, U=…)",
        "DataError episodes is an Episode; pass a list of Episode(X=…, U=…)",
        "DataError fraction holds 1 NaN or inf, the first at (); remove or repair them first",
        "DataError fraction is not an array of numbers: got str, numbers cannot be None or text;"
        " pass numbers of one shape",
        "DataError rng is 'a'; pass a seed (a whole number from 0 on) or a numpy Generator",
        f"DataError episodes is a list{episodes}",
        *[f"DataError episodes is a ndarray{episodes}"] * 4,
    ]
