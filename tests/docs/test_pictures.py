"""No picture of the site is older than the code, the problem file or the page that it was drawn from."""

import json
import sys

import pytest

from tests.docs.page import DOCS

sys.path.insert(0, str(DOCS / "tools"))
import drawn


def test_every_picture_is_younger_than_what_drew_it():
    stale = {picture: drawn.inputs_of(picture) for picture in drawn.find_stale() if (DOCS / picture).exists()}
    assert not stale, f"draw them again, see docs/tools/drawn.py: {stale}"
    stamped = json.loads(drawn.STAMPS.read_text(encoding="utf-8"))
    assert set(stamped) == set(drawn.list_pictures())


def test_a_change_of_code_or_data_makes_a_picture_old_and_a_change_of_words_does_not():
    picture = "problems/pendulum/run.png"

    def read_changed(path, old, new):
        text = (drawn.ROOT / path).read_text(encoding="utf-8")
        return text.replace(old, new, 1) if path == "problems/pendulum.py" else text

    now = drawn.digest_inputs(picture)
    for old, new, same in (
        ("L: float = 2.0", "L: float = 2.1", False),
        ("# mass [kg]", "# mass of the bob [kg]", True),
        ('"""Pendulum:', '"""The pendulum:', True),
    ):
        assert (drawn.digest_inputs(picture, lambda path, o=old, n=new: read_changed(path, o, n)) == now) is same


@pytest.mark.parametrize("name", ["pendulum", "cart_pole"])
def test_a_picture_depends_on_the_functions_that_draw_it_and_the_problem_that_they_load(name):
    picture = {"pendulum": "pictures/house.png", "cart_pole": "pictures/cart_pole.png"}[name]
    text = (drawn.ROOT / "docs/tools/pictures.py").read_text(encoding="utf-8")
    assert f'load_problem("{name}")' in text

    def read(path):
        source = (drawn.ROOT / path).read_text(encoding="utf-8")
        return source.replace("dt=", "dt=2*", 1) if path == f"problems/{name}.py" else source

    assert drawn.digest_inputs(picture, read) != drawn.digest_inputs(picture)
