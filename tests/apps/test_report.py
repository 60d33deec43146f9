"""The report of a design: one file without links or scripts, its marks where the logs were repaired, its escapes."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.apps.fitting.check import check_controller
from koopmpc.apps.fitting.designing import design_data
from koopmpc.apps.fitting.logs import read_logs
from koopmpc.apps.fitting.options import FitOptions
from koopmpc.apps.fitting.report import _SHOWN, _add_goal, _choose_columns
from koopmpc.base.page import HtmlPage
from koopmpc.models.base import load_value
from koopmpc.synthesis.designed import SavedDesign
from koopmpc.validate.bands import forecast
from koopmpc.validate.logs.log import Place
from koopmpc.validate.logs.summary import excerpt_logs
from koopmpc.views.figures.evidence import draw_forecast, draw_log, draw_loops
from koopmpc.views.figures.style import render_svg
from tests.small_designs import small_designs

EVIL = 'x</svg><script>alert(1)</script> $\\frac$ ![p](http://e.org/p.png) "&--> [m]'
GOAL = """
horizon = 6

[states."level [m]"]
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
        head = "time [s],level [m],flow [l/s]"
        np.savetxt(folder / f"{number}.csv", lines, delimiter=",", header=head, comments="", fmt="%.4f")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_tank(folder / "logs")
    (folder / "goal.toml").write_text(GOAL)
    with small_designs():
        return design_data(folder / "logs", folder / "goal.toml", folder / "out", FitOptions(linear=True))


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


def test_the_page_of_a_design_is_one_file_with_every_section_and_the_wild_reading(made):
    text = made.page.read_text()
    page = Reader(text)
    assert is_alone(page)
    assert "default-src 'none'" in text
    assert [heading for heading in page.headings if heading in SECTIONS] == SECTIONS
    words = " ".join(" ".join(page.words).split())
    for part in ("0.2 to 1.5", "level = 99 m", "weight = 0.01", "koopmpc check", "95 % confidence"):
        assert part in words
    assert not re.search(r"\{[a-z_.]+\}", words)
    assert page.tags.count("figure") >= 5
    assert made.page.parent.name not in [path.suffix for path in made.page.parent.glob("*.png")]


def test_the_page_of_a_check_shows_the_same_and_the_verdict_first(made, tmp_path):
    done = check_controller(made.controller, tmp_path, runs=1, rate=0.5)
    page = Reader(done.page.read_text())
    assert is_alone(page)
    assert [heading for heading in page.headings if heading in SECTIONS] == SECTIONS
    words = " ".join(page.words)
    assert "level = 99 m" in words
    assert words.index("goal is") < words.index("What was asked")
    assert "inputs 20 % weaker" in words


def test_the_file_of_a_design_keeps_the_marks_and_forecasts_of_rows_that_no_fit_saw(made):
    logs = load_value(made.controller, SavedDesign).logs
    marked = [(row[0], row[2]) for row in logs.excerpt.replaced] + [tuple(span) for span in logs.excerpt.left_out]
    assert any(abs(a - (2 * 30.0 + 20.0)) < 1.5 for a, _ in marked), "the wild reading of the third log at 20 s"
    ahead = logs.forecasts[0]
    assert len(ahead.truth) - 1 == len(logs.error) == 6, "the horizon of the goal"
    assert "flow [l/s]" in logs.goal


def test_a_design_from_memory_has_a_page_too(made, tmp_path):
    design = made.design
    design.save(tmp_path / "design.npz")
    assert load_value(tmp_path / "design.npz", SavedDesign).logs is None
    page = Reader(check_controller(tmp_path / "design.npz", tmp_path, runs=1, rate=0.5).page.read_text())
    assert [heading for heading in page.headings if heading in SECTIONS] == SECTIONS


def test_rows_of_a_leaderboard_that_differ_in_the_tail_alone_are_one(made):
    design, row = made.design, made.design.best
    twin = replace(row, recipe=replace(row.recipe, tail=3))
    other = replace(twin, score=9.876)
    for place in (0, len(design.leaderboard)):
        board = [*design.leaderboard]
        board[place:place] = [twin]
        chosen = design.chosen + (place == 0)
        text = str(replace(design, leaderboard=(*board, other), chosen=chosen))
        rows = re.findall(r"%  +\d+ of \d+$", text, re.MULTILINE)
        assert len(rows) <= len(design.leaderboard) + 1
        assert any("more alike" in line for line in text.splitlines())
        assert sum(line.startswith("→") for line in text.splitlines()) == 1
        assert any("9.876" in line for line in text.splitlines()) or len(design.leaderboard) > 14


def test_logs_are_kept_whole_and_marked_where_a_file_was_repaired(tmp_path):
    write_tank(tmp_path / "logs")
    split = read_logs(tmp_path / "logs", 6, np.random.default_rng(0), 10**9, {"inputs": ["flow"]})
    excerpt = split.excerpt
    assert np.nanmax(excerpt.values[:, 0]) == 99.0  # as it was read, not as it was repaired
    assert len(excerpt.starts) == 8
    long = excerpt.left_out[np.diff(excerpt.left_out, axis=1)[:, 0] > 10]
    assert ((long > 5 * 30 + 14) & (long < 5 * 30 + 29)).all()
    assert len(long) == 1


@given(st.integers(0, 2**32 - 1))
def test_what_is_left_out_and_replaced_is_what_the_pieces_lack_and_change(seed):
    rng = np.random.default_rng(seed)
    raw = km.Episodes(
        [km.Episode(X=rng.normal(size=(n + 1, 2)), U=rng.normal(size=(n, 1))) for n in rng.integers(6, 20, 3)], 0.5
    )
    pieces, origins, changed, kept = [], [], [], np.zeros(0, bool)
    for e, episode in enumerate(raw):
        first, last = sorted(rng.choice(len(episode) + 1, 2, replace=False))
        mask = np.zeros(len(episode) + 1, bool)
        if last - first >= 2:
            X = episode.X[first : last + 1].copy()
            i, j = rng.integers(len(X)), rng.integers(2)
            changed.append((X[i, j], X[i, j] + 1.0))
            X[i, j] += 1.0
            pieces.append(km.Episode(X=X, U=episode.U[first:last]))
            origins.append(Place(e, int(first), int(last) + 1))
            mask[first : last + 1] = True
        kept = np.concatenate([kept, mask])
    if not pieces:
        return
    excerpt = excerpt_logs(raw, raw.with_episodes(pieces), origins)
    rows = np.isfinite(excerpt.values[:, 0])
    t = excerpt.time[rows]
    out = np.zeros(len(t), bool)
    for begin, end in excerpt.left_out:
        out |= (t > begin) & (t < end)
    np.testing.assert_array_equal(out, ~kept)
    assert sorted((was, now) for _, _, was, now in excerpt.replaced) == sorted(changed)
    assert len(t) == sum(len(episode) + 1 for episode in raw)


def test_many_rows_are_thinned_and_no_mark_is_lost():
    rng = np.random.default_rng(0)
    raw = km.Episodes([km.Episode(X=rng.normal(size=(50_001, 1)), U=rng.normal(size=(50_000, 1)))], 1.0)
    X = raw[0].X.copy()
    X[12_345] = 7.0
    excerpt = excerpt_logs(raw, raw.with_episodes([km.Episode(X=X, U=raw[0].U)]), [Place(0, 0, 50_001)])
    assert len(excerpt.time) < 5_000
    assert excerpt.replaced[:, [0, 3]].tolist() == [[12_345.0, 7.0]]
    assert 12_345.0 in excerpt.time


def test_foreign_names_are_text_in_pages_and_pictures():
    raw = km.Episodes(
        [km.Episode(X=np.random.default_rng(0).normal(size=(30, 1)), U=np.ones((29, 1)))], 1.0, [EVIL], ["u_{$"]
    )
    model = km.LinearPredictor([[1.0]], [[1.0]], [[1.0]], km.State(), 1.0, [EVIL], ["u_{$"])
    curve = np.arange(5.0), np.arange(5.0)
    figures = [
        draw_log(excerpt_logs(raw), 0),
        draw_forecast(forecast(model, raw[0], 5), 0),
        draw_loops(EVIL, {EVIL: [curve]}, [1.0], curve, steps=True),
    ]
    page = HtmlPage(EVIL)
    page.heading(EVIL)
    page.text(EVIL)
    page.items([EVIL])
    page.code(EVIL)
    page.verdict("good", EVIL, EVIL)
    page.table([EVIL], [[EVIL]])
    page.pictures([(render_svg(figure), EVIL) for figure in figures])
    seen = Reader(page.html)
    assert is_alone(seen)
    assert seen.tags.count("svg") == 3
    assert sum(EVIL in words for words in seen.words) >= 8


@pytest.mark.parametrize(("nx", "nu", "nw"), [(1, 1, 0), (2, 1, 3), (9, 9, 9), (30, 2, 40)])
def test_the_first_of_each_kind_of_columns_are_drawn(nx, nu, nw):
    rng = np.random.default_rng(0)
    one = km.Episode(X=rng.normal(size=(31, nx)), U=rng.normal(size=(30, nu)), W=rng.normal(size=(30, nw)))
    raw = km.Episodes([one], 1.0)
    kinds = [range(nx), range(nx, nx + nu), range(nx + nu, nx + nu + nw)]
    assert _choose_columns(excerpt_logs(raw)) == [i for kind in kinds for i in kind[:_SHOWN]]


def test_a_goal_that_no_input_holds_is_said_where_it_is_asked(made):
    evidence, words = (
        load_value(made.controller, SavedDesign).evidence,
        "No input inside the limits holds the reference",
    )
    for holds in (True, False):
        page = HtmlPage("")
        _add_goal(page, replace(evidence, goal_can_be_held=holds), made.design.controller)
        assert (words in page.html) != holds
