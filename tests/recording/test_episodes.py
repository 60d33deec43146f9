"""Logs of runs are read as the episodes that they hold."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from tests.recording.runs import make_run


def test_a_log_is_its_episode(tmp_path: Path) -> None:
    run = make_run(T=12)
    km.record(run, tmp_path / "run.rrd")
    read = km.load_episodes(tmp_path / "run.rrd")
    assert (read.dt, read.states, read.inputs) == (run.dt, run.states, run.inputs)
    assert np.array_equal(read[0].X, run.X)
    assert np.array_equal(read[0].U, run.U)


def test_a_log_is_read_by_a_process_that_has_recorded_nothing(tmp_path: Path) -> None:
    km.record(make_run(T=12), tmp_path / "run.rrd")
    code = f"import koopmpc as km; print(len(km.load_episodes({str(tmp_path / 'run.rrd')!r})[0].U))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "12\n"


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.rrd").write_bytes(b"nothing")
    with pytest.raises(km.errors.LogError):
        km.load_episodes(tmp_path / "run.rrd")
