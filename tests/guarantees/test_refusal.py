"""Refused certificates: each reason names its assumption, and its advice is followed and gives a certificate."""

import numpy as np
import pytest

import koopmpc as km
from tests.gathered import of_certificate
from tests.searches import certify


def draw_pairs(error=None, reach=1.0, u_reach=1.0):
    """Return 300 independent pairs of x⁺ = 1.2 x + 0.5 u + error(x, u)."""
    rng = np.random.default_rng(0)
    X, U = rng.uniform(-reach, reach, 300), rng.uniform(-u_reach, u_reach, 300)
    X_next = 1.2 * X + 0.5 * U + (0 if error is None else error(X, U))
    pairs = [km.Episode(X=[[x], [y]], U=[[u]]) for x, y, u in zip(X, X_next, U, strict=True)]
    return km.Episodes(pairs, dt=1.0)


def make_model(b=0.5, N=None):
    if N is None:
        return km.LinearPredictor([[1.2]], [[b]], [[1.0]], km.State(), 1.0, ["x"], ["u"])
    return km.BilinearPredictor([[1.2]], [[b]], [[[N]]], [[1.0]], km.State(), 1.0, ["x"], ["u"])


def shift(X, U):
    return 0.3 + 0.01 * np.sin(9 * X)


def shift_little(X, U):
    return 0.3 * shift(X, U)


MODEL, MIXED = make_model(), make_model(N=50.0)
NARROW, WIDE = (km.Limits(u_min=-end, u_max=end) for end in (1e-5, 2e-4))
# model, data, options that are refused; the words of the refusal; what is changed as it says
REASONS = {
    "episodes": (MODEL, None, {}, r"too few independent episodes .* collect 30 or more", {"data": draw_pairs()}),
    "modes": (make_model(0.0), draw_pairs(), {}, r"no input moves, \|λ\| = 1.2, largest in x;", {"model": MODEL}),
    "decay": (MODEL, draw_pairs(), {"error": (0.3, 0.1), "decay": 0.05}, r"decay is 0.05, and 0.46", {"decay": 0.47}),
    "noise": (MODEL, draw_pairs(), {"noise": 0.5}, r"exists for 0.42 of it. Try a better sensor", {"noise": 0.2}),
    "wider": (
        MODEL,
        draw_pairs(),
        {"noise": 0.5},
        "noise .* a wider box with wider limits",
        {"data": draw_pairs(reach=4.0, u_reach=9.0)},
    ),
    "point": (
        MODEL,
        draw_pairs(shift),
        {"estimated": True},
        r"at the set point is too large: c_0 .* exists for 0.3\d of it. Try a set point that the plant can hold",
        {"data": draw_pairs(shift_little)},
    ),
    "inputs": (
        MODEL,
        draw_pairs(),
        {"limits": NARROW, "error": (0.01, 0.01)},
        "too little room around the set point, and 13.3 times as much is enough. Pass wider limits",
        {"limits": WIDE},
    ),
    "c_u": (
        MODEL,
        draw_pairs(),
        {"error": (0.01, 0.9)},
        "error of the model is too large.* exists for 0.42 of c_u.* products of the inputs",
        {"error": (0.01, 0.37)},
    ),
    "error": (
        MODEL,
        draw_pairs(lambda X, U: 0.9 * np.sin(20 * X)),
        {},
        r"of these constants. The bound is set at x = \S+, u\[0\] = \S+: data .*smaller boxes hold too few",
        {"data": draw_pairs(lambda X, U: 0.02 * np.sin(20 * X))},
    ),
    "region": (
        MIXED,
        draw_pairs(),
        {"error": (0.05, 0.05), "region": (-50, 50)},
        "region is too large. Even a model without error has none on 1 of the box, and one on 0.0032",
        {"region": (-0.15, 0.15)},
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in ("region", "wider", "point", "noise", "error")))
        for name in REASONS
    ],
)
def test_the_reason_is_named_and_its_advice_gives_a_certificate(name):
    model, data, options, words, mended = REASONS[name]
    rng = np.random.default_rng(0)
    if data is None:  # one long episode
        data = km.Episodes([km.Episode(X=rng.uniform(-1, 1, (300, 1)), U=rng.uniform(-1, 1, (299, 1)))], dt=1.0)
    with pytest.raises(km.errors.CertificateError, match=words):
        km.certify(model, data, **of_certificate(**options))
    found = km.certify(**of_certificate(**({"model": model, "data": data} | options | mended)))
    assert found.margin > 0


def test_the_refusal_names_the_pair_that_sets_the_bound():
    worst = 7

    def error(X, U):
        apart = 0.9 * np.sin(20 * X)
        apart[worst], X[worst], U[worst] = 9.0, 0.0123, 0.0456
        return apart

    with pytest.raises(km.errors.CertificateError, match=r"set at x = 0.0123, u\[0\] = 0.0456: data for the fit near"):
        km.certify(MODEL, draw_pairs(error))


def test_observables_that_are_nearly_one_another_are_named():
    lifting = km.State() + km.Expressions(lambda x: [x[0] + 1e-6 * x[0] ** 2], ["e"])
    data = draw_pairs(lambda X, U: 0.3 * X * U)
    with pytest.raises(km.errors.CertificateError, match="nearly functions of one another; leave some of them out"):
        certify(km.bilinear_edmd(data, lifting), data, error=(0, 0))
    assert certify(km.bilinear_edmd(data, km.State()), data, error=(0, 0)).margin > 0


def test_a_region_outside_the_data_is_refused_unless_the_bound_is_given():
    data = draw_pairs()
    with pytest.raises(km.errors.DataError, match=r"the region has x = -2 … 2, and the data have -0.99"):
        certify(MODEL, data, region=(-2, 2))
    inside = certify(MODEL, data, region=(-1, 1))  # ends of random data are a little inside
    assert -1 < inside.low[0] < inside.high[0] < 1
    assert certify(MODEL, data, region=(-2, 2), error=(0.01, 0.01)).high[0] == 2


def test_a_model_with_measured_disturbances_is_refused():
    pushed = km.LinearPredictor([[1.2]], [[0.5]], [[1.0]], km.State(), 1.0, ["x"], ["u"], E=[[0.1]])
    with pytest.raises(km.errors.DataError, match="fit it without W, or pass model"):
        km.certify(pushed, draw_pairs())
