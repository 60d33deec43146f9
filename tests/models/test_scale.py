"""The scale of a learned predictor: the triangular factor of the lifted data that it was fitted to."""

import numpy as np
import pytest

import koopmpc as km
from tests.synthesis.test_select import bilinear, episodes_of, quadratic

SQUARES = km.State() + km.Constant() + km.Monomials(2)


def of_pairs(data, lifting, weights=None):
    """Return RᵀR of all first states of a pair, as the definition says."""
    Z = lifting(np.concatenate([e.X[:-1] for e in data]))
    w = np.ones(len(Z)) if weights is None else np.concatenate(weights)
    return (Z * w[:, None]).T @ Z / w.sum()


def online(data):
    return km.OnlineEDMD.start(data, SQUARES).predictor()


FITS = {
    "edmd": lambda data: km.edmd(data, SQUARES),
    "gcv": lambda data: km.edmd(data, SQUARES, ridge="gcv"),
    "tls": lambda data: km.edmd(data, SQUARES, method="tls"),
    "reduced": lambda data: km.edmd(data, SQUARES, rank=3),
    "dmdc": km.dmdc,
    "dmd": km.dmd,
    "dmdc reduced": lambda data: km.dmdc(data, rank=1),
    "bilinear": lambda data: km.bilinear_edmd(data, SQUARES, difference=True),
    "bilinear reduced": lambda data: km.bilinear_edmd(data, SQUARES, rank=4),
    "stable": lambda data: km.identify.stable_edmd(data, SQUARES),
    "sparse": lambda data: km.identify.sparse_edmd(data, SQUARES, penalty=1e-4),
    "online": online,
}


@pytest.mark.parametrize("name", FITS)
def test_every_fit_knows_the_second_moments_of_its_lifted_data(name):
    data = episodes_of(bilinear)
    model = FITS[name](data)
    R = model.scale
    assert np.array_equal(R, np.triu(R))
    assert (R.diagonal() > 0).all()
    assert pytest.approx(of_pairs(data, model.lifting), rel=1e-7, abs=1e-9) == R.T @ R


def test_a_scale_is_saved_and_a_given_model_has_none(tmp_path):
    model = km.edmd(episodes_of(quadratic), SQUARES)
    model.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == model
    assert km.LinearPredictor(np.eye(2), np.ones((2, 1)), np.eye(2), km.State(), 0.1, ("a", "b"), ("u",)).scale is None


def test_weights_count_in_the_scale():
    data = episodes_of(quadratic)
    weights = [np.linspace(0.1, 3.0, len(e)) for e in data]
    R = km.edmd(data, SQUARES, weights=weights).scale
    assert pytest.approx(of_pairs(data, SQUARES.bind(data.states), weights), rel=1e-9) == R.T @ R


@pytest.mark.parametrize("fit", [km.edmd, km.bilinear_edmd])
def test_dependent_and_constant_observables_leave_the_scale_invertible(fit):
    """Two states that are one and a third that never moves: R⁻ᵀ z of all data stays near 1 a direction."""
    data = episodes_of(quadratic)
    tripled = km.Episodes([km.Episode(X=np.c_[e.X, 1e6 * e.X[:, :1], 0 * e.X[:, 0]], U=e.U) for e in data], data.dt)
    with pytest.warns(km.FitWarning):
        model = fit(tripled, km.State() + km.Constant())
    Z = model.lift(np.concatenate([e.X[:-1] for e in tripled]))
    T = np.linalg.solve(model.scale.T, Z.T)
    assert np.linalg.cond(model.scale / np.abs(model.scale).max(axis=0)) < 1e9
    assert np.sqrt(np.mean(T**2, axis=1)).max() < 1.0001


def test_units_scale_the_columns_and_nothing_else():
    data, factor = episodes_of(quadratic), np.array([1e5, 1e-4])
    moved = km.Episodes([km.Episode(X=e.X * factor, U=e.U) for e in data], data.dt)
    one, other = (km.edmd(each, km.State()).scale for each in (data, moved))
    assert other == pytest.approx(one * factor, rel=1e-8)


@pytest.mark.parametrize("scale", [np.ones((2, 2)), np.zeros((2, 2)), np.ones(2), [[1.0, np.nan], [0.0, 1.0]]])
def test_a_scale_that_is_no_triangular_factor_is_refused(scale):
    with pytest.raises(km.errors.DataError if np.shape(scale) == (2, 2) else km.errors.ShapeError, match="scale"):
        km.LinearPredictor(np.eye(2), np.ones((2, 1)), np.eye(2), km.State(), 0.1, ("a", "b"), ("u",), scale=scale)
