"""Scenes: in the plane shapes become lines that cover what they stand for, y down; in space lines, balls and boxes, z up."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

import koopmpc as km
from koopmpc.views.figures.animation import project
from koopmpc.views.recording.scenes import Extent, Names, draw, draw_ahead, stages
from koopmpc.views.recording.video import export_video
from tests.views.runs import make_run

coordinate = st.floats(-10, 10)


def named(*shapes: km.scene.Shape) -> Names:
    """Return the names of a scene of these shapes."""
    names = Names()
    names.check(shapes, 0)
    return names


def strips(columns: object) -> list[list[list[tuple[float, float]]]]:
    """Return the strips of every row of a drawing."""
    column = next(c for c in columns if "strips" in str(c.component_descriptor()))
    return column.as_arrow_array().to_pylist()


@given(x=coordinate, y=coordinate, angle=st.floats(-4, 4), width=st.floats(0.1, 3), height=st.floats(0.1, 3))
def test_a_box_is_covered_and_no_more(x: float, y: float, angle: float, width: float, height: float) -> None:
    box = km.scene.Box("box", (x, y), (width, height), angle)
    drawing = draw(named(box), [[box]], Extent())["box"]
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
    rod = km.scene.Line("rod", [(0.0, 0.0), (1.0, 2.0)])
    columns = draw(named(rod), [[rod]], Extent())["rod"].columns
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
    draw(named(shape), [[shape], []], extent)
    np.testing.assert_allclose(extent.drawn.low, low, atol=1e-3)
    np.testing.assert_allclose(extent.drawn.high, high, atol=1e-3)
    (x0, x1), (y0, y1) = extent.ranges()
    assert x0 < low[0] < high[0] < x1
    assert y0 < -high[1] < -low[1] < y1


def test_nothing_drawn_has_no_extent() -> None:
    extent = Extent()
    draw(named(km.scene.Line("nowhere", [])), [[km.scene.Line("nowhere", [(np.nan, 0.0), (0.0, 0.0)])]], extent)
    assert extent.ranges() is None


def test_only_what_moves_is_drawn_ahead_and_fades() -> None:
    rail, cart = (
        km.scene.Line("rail", [(0.0, 0.0), (1.0, 0.0)]),
        km.scene.Disk("cart", (0.0, 0.0), 0.1, color=(0, 0, 0)),
    )
    ahead = [[rail, km.scene.Disk("cart", (float(i), 0.0), 0.1, color=(0, 0, 0))] for i in (1, 2)]
    drawings = draw_ahead(named(rail, cart), [[rail, cart], [rail, cart]], [ahead, []], extent := Extent())
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
    draw(named(near), now, extent)
    alone = extent.ranges()
    draw_ahead(named(near), now, [[[near]]], extent)
    assert extent.ranges()[0][1] - alone[0][1] == pytest.approx(0.2, abs=1e-3)
    draw_ahead(named(near), now, [[[far]]], extent)
    assert 0.2 < extent.ranges()[0][1] - alone[0][1] < 1.0
    assert extent.ranges()[0][0] == alone[0][0]


def test_a_shape_that_comes_or_goes_is_named() -> None:
    rail, cart = km.scene.Line("rail", [(0.0, 0.0)]), km.scene.Disk("cart", (0.0, 0.0), 0.1)
    names = Names()
    assert names.check((rail, cart, rail), 0) == [rail, cart, rail]
    assert names.check([cart, rail], 1) == [cart, rail]
    assert list(names) == ["rail", "cart"]
    with pytest.raises(
        km.errors.DataError, match="the scene of step 2 lacks the shape 'cart'; a scene returns the same"
    ):
        names.check([rail], 2)
    with pytest.raises(
        km.errors.DataError, match="the scene of step 3 has a new shape 'wall'; a scene returns the same"
    ):
        names.check([rail, cart, km.scene.Line("wall", [])], 3)


class Satellite(km.Dynamics):
    """A body that turns about the vertical, drawn in space."""

    states = ("angle [rad]",)
    inputs = ("rate [rad/s]",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        return u

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        tip = np.array([np.cos(x[0]), np.sin(x[0]), 0.5])
        return [
            km.scene.Line("boom", [np.zeros(3), tip], width=0.1),
            km.scene.Disk("tip", tip, 0.2),
            km.scene.Box("body", (0.0, 0.0, 0.0), (0.4, 0.6, 0.8), angle=float(x[0])),
            km.scene.Box("panel", (0.0, 0.0, 1.0), (0.1, 0.2, 0.3), angle=(float(x[0]), 0.0, 0.0)),
        ]


def recorded(path: Path, dynamics: km.Dynamics | None = None) -> km.Run:
    """Record three steps of a plant that turns to 0."""
    plant = km.discretize(dynamics or Satellite(), 0.1)
    run = km.simulate(
        plant,
        km.LQR(km.LinearPredictor.local(plant, [0.0], [0.0]), km.Cost(Q=1, R=1)),
        x0=[0.3],
        reference=[0.0],
        steps=3,
    )
    km.record(run, path)
    return run


def logged(path: Path, entity: str, component: str) -> list[list[object]]:
    """Return the values of a component of an entity, a row each step."""
    for chunk in RrdReader(str(path)).stream().filter(content=entity, has_timeline="step"):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith(component):
                return batch.column(name).to_pylist()
    raise AssertionError(f"{entity} has no {component}")


def test_a_scene_in_space_stands_in_the_log_where_it_was_drawn(tmp_path: Path) -> None:
    run = recorded(path := tmp_path / "run.rrd")
    angles = run.X[:, 0]
    tips = np.column_stack([np.cos(angles), np.sin(angles), 0.5 + 0 * angles])
    booms, balls = logged(path, "/world/boom", "strips"), logged(path, "/world/tip", "positions")
    assert len(booms) == len(balls)
    np.testing.assert_allclose([row[0][1] for row in booms], tips[: len(booms)], atol=1e-6)
    np.testing.assert_allclose([row[0] for row in balls], tips[: len(balls)], atol=1e-6)
    assert logged(path, "/world/tip", "radii")[0] == pytest.approx([0.2])
    assert logged(path, "/world/boom", "radii")[0] == pytest.approx([0.05])
    np.testing.assert_allclose(logged(path, "/world/body", "half_sizes")[0], [[0.2, 0.3, 0.4]], atol=1e-6)
    for row, angle in zip(logged(path, "/world/body", "quaternions"), angles, strict=False):
        found = Rotation.from_quat(row[0]).apply([1.0, 0.0, 0.0])
        np.testing.assert_allclose(found, [np.cos(angle), np.sin(angle), 0.0], atol=1e-6)
    for row, angle in zip(logged(path, "/world/panel", "quaternions"), angles, strict=False):  # about the x-axis
        found = Rotation.from_quat(row[0]).apply([0.0, 1.0, 0.0])
        np.testing.assert_allclose(found, [0.0, np.cos(angle), np.sin(angle)], atol=1e-6)


def test_a_log_in_space_becomes_a_video_in_which_what_is_near_hides_what_is_far(tmp_path: Path) -> None:
    recorded(path := tmp_path / "run.rrd")
    export_video(path, video := tmp_path / "run.gif")
    assert video.read_bytes()[:6] == b"GIF89a"


def test_a_scene_seen_from_afar_keeps_up_and_lengths() -> None:
    seen = project(points := np.random.default_rng(0).normal(size=(20, 3)))
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), np.linalg.norm(points, axis=1), rtol=1e-12)
    right, up, near = project(np.array([[0.0, 0.0, 1.0]]))[0]
    assert right == pytest.approx(0.0)
    assert up > 0.8  # the eye is above the horizon, and z points up
    assert near > 0
    assert np.linalg.det(project(np.eye(3))) == pytest.approx(1.0)  # no mirror


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (
            [km.scene.Disk("b", (0.0, 1.0), 0.1)],
            "the scene of step 0 draws points with 2 and 3 coordinates, the last .* 'b'",
        ),
        ([km.scene.Disk("b", (0.0, 1.0, np.nan), 0.1)], "the scene of step 0 draws 'b' at NaN or inf"),
        ([km.scene.Box("b", (0.0, 1.0, 0.0), (1.0, 1.0))], "2 and 3 coordinates, the last one of 'b'"),
        ([km.scene.Line("a", [(0.0, 0.0, 0.0)])], "draws 'a' as a .* in space a name stands for one kind of shape"),
    ],
)
def test_a_scene_that_cannot_be_drawn_in_space_is_told(
    tmp_path: Path, shapes: list[km.scene.Shape], message: str
) -> None:
    class Bad(Satellite):
        def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
            return [km.scene.Disk("a", (0.0, 0.0, 0.0), 0.1), *shapes]

    with pytest.raises(km.errors.DataError, match=message):
        recorded(tmp_path / "run.rrd", Bad())


def test_the_scene_of_a_reference_that_stays_is_asked_for_once(tmp_path):
    asked = []

    def scene(x, u):
        asked.append(x)
        return [km.scene.Disk("a", (float(x[0]), 0.0), 0.1)]

    run = make_run(T=12)
    still = replace(
        run, reference=np.ones_like(run.reference), u_reference=np.zeros_like(run.U), plans=None, scene=scene
    )
    km.record(still, tmp_path / "still.rrd")
    assert len(asked) == len(run.X) + 1
