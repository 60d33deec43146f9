"""Eigenfunctions of a known linear system over its plane."""

import numpy as np
import pytest
from PIL import Image

import koopmpc as km
from tests.views.models import STATES, turning

SQUARE = [(-1, 1), (-2, 2)]


def _mesh(axes):
    return np.asarray(axes.collections[0].get_array()).reshape(-1)


def test_magnitude_and_phase_of_a_turn() -> None:
    model = turning()
    made = km.plot.eigenfunction_maps(model, 0, ("angle", "rate"), SQUARE, points=20)
    magnitude, phase = made.axes[:2]
    y, x = (g.reshape(-1) for g in np.meshgrid(np.linspace(-2, 2, 20), np.linspace(-1, 1, 20), indexing="ij"))
    assert _mesh(magnitude) == pytest.approx(np.hypot(x, y) / np.sqrt(5))
    turn = _mesh(phase) - np.sign(model.eigenvalues[0].imag) * np.arctan2(y, x)
    assert np.ptp(np.angle(np.exp(1j * (turn - turn[0])))) < 1e-9
    for axes in (magnitude, phase):
        assert (axes.get_xlabel(), axes.get_ylabel()) == STATES
        assert "λ = 0.9076 " in axes.get_title()
    assert {"|φ₀|", "phase of φ₀ [rad]"} <= {axes.get_ylabel() for axes in made.axes}


def test_real_eigenfunctions_are_one_picture_each_and_pairs_stand_side_by_side(tmp_path) -> None:
    A = np.zeros((3, 3))
    A[0, 0], A[1:, 1:] = 0.99, turning().A
    model = km.LinearPredictor(A, np.zeros((3, 0)), np.eye(3), km.State(), 0.1, ["a [m]", "b", "c"], [])
    made = km.plot.eigenfunction_maps(model, [0, 1], ("a", "b"), [(-1, 1), (0, 1)], points=11)
    labels = [axes.get_ylabel() for axes in made.axes if axes.get_label() == "<colorbar>"]
    assert labels == ["φ₀", "|φ₁|", "phase of φ₁ [rad]"]
    a = np.tile(np.linspace(-1, 1, 11), 11)
    drawn = _mesh(made.axes[0])
    assert drawn * np.sign(drawn[-1]) == pytest.approx(a)
    km.plot.save(made, tmp_path / "a.pdf")
    only = km.plot.eigenfunction_maps(model, [0], ("a", "b"), [(-1, 1), (0, 1)], points=5)
    assert [axes.get_ylabel() for axes in only.axes] == ["b", "φ₀"]


def test_a_picture_of_shades_keeps_its_colours_and_its_labels_stay_inside(tmp_path) -> None:
    made = km.plot.eigenfunction_maps(turning(), 1, (0, 1), SQUARE)
    km.plot.save(made, tmp_path / "a.png")
    picture = Image.open(tmp_path / "a.png")
    assert len(picture.convert("RGB").getcolors(1 << 24)) > 1000
    labels = [(axes, text) for axes in made.axes for text in axes.texts if "π" in text.get_text()]
    assert labels
    for axes, text in labels:
        frame = axes.get_window_extent()
        assert frame.x0 < text.get_window_extent().x0 < text.get_window_extent().x1 < frame.x1


def mixed() -> km.LinearPredictor:
    """Its one real eigenfunction is c + a b + 2, by the product's and the Constant's eigenvalue."""
    lifting = km.Expressions(lambda x: [x[2] + x[0] * x[1] + 2], ["mix"])
    return km.LinearPredictor(
        [[0.5]], np.zeros((1, 0)), np.ones((3, 1)), lifting, 0.1, ["a [m]", "b [m/s]", "c [A]"], []
    )


def test_the_other_states_are_held_where_they_are_asked_for() -> None:
    axes = km.plot.eigenfunction_maps(mixed(), 0, ("c", 0), [(-1, 1), (2, 3)], at=[7, 8, 9], points=3).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("c [A]", "a [m]")
    c, a = np.tile([-1.0, 0.0, 1.0], 3), np.repeat([2.0, 2.5, 3.0], 3)
    phi = c + 8 * a + 2
    assert _mesh(axes) == pytest.approx(phi / phi.max())


def test_episodes_give_the_ranges_and_the_median_of_the_other_states() -> None:
    X = np.random.default_rng(0).normal(size=(51, 3))
    data = km.Episodes([km.Episode(X=X[:20]), km.Episode(X=X[20:])], 0.1, ["a [m]", "b [m/s]", "c [A]"])
    axes = km.plot.eigenfunction_maps(mixed(), 0, (1, 0), data, points=9).axes[0]
    assert axes.get_xlim() == pytest.approx((X[:, 1].min(), X[:, 1].max()))
    assert axes.get_ylim() == pytest.approx((X[:, 0].min(), X[:, 0].max()))
    b, a = np.meshgrid(*(np.linspace(X[:, i].min(), X[:, i].max(), 9) for i in (1, 0)))
    phi = (np.median(X[:, 2]) + a * b + 2).ravel()
    assert _mesh(axes) == pytest.approx(phi / np.abs(phi).max())
