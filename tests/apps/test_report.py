"""The report of a design: one file without links or scripts, its marks where the logs were repaired, its escapes."""

import re
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest

from tests.apps.mass import design
from tests.commands import koopmpc
from tests.small_designs import small_designs

EVIL = "level</svg><script>alert(1)</script> $\\frac$ ![p](http://e.org/p.png) &--> [m]"
GOAL = f"""
horizon = 6

[states.'{EVIL}']
reference = 1.0
weight = 1.0
limits = [0.2, 1.5]

[inputs."flow [l/s]"]
weight = 0.01
limits = [0.0, 2.0]
"""


class Reader(HTMLParser):
    """Tags, what they load or link to, and the words of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.places, self.ids, self.words, self.headings = [], [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.places += [v for k, v in attrs if k in ("href", "src", "xlink:href", "data", "srcset", "action")]
        self.ids += [v for k, v in attrs if k == "id"]

    def handle_data(self, data):
        self.words.append(data)
        if self.tags[-1] in ("h1", "h2"):
            self.headings.append(data)


def write_tank(folder):
    """Write eight logs of a leaking tank, in which one level is wild and one sensor is stuck."""
    rng = np.random.default_rng(3)
    folder.mkdir()
    for number in range(8):
        x, lines = rng.uniform(0.3, 1.4), []
        for k in range(60):
            u = rng.uniform(0.2, 1.8) if k % 8 == 0 else u
            seen = x + rng.normal(0, 0.002)
            seen = 99.0 if (number, k) == (2, 40) else seen
            lines.append([0.5 * k, seen, u])
            x += 0.5 * (0.2 * u - 0.2 * x)
        if number == 5:
            for k in range(30, 55):
                lines[k][1] = lines[29][1]
        head = f"time [s],{EVIL},flow [l/s]"
        np.savetxt(folder / f"{number}.csv", lines, delimiter=",", header=head, comments="", fmt="%.4f")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_tank(folder / "logs")
    with small_designs():
        return design(folder, GOAL, folder / "logs")


SECTIONS = [
    "What was asked",
    "What the logs hold",
    "Which controller and model",
    "Measured and forecast",
    "Closed loops on stand-ins of the plant",
    "Where it is blind",
    "What it promises",
    "What to record next, and what else would help",
    "How to run it",
]


def is_alone(page):
    """Return whether a page loads nothing, runs nothing, and gives each id once."""
    forbidden = {"script", "link", "iframe", "object", "embed", "form", "base"}
    return not (
        forbidden & set(page.tags)
        or [place for place in page.places if not place.startswith("#")]
        or len(page.ids) != len(set(page.ids))
    )


def read_page(text):
    """Return what a page holds, after a look whether it stands alone, has every section, and shows the log's faults."""
    page = Reader(text)
    assert is_alone(page)
    assert [heading for heading in page.headings if heading in SECTIONS] == SECTIONS
    words = " ".join(" ".join(page.words).split())
    for part in (EVIL, "0.2 to 1.5", "= 99 m", "weight = 0.01", "koopmpc check", "95 % confidence"):
        assert part in words
    assert page.tags.count("figure") >= 5
    return words


def test_the_page_of_a_design_is_one_file_with_every_section_and_foreign_names_are_text(made):
    text = made.page.read_text()
    words = read_page(text)
    assert "default-src 'none'" in text
    assert not re.search(r"\{[a-z_.]+\}", words.replace(EVIL, ""))
    assert not list(made.page.parent.glob("*.png"))


@pytest.mark.parametrize("source", ["logs", "memory"])
def test_the_page_of_a_check_shows_the_same_and_the_verdict_first(made, tmp_path, source):
    file = made.controller
    if source == "memory":
        made.design.save(file := tmp_path / "design.npz")
    done = koopmpc("check", file, "--runs", 1, "--rate", 0.5, "--logs", tmp_path)
    text = next(tmp_path.glob("*-check/report.html")).read_text()
    assert str(tmp_path) in done.stdout
    assert unescape(text).index("goal is") < text.index("What was asked")
    assert "inputs 20 % weaker" in text
    if source == "logs":
        read_page(text)
    else:
        page = Reader(text)
        assert is_alone(page)
        assert [heading for heading in page.headings if heading in SECTIONS] == SECTIONS
