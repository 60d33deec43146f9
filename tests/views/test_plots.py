"""Panels of curves: a panel each, a name the same line in all, and bad curves are refused."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.views.figures.reports import CurvePanel, draw_panels


def test_every_curve_is_drawn_in_its_panel_with_one_look_a_name():
    t = np.linspace(1.0, 2.0, 5)
    one = CurvePanel("t [s]", "x", {"a": (t, t), "b": (t, -t)}, log="x", at=[0.5], ylim=(-3.0, 3.0))
    two = CurvePanel("t [s]", "y", {"b": (t[:3], t[:3])}, title="second", points=True, log="y")
    made = draw_panels([one, two, two])
    first, second, third, empty = made.axes
    assert [curve.get_label() for curve in first.get_lines()[1:]] == ["a", "b"]
    assert first.get_lines()[2].get_color() == second.get_lines()[0].get_color()
    assert first.get_xscale() == second.get_yscale() == "log"
    assert first.get_ylim() == (-3.0, 3.0)
    assert second.get_title() == third.get_title() == "second"
    np.testing.assert_array_equal(second.get_lines()[0].get_xdata(), t[:3])
    assert not empty.get_visible()


def test_no_panel_and_curves_of_two_lengths_are_refused():
    with pytest.raises(km.errors.DataError, match="there is no panel to draw"):
        draw_panels([])
    with pytest.raises(km.errors.ShapeError, match="'a' has 3 x and 2 y; pass one y for each x"):
        draw_panels([CurvePanel("x", "y", {"a": ([0, 1, 2], [0, 1])})])
