"""Scenes: in the plane shapes become lines that cover what they stand for, y down; in space lines, balls and boxes, z up."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import koopmpc as km
from tests.commands import koopmpc
from tests.views.logged import Logged
from tests.views.runs import make_run


def drawn(path: Path, draw: Callable, X: Sequence = (0.0,), plans: np.ndarray | None = None) -> Logged:
    """Return the log of a run through the states X that draws draw(x); `plans` has N + 1 states for each step."""
    X = np.array([*X, X[-1]], dtype=float)[:, None]
    T, zeros = len(X) - 1, np.zeros((len(X) - 1, 1))
    ahead = None if plans is None else km.loop.Plans(plans[..., None], np.zeros((T, plans.shape[1] - 1, 1)))
    run = km.Run(
        X=X, Y=X, U=zeros, reference=np.empty((T + 1, 0)), status=(km.Status.OPTIMAL,) * T, solve_time=np.ones(T),
        fallback=(km.control.Fallback.NONE,) * T, cost=None, limits=None, dt=0.1, states=("x",), inputs=("u",),
        outputs=("x",), plans=ahead,
    )  # fmt: skip
    km.record(run, path, scene=lambda x, u: draw(float(x[0])))
    return Logged(path)


def strips(log: Logged, entity: str, row: int = 0) -> list[np.ndarray]:
    """Return the strips of a row of an entity, y up."""
    return [np.array(strip) * (1, -1) for strip in log.rows(entity, "strips")[1][row]]


def ranges(path: Path) -> np.ndarray:
    """Return the ranges of x and y that the animation shows."""
    from rerun.chunk import RrdReader

    entry = RrdReader(path).blueprints()[-1]
    for chunk in RrdReader(path).stream(store=entry).to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith("VisualBounds2D:range"):
                found = batch.column(name).to_pylist()[-1][0]
                return np.array([found["x_range"], found["y_range"]])
    raise AssertionError("the animation has no ranges")


coordinate, length = st.floats(-10, 10), st.floats(0.1, 3)
BOXES = st.lists(st.tuples(coordinate, coordinate, length, length, st.floats(-4, 4)), min_size=1, max_size=5)


@given(boxes=BOXES, k=st.integers(0, 4))
def test_a_box_is_covered_and_no_more(boxes: list[tuple[float, ...]], k: int, tmp_path_factory: Any) -> None:
    k, path = min(k, len(boxes) - 1), tmp_path_factory.mktemp("box") / "run.rrd"
    x, y, width, height, angle = boxes[k]
    shapes = [km.scene.Box("box", box[:2], box[2:4], box[4]) for box in boxes]
    path = strips(drawn(path, lambda x: [shapes[int(x)]], range(len(boxes))), "world/box", k)[0]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    size, r = np.array([width, height]), min(width, height) / 8
    local = (path - (x, y)) @ turn
    np.testing.assert_allclose(np.abs(local).max(axis=0) + r, size / 2, atol=1e-4)
    inside = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2)) * (size - 2 * r)
    assert max(distance(point, local) for point in inside) <= r + 1e-4


def distance(point: np.ndarray, path: np.ndarray) -> float:
    """Return the least distance of a point from a polyline."""
    a, d = path[:-1], np.diff(path, axis=0)
    t = np.clip(np.einsum("ij,ij->i", point - a, d) / np.maximum(np.einsum("ij,ij->i", d, d), 1e-12), 0, 1)
    return float(np.linalg.norm(point - a - t[:, None] * d, axis=1).min())


@pytest.mark.parametrize(
    ("shape", "low", "high"),
    [
        (km.scene.Line("s", [(-1.0, 0.0), (3.0, 1.0)], width=0.2), (-1.1, -0.1), (3.1, 1.1)),
        (km.scene.Disk("s", (1.0, 2.0), 0.5), (0.5, 1.5), (1.5, 2.5)),
        (km.scene.Box("s", (0.0, 0.0), (2.0, 4.0), np.pi / 2), (-2.0, -1.0), (2.0, 1.0)),
    ],
)
def test_the_animation_shows_every_shape_whole_and_up_is_up(
    shape: km.scene.Shape, low: tuple, high: tuple, tmp_path: Path
) -> None:
    log = drawn(path := tmp_path / "run.rrd", lambda _: [shape, km.scene.Line("nowhere", [])])
    if isinstance(shape, km.scene.Line):
        np.testing.assert_array_equal(strips(log, "world/s")[0], shape.points)
    (x0, x1), (y0, y1) = ranges(path)
    assert x0 < low[0] < high[0] < x1
    assert y0 < -high[1] < -low[1] < y1
    margin = 0.06 * max(high[0] - low[0], high[1] - low[1])
    np.testing.assert_allclose([x1 - high[0], y1 + low[1]], margin, atol=1e-3)


def test_only_what_moves_is_drawn_ahead_and_fades(tmp_path: Path) -> None:
    rail = km.scene.Line("rail", [(0.0, 0.0), (1.0, 0.0)])
    plans = np.array([[0.0, 1.0, 2.0], [np.nan] * 3])
    log = drawn(
        tmp_path / "run.rrd", lambda x: [rail, km.scene.Disk("cart", (x, 0.0), 0.1, color=(0, 0, 0))], (0, 0), plans
    )
    assert log.rows("world/prediction/rail", "strips")[0] == []
    assert [round(strip[:, 0].mean()) for strip in strips(log, "world/prediction/cart")] == [2, 1]
    at, colors = log.rows("world/prediction/cart", "colors")
    assert at == [0]
    far, near = (value >> 24 for value in colors[0])
    assert 0 < near < far < 247


@given(horizon=st.integers(1, 200))
def test_the_last_stage_is_always_among_those_drawn(horizon: int, tmp_path_factory: Any) -> None:
    plan = np.arange(horizon + 1.0)[None]
    log = drawn(
        tmp_path_factory.mktemp("stages") / "run.rrd", lambda x: [km.scene.Disk("d", (x, 0.0), 0.1)], plans=plan
    )
    stages = [round(strip[:, 0].mean()) for strip in strips(log, "world/prediction/d")]
    assert stages[0] == horizon
    assert stages == sorted(set(stages), reverse=True)
    assert 1 <= len(stages) <= 4
    assert stages[-1] >= 1


def test_a_prediction_that_diverges_does_not_push_the_scene_out_of_sight(tmp_path: Path) -> None:
    shown = {}
    for end in (0.0, 0.2, 1e6):
        drawn(path := tmp_path / "run.rrd", lambda x: [km.scene.Disk("d", (x, 0.0), 1.0)], plans=np.array([[0.0, end]]))
        shown[end] = ranges(path)[0]
    assert shown[0.2][1] - shown[0.0][1] == pytest.approx(0.2, abs=1e-3)
    assert 0.2 < shown[1e6][1] - shown[0.0][1] < 1.0
    assert shown[1e6][0] == shown[0.0][0]


def test_a_shape_that_comes_or_goes_is_named(tmp_path: Path) -> None:
    rail, cart, wall = (km.scene.Disk(name, (0.0, 0.0), 0.1) for name in ("rail", "cart", "wall"))
    drawn(tmp_path / "run.rrd", lambda x: [rail, cart, rail] if x < 1 else [cart, rail], (0, 1))
    for scene, told in (([rail], "lacks the shape 'cart'"), ([rail, cart, wall], "has a new shape 'wall'")):
        with pytest.raises(km.errors.DataError, match=f"the scene of step 1 {told}; a scene returns the same"):
            drawn(tmp_path / "run.rrd", lambda x, scene=scene: [rail, cart] if x < 1 else scene, (0, 1))


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


def test_a_scene_in_space_stands_in_the_log_where_it_was_drawn(tmp_path: Path) -> None:
    run = recorded(path := tmp_path / "run.rrd")
    angles, log = run.X[:, 0], Logged(path)
    tips = np.column_stack([np.cos(angles), np.sin(angles), 0.5 + 0 * angles])
    booms, balls = log.rows("world/boom", "strips")[1], log.rows("world/tip", "positions")[1]
    assert len(booms) == len(balls)
    np.testing.assert_allclose([row[0][1] for row in booms], tips[: len(booms)], atol=1e-6)
    np.testing.assert_allclose([row[0] for row in balls], tips[: len(balls)], atol=1e-6)
    assert log.rows("world/tip", "radii")[1][0] == pytest.approx([0.2])
    assert log.rows("world/boom", "radii")[1][0] == pytest.approx([0.05])
    np.testing.assert_allclose(log.rows("world/body", "half_sizes")[1][0], [[0.2, 0.3, 0.4]], atol=1e-6)
    for row, angle in zip(log.rows("world/body", "quaternions")[1], angles, strict=False):
        found = Rotation.from_quat(row[0]).apply([1.0, 0.0, 0.0])
        np.testing.assert_allclose(found, [np.cos(angle), np.sin(angle), 0.0], atol=1e-6)
    for row, angle in zip(log.rows("world/panel", "quaternions")[1], angles, strict=False):  # about the x-axis
        found = Rotation.from_quat(row[0]).apply([0.0, 1.0, 0.0])
        np.testing.assert_allclose(found, [0.0, np.cos(angle), np.sin(angle)], atol=1e-6)


def test_a_log_in_space_becomes_a_video_in_which_what_is_near_hides_what_is_far(tmp_path: Path) -> None:
    recorded(path := tmp_path / "run.rrd")
    assert koopmpc("export-video", path, video := tmp_path / "run.gif").exit_code == 0
    assert video.read_bytes()[:6] == b"GIF89a"


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
