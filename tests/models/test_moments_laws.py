"""Laws of the moments: cutting, ordering and scaling change nothing but rounding; where Gram loses and QR does not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.models.plants import random_episodes

LIFTING = km.Constant() + km.State() + km.Monomials(2)
LENGTHS = st.lists(st.integers(1, 60), min_size=2, max_size=6)
ROUTES = pytest.mark.parametrize("route", ["gram", "qr"])


def coefficients(episodes: km.Episodes | km.data.Stream, lifting: km.Lifting, route: str) -> np.ndarray:
    """Return K of numpy.linalg.lstsq on the few rows that stand for all, columns of unit norm."""
    m = km.moments.second_moments(episodes, lifting, route=route)
    few = m.rows(m.columns.regressors, m.columns.targets)
    return unit_norm_least_squares(few.P, few.T[:, : m.nz])


def rows_of(episodes: km.Episodes, lifting: km.Lifting) -> np.ndarray:
    """Return the rows [ψ(x) u ψ(x⁺)] at once."""
    data = episodes.snapshots()
    return np.hstack([lifting(data.X), data.U, lifting(data.X_next)])


def least_squares(episodes: km.Episodes, lifting: km.Lifting) -> np.ndarray:
    """Return K of numpy.linalg.lstsq on the rows themselves, columns of unit norm."""
    bound = lifting.bind(episodes.states)
    D = rows_of(episodes, bound)
    return unit_norm_least_squares(D[:, : bound.nz + episodes.nu], D[:, bound.nz + episodes.nu :])


def unit_norm_least_squares(P: np.ndarray, T: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(P, axis=0)
    return np.linalg.lstsq(P / size, T, rcond=None)[0] / size[:, None]


@ROUTES
@given(lengths=LENGTHS, seed=st.integers(0, 999), random=st.randoms(use_true_random=False))
def test_permuting_splitting_and_merging_change_nothing_but_rounding(
    route: str, lengths: list[int], seed: int, random
) -> None:
    data = random_episodes(seed, [40, *lengths], 2, 1)
    K = coefficients(data, LIFTING, route)
    pieces: list[km.Episode] = []
    for e in data:
        k = random.randint(0, len(e) - 1)
        cuts = ((0, k), (k, len(e))) if k else ((0, len(e)),)
        pieces += [km.Episode(X=e.X[a : b + 1], U=e.U[a:b]) for a, b in cuts]
    random.shuffle(pieces)
    half = random.randint(1, len(pieces) - 1)
    sets = [km.Episodes(pieces[:half], data.dt), km.Episodes(pieces[half:], data.dt)]
    for other in (km.Episodes(pieces, data.dt), km.data.Stream(iter(sets)), km.data.Stream(sets)):
        assert np.allclose(coefficients(other, LIFTING, route), K, rtol=0, atol=1e-9)


@given(
    st.integers(0, 99),
    st.lists(st.integers(-4, 4), min_size=2, max_size=2),
    st.integers(-4, 4),
)
def test_scaling_states_and_inputs_scales_the_predictions_of_monomials(
    seed: int, powers: list[int], power: int
) -> None:
    data = random_episodes(seed, [120, 80], 2, 1)
    states, inputs = 10.0 ** np.array(powers), 10.0**power
    scaled = km.Episodes([km.Episode(X=e.X * states, U=e.U * inputs) for e in data], data.dt)
    plain, other = km.edmd(data, LIFTING), km.edmd(scaled, LIFTING)
    x0, U = data[0].X[0], data[0].U[:8]
    assert np.allclose(other.rollout(x0 * states, U * inputs) / states, plain.rollout(x0, U), rtol=1e-7, atol=1e-9)


def relative_misfit(data: km.Episodes, lifting: km.Lifting, K: np.ndarray) -> np.ndarray:
    """Return for each observable ‖t − P k‖ / ‖t − mean t‖ on the rows themselves."""
    bound = lifting.bind(data.states)
    D = rows_of(data, bound)
    P, T = D[:, : bound.nz + data.nu], D[:, bound.nz + data.nu :]
    spread = np.linalg.norm(T - T.mean(axis=0), axis=0)
    return np.linalg.norm(T - P @ K, axis=0) / np.where(spread > 0, spread, 1.0)


def off_centre() -> km.Episodes:
    """Rotations about points 1e4 away from the origin, in units that differ by 1e8."""
    rng = np.random.default_rng(0)
    A = np.array([[0.8, 0.5, 0.0], [-0.5, 0.8, 0.1], [0.0, 0.0, 0.9]])
    scale, centre = np.array([1e-4, 1.0, 1e4]), np.array([1e4, -1e4, 1e4])
    X = rng.standard_normal((60, 3))
    pairs = zip(X, X @ A.T, strict=True)
    return km.Episodes([km.Episode(X=scale * (centre + np.array(pair))) for pair in pairs], 0.1)


def test_offsets_of_1e4_and_scales_from_1e_4_to_1e4_cost_gram_digits_and_qr_none() -> None:
    data, lifting = off_centre(), km.Constant() + km.State() + km.Monomials(2)
    misfit = {
        route: relative_misfit(data, lifting, coefficients(data, lifting, route)).max() for route in ("gram", "qr")
    }
    assert misfit["qr"] < 1e-10
    assert misfit["gram"] > 1e5 * misfit["qr"]
    assert km.moments.second_moments(data, lifting).route == "qr"


def test_a_thin_plate_dictionary_of_condition_1e15_needs_qr() -> None:
    rng = np.random.default_rng(1)
    step = np.array([[0.9, 0.2], [-0.2, 0.9]])
    X = rng.uniform(-1, 1, (300, 2))
    data = km.Episodes([km.Episode(X=pair) for pair in zip(X, X @ step.T, strict=True)], 0.1)
    lifting = km.State() + km.ThinPlate(rng.uniform(-1, 1, (200, 2)))
    m = km.moments.second_moments(data, lifting)
    assert m.route == "qr"
    assert m.condition**2 > 1e15  # of ZᵀZ, on unit-norm columns
    best = relative_misfit(data, lifting, least_squares(data, lifting))
    qr = relative_misfit(data, lifting, coefficients(data, lifting, "qr"))
    gram = relative_misfit(data, lifting, coefficients(data, lifting, "gram"))  # drops what its sums do not resolve
    assert np.linalg.norm(qr) <= (1 + 1e-6) * np.linalg.norm(best)
    assert np.linalg.norm(gram) > (1 + 1e-3) * np.linalg.norm(best)
