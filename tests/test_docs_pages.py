"""Pages of the documentation run as they stand, and do what they say."""

import contextlib
import re
import subprocess
import warnings

import numpy as np
import pytest

import koopmpc as km
from tests.docs.page import DOCS, alike, blocks, run
from tests.plants import units
from tests.small_designs import small_designs


def test_the_model_of_the_page_on_adaptive_controllers_knows_what_it_says(tmp_path):
    mpc = run("adaptive.md", tmp_path)[0]["mpc"]
    mpc.reset()
    assert mpc([0.1, 0.2], [0, 0]).known
    assert not mpc([1.0, 40.0], [0, 0]).known


def test_the_controllers_of_their_page_do_what_it_says(tmp_path):
    names, offsets = run("controllers.md", tmp_path)[0], []
    for name in ("mpc", "exact"):
        loop = km.simulate(names["heavy"], names[name], x0=names["x"], reference=[0.5, 0.0], steps=250)
        offsets.append(abs(loop.X[-1, 0] - 0.5))
    assert offsets[0] > 0.01
    assert offsets[1] < 1e-6
    assert abs(names["energy"](names["up"].X)[-1] - names["upright"]) < 1e-2
    assert np.abs(names["up"].U).max() <= 2.0
    assert np.abs(names["up"].X[:, 0]).min() < 0.2
    assert names["again"].iterations < names["move"].iterations
    assert np.abs(names["run"].U).max() <= 25


def test_one_sensor_is_enough_by_its_past_and_by_a_filter(tmp_path):
    hidden = run("how/hidden_states.md", tmp_path)[0]
    assert abs(hidden["state"][0] - 0.5) < 1e-3
    assert abs(hidden["swing"][0]) < 1e-2


def test_every_source_that_the_table_of_features_names_is_at_its_foot():
    table, foot = (DOCS / "beside_others.md").read_text().split("## Sources")
    named = {key for group in re.findall(r"\[([mdal]\d+(?:, [mdal]\d+)*)\]", table) for key in group.split(", ")}
    assert named == set(re.findall(r"\b([mdal]\d+)\b", foot))


@pytest.mark.parametrize(
    "size", [small_designs, pytest.param(contextlib.nullcontext, marks=pytest.mark.slow)], ids=["small", "as it stands"]
)
def test_a_design_from_data_ends_in_a_controller_that_holds_the_pendulum_inside_its_limits(size, tmp_path, capsys):
    names: dict = {"__name__": "page"}
    with contextlib.chdir(tmp_path), warnings.catch_warnings(), size():
        for block in blocks("design-from-data.md"):
            exec(compile(block.source, "docs/design-from-data.md", "exec"), names)
    said = capsys.readouterr().out
    assert "0 of 12" in said
    violation, upright = said.split()[-2:]
    assert float(violation) <= 0.01
    assert upright == "True"
    assert names["design"].controller.limits.margin is not None


def test_the_page_on_trust_prints_what_it_shows_of_a_good_and_a_bad_model(tmp_path):
    names, pairs = run("how/trust.md", tmp_path)
    assert all(alike(*pair) for pair in pairs)
    assert pairs[0][1].startswith("TRUST")
    assert "DO NOT TRUST beyond" in pairs[1][1]
    held_out = names["held_out"]
    good = km.trust(names["good"], held_out, 12, train=names["train"])
    bad = km.trust(names["bad"], held_out, 12, train=names["timid"])
    assert (good.trusted, bad.trusted) == (True, False)
    assert (good.score.rmse[-1] < bad.score.rmse[-1]).all()
    assert names["bad"].report.residual[1] < names["good"].report.residual[1]  # as the page says
    assert names["report"].closed_loop.share < 0.9  # feedback breaks the band, and calibrating restores it
    assert names["again"].high > 0.9


def test_the_page_on_machines_runs_as_it_stands(tmp_path):
    text = (DOCS / "on_the_machine.md").read_text(encoding="utf-8")
    run("on_the_machine.md", tmp_path)
    printed = subprocess.run(
        ["make", "-s", "run", "CFLAGS=-O0"], cwd=tmp_path / "controller", capture_output=True, text=True, check=True
    ).stdout.splitlines()
    shown = [line.strip() for line in text.splitlines() if re.match(r"    (step|\d+),", line)]
    assert printed[0] == shown[0]
    for line, wanted in zip(printed[1:], shown[1:], strict=False):
        numbers = [[float(word) for word in each.split(",")] for each in (line, wanted)]
        assert max(abs(a - b) for a, b in zip(*numbers, strict=True)) < 1e-4


def test_the_page_on_compiled_controllers_says_what_is_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in blocks("how/compiled.md"):
        exec(compile(block.source, "docs/how/compiled.md", "exec"), names)
    assert capsys.readouterr().out.splitlines()[-2:] == ["True", "(1000, 201, 2) (1000, 200, 1) True"]


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
    assert all(alike(*pair) for pair in said)
    assert abs(names["run"].U).max() <= 5
