"""Logs of runs are read as the episodes that they hold."""

from pathlib import Path

import numpy as np
import pytest

from koopmpc.data.storage import load_episodes
from koopmpc.errors import LogError
from koopmpc.recording.recorder import record
from tests.recording.runs import make_run


def test_a_log_is_its_episode(tmp_path: Path) -> None:
    run = make_run(T=12)
    record(run, tmp_path / "run.rrd")
    read = load_episodes(tmp_path / "run.rrd")
    assert (read.dt, read.states, read.inputs) == (run.dt, run.states, run.inputs)
    assert np.array_equal(read[0].X, run.X)
    assert np.array_equal(read[0].U, run.U)


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.rrd").write_bytes(b"nothing")
    with pytest.raises(LogError):
        load_episodes(tmp_path / "run.rrd")
