"""Scenes: shapes become lines that cover what they stand for, y down."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.recording.views.scenes import Extent, Names, draw, draw_ahead, stages

coordinate = st.floats(-10, 10)


def strips(columns: object) -> list[list[list[tuple[float, float]]]]:
    """Return the strips of every row of a drawing."""
    column = next(c for c in columns if "strips" in str(c.component_descriptor()))
    return column.as_arrow_array().to_pylist()


@given(x=coordinate, y=coordinate, angle=st.floats(-4, 4), width=st.floats(0.1, 3), height=st.floats(0.1, 3))
def test_a_box_is_covered_and_no_more(x: float, y: float, angle: float, width: float, height: float) -> None:
    box = km.scene.Box("box", (x, y), (width, height), angle)
    drawing = draw(["box"], [[box]], Extent())["box"]
    path = np.array(strips(drawing.columns)[0][0]) * (1, -1) - (x, y)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    local, r = path @ turn, min(width, height) / 8
    reach = np.abs(local).max(axis=0) + r
    np.testing.assert_allclose(reach, [width / 2, height / 2], atol=1e-4)
    inside = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2)) * (np.array([width, height]) - 2 * r)
    assert max(distance(point, local) for point in inside) <= r + 1e-4


def distance(point: np.ndarray, path: np.ndarray) -> float:
    """Return the least distance of a point from a polyline."""
    a, d = path[:-1], np.diff(path, axis=0)
    t = np.clip(np.einsum("ij,ij->i", point - a, d) / np.maximum(np.einsum("ij,ij->i", d, d), 1e-12), 0, 1)
    return float(np.linalg.norm(point - a - t[:, None] * d, axis=1).min())


def test_up_in_the_scene_is_up_in_the_viewer() -> None:
    columns = draw(["rod"], [[km.scene.Line("rod", [(0.0, 0.0), (1.0, 2.0)])]], Extent())["rod"].columns
    assert np.array(strips(columns)).tolist() == [[[[0.0, 0.0], [1.0, -2.0]]]]


@pytest.mark.parametrize(
    ("shape", "low", "high"),
    [
        (km.scene.Line("s", [(-1.0, 0.0), (3.0, 1.0)], width=0.2), (-1.1, -0.1), (3.1, 1.1)),
        (km.scene.Disk("s", (1.0, 2.0), 0.5), (0.5, 1.5), (1.5, 2.5)),
        (km.scene.Box("s", (0.0, 0.0), (2.0, 4.0), np.pi / 2), (-2.0, -1.0), (2.0, 1.0)),
    ],
)
def test_extent_hold_every_shape_whole(shape: km.scene.Shape, low: tuple, high: tuple) -> None:
    extent = Extent()
    draw(["s"], [[shape], []], extent)
    np.testing.assert_allclose(extent.drawn.low, low, atol=1e-3)
    np.testing.assert_allclose(extent.drawn.high, high, atol=1e-3)
    (x0, x1), (y0, y1) = extent.ranges()
    assert x0 < low[0] < high[0] < x1
    assert y0 < -high[1] < -low[1] < y1


def test_nothing_drawn_has_no_extent() -> None:
    extent = Extent()
    draw(["nowhere"], [[km.scene.Line("nowhere", [(np.nan, 0.0), (0.0, 0.0)])]], extent)
    assert extent.ranges() is None


def test_only_what_moves_is_drawn_ahead_and_fades() -> None:
    rail, cart = (
        km.scene.Line("rail", [(0.0, 0.0), (1.0, 0.0)]),
        km.scene.Disk("cart", (0.0, 0.0), 0.1, color=(0, 0, 0)),
    )
    ahead = [[rail, km.scene.Disk("cart", (float(i), 0.0), 0.1, color=(0, 0, 0))] for i in (1, 2)]
    drawings = draw_ahead(["rail", "cart"], [[rail, cart], [rail, cart]], [ahead, []], extent := Extent())
    assert [len(row) for row in strips(drawings["rail"].columns)] == [0, 0]
    assert [len(row) for row in strips(drawings["cart"].columns)] == [2, 0]
    colors = next(c for c in drawings["cart"].columns if "colors" in str(c.component_descriptor()))
    far, near = (value >> 24 for value in colors.as_arrow_array().to_pylist()[0])
    assert 0 < near < far < 247
    assert extent.predicted.high[0] == pytest.approx(2.1, abs=1e-3)


@given(horizon=st.integers(1, 200))
def test_the_last_stage_is_always_among_those_drawn(horizon: int) -> None:
    drawn = stages(horizon)
    assert drawn[-1] == horizon
    assert drawn == sorted(set(drawn))
    assert 1 <= len(drawn) <= 4
    assert drawn[0] >= 1


def test_a_prediction_that_diverges_does_not_push_the_scene_out_of_sight() -> None:
    extent, now, near, far = (
        Extent(),
        [[km.scene.Disk("d", (0.0, 0.0), 1.0)]],
        km.scene.Disk("d", (0.2, 0.0), 1.0),
        km.scene.Disk("d", (1e6, 0.0), 1.0),
    )
    draw("d", now, extent)
    alone = extent.ranges()
    draw_ahead("d", now, [[[near]]], extent)
    assert extent.ranges()[0][1] - alone[0][1] == pytest.approx(0.2, abs=1e-3)
    draw_ahead("d", now, [[[far]]], extent)
    assert 0.2 < extent.ranges()[0][1] - alone[0][1] < 1.0
    assert extent.ranges()[0][0] == alone[0][0]


def test_a_shape_that_comes_or_goes_is_named() -> None:
    rail, cart = km.scene.Line("rail", [(0.0, 0.0)]), km.scene.Disk("cart", (0.0, 0.0), 0.1)
    names = Names()
    assert names.checked((rail, cart, rail), 0) == [rail, cart, rail]
    assert names.checked([cart, rail], 1) == [cart, rail]
    assert list(names) == ["rail", "cart"]
    with pytest.raises(
        km.errors.DataError, match="the scene of step 2 lacks the shape 'cart'; a scene returns the same"
    ):
        names.checked([rail], 2)
    with pytest.raises(
        km.errors.DataError, match="the scene of step 3 has a new shape 'wall'; a scene returns the same"
    ):
        names.checked([rail, cart, km.scene.Line("wall", [])], 3)
