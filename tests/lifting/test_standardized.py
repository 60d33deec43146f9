"""Units and offsets of the states do not matter to what a standardized lifting predicts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.lifting.families import NAMES, buffer_lifting
from tests.roundtrip import returned

CENTERS = np.random.default_rng(3).normal(size=(6, 2))
FAMILIES = [km.Gaussian(CENTERS, 1.0), km.ThinPlate(CENTERS), km.RandomFourier(8, 1.5, 4), km.Monomials(3)]


def _data(scale: np.ndarray | float = 1.0, offset: np.ndarray | float = 0.0) -> km.Episodes:
    rng, made = np.random.default_rng(0), []
    for _ in range(20):
        X, U = [rng.normal(size=2)], rng.normal(size=(25, 1))
        for u in U:
            a, b = X[-1]
            X.append(np.array([a + 0.1 * b, b + 0.1 * (-np.sin(a) - 0.3 * b + u[0])]))
        made.append(km.Episode(X=np.array(X) * scale + offset, U=U))
    return km.Episodes(made, 0.1, NAMES[:2])


def test_it_is_the_inner_lifting_of_standardized_states() -> None:
    data = _data(3.0, 5.0)
    lifting = km.lifting.Standardized.of(data, km.Gaussian(CENTERS, 0.7)).bind(NAMES[:2])
    X = np.concatenate([episode.X[:-1] for episode in data])
    assert lifting.mean == pytest.approx(X.mean(0), rel=1e-13)
    assert lifting.scale == pytest.approx(X.std(0), rel=1e-13)
    assert np.allclose(lifting(X), km.Gaussian(CENTERS, 0.7).bind(NAMES[:2])((X - X.mean(0)) / X.std(0)), atol=1e-12)
    assert buffer_lifting(lifting)(X[7])[0] == pytest.approx(lifting(X[7]), rel=1e-12)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: type(family).__name__)
@settings(max_examples=8, deadline=None)
@given(st.tuples(st.integers(-4, 4), st.integers(-4, 4)), st.floats(-3, 3))
def test_scaling_states_changes_no_prediction(family, powers: tuple[int, int], offset: float) -> None:
    scale = 10.0 ** np.array(powers)
    plain, scaled = _data(), _data(scale, offset * scale)
    first, second = (
        km.edmd(data, km.State() + km.Constant() + km.lifting.Standardized.of(data, family)) for data in (plain, scaled)
    )
    episode, other = plain[0], scaled[0]
    a = first.rollout(episode.X[0], episode.U)
    b = second.rollout(other.X[0], other.U)
    assert np.allclose((b - offset * scale) / scale, a, atol=1e-8 * np.abs(a).max())


def test_other_numbers_are_other_observables_and_one_stays_one() -> None:
    a, b = (
        km.lifting.Standardized(km.Fourier(1, "theta"), [0, 0], [1, 2]),
        km.lifting.Standardized(km.Fourier(1, "theta"), [0, 0], [1, 3]),
    )
    assert (a + b + a).bind(NAMES[:2]).nz == 4
    assert a.bind(NAMES[:2]).names[0].startswith("sin(theta)~")
    assert (km.State() + km.lifting.Standardized(km.State(), [0, 0], [1, 2])).bind(NAMES[:2]).nz == 4
    assert km.lifting.Standardized(km.Constant(), [0.0], [1.0]).bind(["x"]).names == ("1",)


def test_saved_bound_or_not() -> None:
    lifting = km.lifting.Standardized(km.RandomFourier(3, 1.0, 2) + km.State(), [1 / 3, -1], [0.1, 7])
    assert returned(lifting) == lifting
    bound = lifting.bind(NAMES[:2])
    assert returned(bound) == bound


def test_a_state_that_stands_still_keeps_its_unit() -> None:
    X = np.column_stack([np.arange(6.0), np.full(6, 7.0)])
    assert km.lifting.Standardized.of(km.Episodes([km.Episode(X=X)], 0.1), km.State()).scale == pytest.approx(
        [np.sqrt(2), 1]
    )


def test_files_are_read_part_by_part(tmp_path) -> None:
    data = _data(2.0, -3.0)
    for i, episode in enumerate(data):
        km.Episodes([episode], data.dt, data.states).save(tmp_path / f"{i:02d}.npz")
    read, whole = (
        km.lifting.Standardized.of(km.data.Files(tmp_path), km.State()),
        km.lifting.Standardized.of(data, km.State()),
    )
    assert read.mean == pytest.approx(whole.mean, rel=1e-13)
    assert read.scale == pytest.approx(whole.scale, rel=1e-13)
