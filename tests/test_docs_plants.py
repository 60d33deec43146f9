"""docs/plants.md runs as it stands, and does what it says."""

import re
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km

GYM, TANK = re.findall(
    r"```python\n(.*?)```", (Path(__file__).parents[1] / "docs" / "plants.md").read_text(), re.DOTALL
)


def test_a_gymnasium_plant_is_swung_up_in_fifteen_lines(tmp_path, monkeypatch):
    pytest.importorskip("gymnasium", reason="the extra gym is not installed")
    assert len([line for line in GYM.splitlines() if line.strip()]) <= 15
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    exec(GYM, found)
    run = found["run"]
    assert np.cos(run.X[-1, 0]) > 0.999
    assert abs(run.X[-1, 1]) < 0.01
    assert np.cos(run.X[0, 0]) < -0.999
    assert np.abs(run.U).max() <= 2
    assert km.load_run("gym.rrd") == run


def test_a_tank_that_is_a_function_is_filled():
    found: dict = {"km": km}
    exec(TANK, found)
    level = found["level"]
    assert abs(level.X[-1, 0] - 1.5) < 0.02
    assert 0 <= level.U.min() <= level.U.max() <= 0.1
