"""The unit circle, the eigenvalues where they are, and their residuals by colour, size and shape."""

import numpy as np
import pytest

import koopmpc as km
from tests.views.models import BILINEAR, VALUES, diagonal, episodes, turning


def _named(axes, gid: str):
    (found,) = [a for a in axes.get_children() if a.get_gid() == gid]
    return found


@pytest.mark.parametrize("residuals", [None, [0.0, 1e-3]])
def test_the_circle_has_radius_one_and_the_points_are_the_eigenvalues(residuals) -> None:
    model = turning()
    made = km.plot.spectrum(model, residuals)
    axes = made.axes[0]
    assert np.hypot(*_named(axes, "unit circle").get_data()) == pytest.approx(1.0)
    points = _named(axes, "eigenvalues")
    drawn = np.asarray(points.get_xydata() if residuals is None else points.get_offsets())
    assert drawn[:, 0] + 1j * drawn[:, 1] == pytest.approx(model.eigenvalues)
    assert axes.get_aspect() == 1.0
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Re λ", "Im λ")


def test_residuals_are_shades_sizes_and_shapes() -> None:
    residuals = np.array([1e-6, 1e-3, 0.5, np.inf])
    made = km.plot.spectrum(diagonal(), residuals)
    good, bad = (_named(made.axes[0], gid) for gid in ("eigenvalues", "spurious eigenvalues"))
    assert np.array_equal(good.get_offsets()[:, 0], VALUES[:2])
    assert np.array_equal(bad.get_offsets()[:, 0], VALUES[2:])
    assert np.array_equal([*good.get_array(), *bad.get_array()], np.minimum(residuals, 1e3))
    assert (np.diff([*good.get_sizes(), *bad.get_sizes()]) < 0).all()
    assert any("residual" in axes.get_ylabel() for axes in made.axes)
    assert [text.get_text() for text in made.legends[0].get_texts()] == [
        "residual ≤ 0.05",
        "above: may be spurious (2 of 4)",
    ]


def test_eigenvalues_that_crowd_are_drawn_closer() -> None:
    crowded = km.plot.spectrum(turning(0.999, 0.01))
    x, y = (crowded.axes[1].get_xlim(), crowded.axes[1].get_ylim())
    assert len(crowded.axes) == 2
    assert x[0] < 0.999 * np.cos(0.01) < x[1] < 1.2
    assert -0.2 < y[0] < -0.01 < 0.01 < y[1]
    assert len(km.plot.spectrum(diagonal()).axes) == 1


def test_a_bilinear_predictor_has_a_spectrum_too() -> None:
    drawn = _named(km.plot.spectrum(BILINEAR).axes[0], "eigenvalues").get_xdata()
    assert drawn == pytest.approx(turning().eigenvalues.real)


def test_residuals_of_the_trust_report_are_taken_with_their_tolerance() -> None:
    data, model = episodes(3), turning()
    made = km.plot.spectrum(model, km.validate.residual_dmd(model, data, tolerance=0.2))
    assert made.legends[0].get_texts()[0].get_text() == "residual ≤ 0.2"
    points = _named(made.axes[0], "eigenvalues")
    drawn = np.asarray(points.get_offsets())
    assert sorted(drawn[:, 0]) == pytest.approx(sorted(model.eigenvalues.real))
    assert (np.asarray(points.get_array()) < 1e-6).all()
