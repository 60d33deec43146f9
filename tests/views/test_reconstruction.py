"""Reconstructions and closed loops, drawn: what is in the picture, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import koopmpc as km
from tests.views.runs import make_run

STATES = ("theta [rad]", "omega [rad/s]")
TRUTH = np.stack([np.sin(np.arange(101) * 0.1), np.cos(np.arange(101) * 0.1)], axis=1)


def test_every_state_has_a_panel_and_the_error_is_the_last():
    off = TRUTH + np.array([0.1, 0.0])
    made = km.plot.reconstruction({"A": (TRUTH, {"near": off}), "B": (TRUTH, {"exact": TRUTH})}, 0.1, STATES)
    assert len(made.axes) == 6
    error = made.axes[4]
    assert error.get_yscale() == "log"
    drawn = error.lines[0].get_ydata()
    np.testing.assert_allclose(drawn, 0.1 / np.linalg.norm(TRUTH, axis=1).max(), rtol=1e-9)
    assert made.axes[0].get_title() == "A"
    assert [text.get_text() for text in made.legends[0].get_texts()] == ["truth", "near", "exact"]
    looks = {(line.get_color(), line.get_linestyle(), line.get_marker()) for line in made.axes[0].lines}
    assert len(looks) == 2


def test_what_leaves_the_truth_leaves_the_picture():
    away = TRUTH * 1e9
    away[50:] = np.inf
    made = km.plot.reconstruction({"A": (TRUTH, {"away": away})}, 0.1, STATES)
    low, high = made.axes[0].get_ylim()
    assert -3 < low < -1 < 1 < high < 3
    assert np.isfinite(made.axes[-1].get_ylim()).all()


def test_a_case_without_a_reconstruction_shows_its_truth(tmp_path):
    made = km.plot.reconstruction({"A": (TRUTH, {"near": TRUTH + 0.1}), "B": (TRUTH, {})}, 0.1, STATES)
    made.savefig(tmp_path / "made.svg")
    np.testing.assert_array_equal(made.axes[1].lines[0].get_ydata(), TRUTH[:, 0])


def test_refusals():
    with pytest.raises(km.errors.DataError, match="there is no case to draw"):
        km.plot.reconstruction({}, 0.1, STATES)
    with pytest.raises(
        km.errors.ShapeError, match=r"near has shape \(100, 2\), the truth \(101, 2\); pass the same steps"
    ):
        km.plot.reconstruction({"A": (TRUTH, {"near": TRUTH[1:]})}, 0.1, STATES)


def test_runs_share_panels_with_reference_and_limits():
    one, two = make_run(nx=2, T=30), make_run(nx=2, T=30)
    made = km.plot.runs({"left": {"one": one, "two": two}, "right": {"one": one}})
    rows = len(one.states) + len(one.inputs)
    assert len(made.axes) == 2 * rows
    np.testing.assert_array_equal(made.axes[0].lines[0].get_ydata(), one.X[:, 0])
    np.testing.assert_array_equal(made.axes[2 * len(one.states)].lines[0].get_ydata(), one.U[:, 0])
    labels = [text.get_text() for text in made.legends[0].get_texts()]
    assert labels[:2] == ["one", "two"]


def test_runs_of_two_plants_are_refused():
    with pytest.raises(km.errors.DataError, match="there is no run to draw"):
        km.plot.runs({"left": {}})
    with pytest.raises(km.errors.DataError, match="different states or inputs"):
        km.plot.runs({"left": {"one": make_run(nx=2, T=5), "two": make_run(nx=3, T=5)}})


def test_a_reference_that_is_not_of_the_state_is_not_drawn_where_nothing_says_what_it_is_of():
    run = make_run(cost=False)
    references = (run.reference[:, :2], run.reference, run.reference[:, :1])
    made = [km.plot.runs({"A": {"a": replace(run, reference=each)}}) for each in references]
    assert [len(each.axes[0].lines) for each in made] == [2, 1, 1]
