"""The law of a log: load_run(record(run)) is run, to the bit."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from koopmpc.errors import DataError
from koopmpc.loop.metrics import metrics
from koopmpc.recording.description import About, from_json, to_json, to_markdown
from koopmpc.recording.reader import load_run
from koopmpc.recording.recorder import record
from koopmpc.recording.rows import blocks, rows_of_run, run_of_rows
from koopmpc.recording.scene import Box, Disk, Line
from tests.recording.runs import make_run, options


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(some=options)
@example(some={"nx": 1, "nu": 2, "T": 1, "N": None, "cost": False, "limits": False})
@example(some={"nx": 5, "T": 3, "odd": 1.0})
def test_a_log_reads_back_to_the_bit(some: dict[str, Any], tmp_path: Path) -> None:
    run = make_run(**some)
    record(run, tmp_path / "run.rrd")
    assert load_run(tmp_path / "run.rrd") == run


@pytest.mark.slow
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(some=options)
def test_many_logs_read_back_to_the_bit(some: dict[str, Any], tmp_path: Path) -> None:
    run = make_run(**some)
    record(run, tmp_path / "run.rrd")
    assert load_run(tmp_path / "run.rrd") == run


def test_the_scene_and_hidden_states_leave_the_run_as_it_was(tmp_path: Path) -> None:
    def scene(x: np.ndarray, u: np.ndarray) -> list[Line | Box | Disk]:
        at = (float(x[0]), float(u[0]))
        return [
            Line("a line/of names", [(0.0, 0.0), at]),
            Box("box", at, (1.0, 2.0), float(x[1])),
            Disk("disk", at, 0.1),
        ]

    run = make_run()
    hidden = replace(run, X=np.full_like(run.X, np.nan))
    broken = replace(run, X=np.where(np.arange(21)[:, None] == 7, np.nan, run.X))
    for i, some in enumerate((run, hidden, broken)):
        record(some, tmp_path / f"{i}.rrd", scene=scene)
        assert load_run(tmp_path / f"{i}.rrd") == some


@pytest.mark.parametrize("ahead", [False, True])
def test_a_scene_whose_shapes_change_is_refused(ahead: bool, tmp_path: Path) -> None:
    run = make_run(N=3 if ahead else None)
    odd = float(run.plans.X[7, -1, 0] if run.plans is not None else run.X[7, 0])

    def scene(x: np.ndarray, u: np.ndarray) -> list[Disk]:
        bob, lamp = Disk("bob", (0.0, 0.0), 1.0), Disk("lamp", (0.0, 0.0), 1.0)
        return [bob, lamp] if x[0] == odd else [bob]

    with pytest.raises(DataError, match="the scene of step 7 has a new shape 'lamp'"):
        record(run, tmp_path / "run.rrd", scene=scene)


@settings(max_examples=30)
@given(T=st.integers(1, 12), least=st.integers(1, 4), most=st.integers(1, 6), k=st.integers(0, 5))
def test_blocks_are_the_rows(T: int, least: int, most: int, k: int) -> None:
    run = make_run(T=T, N=2)
    rows = replace(rows_of_run(run), k=k, planned=np.arange(k, k + T))
    parts = blocks(rows, least, most)
    assert len(parts) <= most
    assert all(len(part.U) >= min(least, T) for part in parts)
    assert [part.k for part in parts] == [k + sum(len(p.U) for p in parts[:i]) for i in range(len(parts))]
    assert run_of_rows(parts, About.of(run)) == replace(run, plans=None)
    assert all(np.array_equal(p.planned, p.k + np.arange(len(p.U))) for p in parts)
    assert np.array_equal(np.concatenate([p.plan_X for p in parts]), run.plans.X)
    assert np.array_equal(np.concatenate([p.plan_U for p in parts]), run.plans.U)


def test_metrics_are_recomputed_from_the_log_alone(tmp_path: Path) -> None:
    run = replace(make_run(N=None), limits=None)
    record(run, tmp_path / "new folder" / "run.rrd")
    assert metrics(load_run(tmp_path / "new folder" / "run.rrd")) == metrics(run)


def test_an_autonomous_run_has_no_inputs_to_read(tmp_path: Path) -> None:
    none = np.empty((20, 0))
    run = replace(make_run(cost=False, limits=False, N=None), U=none, u_reference=none, inputs=())
    record(run, tmp_path / "run.rrd")
    assert load_run(tmp_path / "run.rrd") == run


def test_logs_of_one_problem_share_the_application_but_no_recording(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    run = make_run(metadata={"problem": "cart pole"})
    entries = []
    for name in ("a.rrd", "b.rrd"):
        record(run, tmp_path / name)
        entries += RrdReader(tmp_path / name).recordings()
    assert {entry.application_id for entry in entries} == {"koopmpc-cart_pole"}
    assert len({entry.recording_id for entry in entries}) == 2


def test_the_description_says_what_ran_and_with_what() -> None:
    told = {
        "problem": "pendulum",
        "case": "upright",
        "controller": "lqr",
        "seed": 7,
        "versions": {"casadi": "9.9"},
    }
    page = to_markdown(About.of(make_run(metadata=told)))
    assert page.startswith("# pendulum · upright · lqr")
    for part in (
        "| seed | 7 |",
        "casadi 9.9",
        "| u_max | [",
        "state 0 [m]",
        "written with",
        "rerun-sdk 0.41",
    ):
        assert part in page


def test_the_description_is_exact_data() -> None:
    run = make_run(metadata={"a": [1, 2.5, None], "b": {"c": float("nan")}, "d": np.arange(3.0)})
    about, steps = from_json(to_json(About.of(run), 20))
    assert about == About.of(run)
    assert steps == 20


def test_metadata_that_is_no_data_is_refused_before_a_file_is_made(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="a function cannot be saved as data; use numbers, names and arrays"):
        record(make_run(metadata={"controller": make_run}), tmp_path / "run.rrd")
    assert not (tmp_path / "run.rrd").exists()
