"""The pages on plants from elsewhere run as they stand, and do what they say."""

import numpy as np
import pytest

import koopmpc as km
from tests.docs.page import alike, blocks, run
from tests.plants import units


def test_a_gymnasium_plant_is_swung_up_in_fifteen_lines(tmp_path):
    pytest.importorskip("gymnasium", reason="the extra gym is not installed")
    (block,) = blocks("how/gymnasium.md")
    assert len([line for line in block.source.splitlines() if line.strip()]) <= 15
    swing = run("how/gymnasium.md", tmp_path)[0]["run"]
    assert np.cos(swing.X[-1, 0]) > 0.999
    assert abs(swing.X[-1, 1]) < 0.01
    assert np.cos(swing.X[0, 0]) < -0.999
    assert np.abs(swing.U).max() <= 2
    assert km.load_run(tmp_path / "gym.rrd") == swing


def test_a_tank_that_is_a_function_is_filled(tmp_path):
    names, (said,) = run("how/own_step_function.md", tmp_path)
    assert alike(*said)
    level = names["level"]
    assert abs(level.X[-1, 0] - 1.5) < 0.02
    assert 0 <= level.U.min() <= level.U.max() <= 0.1


def test_the_units_of_the_page_on_fmus_are_controlled(tmp_path):
    pytest.importorskip("fmpy", reason="the extra fmu is not installed")
    units.build_pendulum(tmp_path / "pendulum.fmu")
    names, said = run("how/fmu.md", tmp_path)
    assert len(said) == 2
    for shown, printed in said:
        assert alike(shown, printed), printed
    assert abs(names["run"].U).max() <= 5
