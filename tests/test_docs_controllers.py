"""The Python blocks of docs/controllers.md and docs/how/hidden_states.md run, and the pages say what they show."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.docs.page import run

DOCS = Path(__file__).parents[1] / "docs"
TEXT = (DOCS / "controllers.md").read_text()
BESIDE = (DOCS / "beside_others.md").read_text()


@pytest.fixture(scope="module")
def found():
    names = {}
    for source in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
        exec(compile(source, "docs/controllers.md", "exec"), names)
    return names


@pytest.fixture(scope="module")
def hidden(tmp_path_factory):
    return run("how/hidden_states.md", tmp_path_factory.mktemp("page"))[0]


def test_the_examples_show_what_the_page_says(found):
    km = found["km"]
    offsets = []
    for name in ("mpc", "exact"):
        loop = km.simulate(found["heavy"], found[name], x0=found["x"], reference=[0.5, 0.0], steps=250)
        offsets.append(abs(loop.X[-1, 0] - 0.5))
    assert offsets[0] > 0.01
    assert offsets[1] < 1e-6
    assert abs(found["energy"](found["up"].X)[-1] - found["upright"]) < 1e-2
    assert np.abs(found["up"].U).max() <= 2.0
    assert np.abs(found["up"].X[:, 0]).min() < 0.2
    assert found["again"].iterations < found["move"].iterations
    assert np.abs(found["run"].U).max() <= 25


def test_one_sensor_is_enough_by_its_past_and_by_a_filter(hidden):
    assert abs(hidden["state"][0] - 0.5) < 1e-3
    assert abs(hidden["swing"][0]) < 1e-2


def test_every_source_that_the_table_of_features_names_is_at_its_foot():
    table, foot = BESIDE.split("## Sources")
    named = {key for group in re.findall(r"\[([mdal]\d+(?:, [mdal]\d+)*)\]", table) for key in group.split(", ")}
    given = set(re.findall(r"\b([mdal]\d+)\b", foot))
    assert named == given
