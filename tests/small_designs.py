"""Small designs: two models, and fewer and shorter loops, for tests of what becomes of a design, not of its choice."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

import koopmpc as km
from koopmpc.data.episodes import Episodes
from koopmpc.synthesis.search.candidates import Candidate

PROMISE, TASK, CANDIDATES = (
    importlib.import_module(f"koopmpc.synthesis.{file}") for file in ("promise", "task", "search.candidates")
)
FINALISTS = importlib.import_module("koopmpc.synthesis.loops.finalists")
NEIGHBOURS = importlib.import_module("koopmpc.synthesis.loops.neighbours")


def propose_two(episodes: Episodes, _: object, bilinear: bool, *__: object) -> list[Candidate]:
    """Return a linear model and one with squares, and where bilinear models are asked for one of these too."""
    plain = km.State() + km.Constant()
    squares = plain + km.State() * km.State()
    tried = [Candidate("x, 1", plain), Candidate("squares", squares)]
    tried += [Candidate("squares", squares, bilinear=True)] * bilinear
    return [one.bind(episodes.states, episodes.inputs) for one in tried]


@contextmanager
def short_loops() -> Iterator[None]:
    """Let designs run fewer and shorter loops, and choose the slope of nearest rows by fewer forecasts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PROMISE, "MANY", 100)
        patch.setattr(FINALISTS, "COMPARISON", replace(FINALISTS.COMPARISON, loops=20, further=40))
        patch.setattr(TASK, "LENGTHS", replace(TASK.LENGTHS, longest=60, moving=60))
        patch.setattr(NEIGHBOURS, "SETTINGS", replace(NEIGHBOURS.SETTINGS, begun=80))
        yield


@contextmanager
def undrawn_pages() -> Iterator[None]:
    """Let pages of designs and checks hold no pictures, whose rendering takes longer than a check with few runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("koopmpc.apps.fitting.report.render_svg", lambda _: "<svg></svg>")
        yield


@contextmanager
def small_designs() -> Iterator[None]:
    """Let designs try two models, from few starts and in short loops."""
    with short_loops(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(CANDIDATES, "propose_candidates", propose_two)
        patch.setattr(TASK, "LENGTHS", replace(TASK.LENGTHS, starts=6))
        yield
