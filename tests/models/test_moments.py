"""Moments are sums: order, grouping and chunks change nothing, and no pair spans two episodes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.models.plants import brute_force, random_episodes

LENGTHS = st.lists(st.integers(1, 9), min_size=1, max_size=8)
LIFTING = km.Constant() + km.State() + km.Monomials(2)


def gram(m: km.moments.Moments) -> np.ndarray:
    return m.sums if m.route == "gram" else m.sums.T @ m.sums


def close(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a - b).max() <= 1e-12 * max(np.abs(b).max(), 1))


@given(LENGTHS, st.integers(1, 3), st.integers(0, 2), st.integers(0, 999), st.sampled_from(["gram", "qr"]))
def test_moments_are_the_products_of_the_rows_of_each_episode(
    lengths: list[int], nx: int, nu: int, seed: int, route: str
) -> None:
    data = random_episodes(seed, lengths, nx, nu)
    m = km.moments.second_moments(data, LIFTING, route=route)
    D = brute_force(data, LIFTING.bind(data.states))
    assert m.samples == sum(lengths) == len(D)
    assert close(gram(m), D.T @ D)


def test_each_chunk_is_lifted_once_where_gram_sums_serve(monkeypatch: pytest.MonkeyPatch) -> None:
    data = random_episodes(0, [3000] * 4, 2, 1)
    lifted: list[int] = []
    count = km.State.lift_into
    monkeypatch.setattr(km.State, "lift_into", lambda self, X, Z: (lifted.append(len(X)), count(self, X, Z))[1])
    km.edmd(data, km.State())
    assert sum(lifted) <= 12_000 * (1 + 2 / 1023) + 4


def test_a_long_episode_in_many_chunks_equals_its_parts() -> None:
    data = random_episodes(0, [5000], 2, 1)
    X, U = data[0].X, data[0].U
    cuts = [0, 1, 1023, 1024, 3333, 5000]
    parts = [km.Episode(X=X[a : b + 1], U=U[a:b]) for a, b in pairwise(cuts)]  # neighbours share a state and no pair
    for route in ("gram", "qr"):
        a = km.moments.second_moments(data, LIFTING, route=route)
        b = km.moments.second_moments(km.Episodes(parts, data.dt), LIFTING, route=route)
        assert a.samples == b.samples == 5000
        assert close(gram(a), gram(b))


def test_a_huge_last_state_takes_no_digits_from_the_others() -> None:
    huge = np.append(np.ones(50), 1e9)[:, None]
    given = random_episodes(0, [50] * 20, 2, 1)
    data = km.Episodes([km.Episode(X=e.X * huge, U=e.U) for e in given], given.dt)
    m = km.moments.second_moments(data, km.State(), route="gram")
    now = np.vstack([np.hstack([e.X[:-1], e.U]) for e in data])
    assert close(m.sums[np.ix_(m.columns.regressors, m.columns.regressors)], now.T @ now)


def test_weights_of_one_are_no_weights() -> None:
    data = random_episodes(1, [1, 30, 1, 1, 500, 2, 900, 1], 2, 1)
    for bilinear in (False, True):
        plain = km.moments.second_moments(data, LIFTING, route="gram", bilinear=bilinear)
        weighted = km.moments.second_moments(data, LIFTING, route="gram", bilinear=bilinear, weights=[1.0] * len(data))
        assert close(plain.sums, weighted.sums)


def test_one_source_gives_the_same_bits_each_time() -> None:
    data = random_episodes(0, [700] * 5, 2, 1)
    assert km.moments.second_moments(data, LIFTING) == km.moments.second_moments(data, LIFTING)


def test_a_state_that_the_lifting_lacks_is_appended_to_the_rows() -> None:
    data = random_episodes(0, [20], 2, 1)
    m = km.moments.second_moments(data, km.Fourier(1), route="gram")
    assert m.nz == 4
    assert m.columns.full.names == (*m.lifting.names, *data.states)
    D = brute_force(data, m.columns.full)
    assert close(m.sums, D.T @ D)
    assert D[:, m.columns.regressors].shape[1] == 5
    assert np.allclose(D[:, m.columns.targets[4:]], data[0].X[1:])


@pytest.mark.parametrize("route", ["gram", "qr"])
def test_rows_have_the_second_moments_of_the_columns_asked_for(route: str) -> None:
    data = random_episodes(3, [60, 40], 2, 1)
    m = km.moments.second_moments(data, LIFTING, route=route)
    D = brute_force(data, m.columns.full)
    rows = m.rows(m.columns.regressors, m.columns.targets)
    P, T = D[:, m.columns.regressors], D[:, m.columns.targets]
    assert np.allclose(rows.P.T @ rows.P, P.T @ P, rtol=0, atol=1e-10)
    assert np.allclose(rows.P.T @ rows.T, P.T @ T, rtol=0, atol=1e-10)
    assert np.allclose(np.sum(rows.T**2, axis=0) + rows.rest, np.sum(T**2, axis=0))
    K = np.linalg.lstsq(P, T, rcond=None)[0]
    size = np.sqrt(np.mean((T - P @ K) ** 2, axis=0))
    # a target that P holds exactly (the constant) has a residual of the rounding of its sums
    assert np.allclose(rows.residual(np.arange(T.shape[1]), K), size, rtol=1e-9, atol=1e-6)


def nearly_parallel(gap: float, count: int = 400) -> tuple[km.Episodes, np.ndarray]:
    """Data whose states differ by `gap`: scaled cond(Z) ≈ 2/gap; and the A that made them."""
    rng = np.random.default_rng(1)
    A = np.array([[0.5, 0.25], [-0.75, 0.5]])
    starts = rng.uniform(-1, 1, count)
    X = np.column_stack([starts, starts + gap * rng.uniform(-1, 1, count)])
    return km.Episodes([km.Episode(X=[x, A @ x]) for x in X], 0.1), A


@pytest.mark.parametrize(("gap", "route"), [(1e-3, "gram"), (1e-5, "gram"), (1e-7, "qr"), (1e-10, "qr")])
def test_the_condition_number_chooses_the_route(gap: float, route: str) -> None:
    data, _ = nearly_parallel(gap)
    m = km.moments.second_moments(data, km.State())
    assert m.route == route
    D = brute_force(data, m.lifting)[:, :2]
    assert m.condition == pytest.approx(np.linalg.cond(D / np.linalg.norm(D, axis=0)), rel=1e-3)


def test_one_huge_state_that_makes_the_columns_parallel_has_all_data_read_again() -> None:
    data = random_episodes(0, [1023] * 12, 2, 0)
    parts = list(data)
    wild = np.array(parts[2].X)
    wild[500] = [1e9, 1e9]
    parts[2] = km.Episode(X=wild)
    spoiled = km.Episodes(parts, data.dt)
    assert km.moments.second_moments(data, km.State()).route == "gram"
    m = km.moments.second_moments(spoiled, km.State())
    assert m.condition > 1e6
    assert m.route == "qr"


def test_columns_are_scaled_before_they_are_judged() -> None:
    data = random_episodes(0, [300], 3, 0)
    D = [1.0, 1e9, 1e-9]
    scaled = km.Episodes([km.Episode(X=e.X * D) for e in data], data.dt)
    assert km.moments.second_moments(scaled, km.State()).route == "gram"
    assert km.moments.second_moments(scaled, km.State()).condition == pytest.approx(
        km.moments.second_moments(data, km.State()).condition
    )


def test_a_triangle_and_gram_sums_become_gram_sums_and_warn() -> None:
    data = random_episodes(0, [30, 30], 2, 1)
    a, b = (
        km.moments.second_moments(data[:1], LIFTING, route="qr"),
        km.moments.second_moments(data[1:], LIFTING, route="gram"),
    )
    with pytest.warns(km.FitWarning, match="triangular factor was added to Gram sums.*half the digits"):
        total = a + b
    assert total.route == "gram"
    assert close(total.sums, gram(km.moments.second_moments(data, LIFTING, route="gram")))


def test_moments_of_other_liftings_do_not_add() -> None:
    data = random_episodes(0, [30], 2, 1)
    a = km.moments.second_moments(data, LIFTING)
    with pytest.raises(km.errors.DataError, match="moments differ in lifting, inputs or dt"):
        _ = a + km.moments.second_moments(data, km.State())
    with pytest.raises(km.errors.DataError, match="one plant in one lifting"):
        _ = a + replace(a, dt=0.2)


@pytest.mark.parametrize("route", ["gram", "qr"])
@pytest.mark.parametrize("k", [0, 3, 19])
def test_by_either_route_the_observable_that_is_infinite_is_named_wherever_it_is(route: str, k: int) -> None:
    x = np.linspace(1.0, 2.0, 21)
    x[k] = 0.0
    lifting = km.State() + km.Expressions(lambda x: [1 / x[0]], ["1/x"])
    data = km.Episodes([km.Episode(X=x[:, None])], 0.1)
    with (
        np.errstate(divide="ignore"),
        pytest.raises(km.errors.DataError, match="the observable '1/x' is NaN, infinite"),
    ):
        km.moments.second_moments(data, lifting, route=route)
