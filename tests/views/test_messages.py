"""Mistakes at figures say what was got and what to do."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import koopmpc as km
from tests.views.models import episodes, three_states, turning
from tests.views.test_eigenfunctions import SQUARE
from tests.views.test_spectrum import diagonal

DATA, SHAPE = km.errors.DataError, km.errors.ShapeError
MODEL, EPISODES = turning(), episodes(12)
CUBE = three_states()


def planes(which: Any, axes: Any, over: Any, at: Any = None) -> Any:
    return km.plot.eigenfunction_maps(CUBE, which, axes, over, at=at, points=5)


MISTAKES = [
    (
        DATA,
        "the episode has 25 steps from step 5 on, the horizon is 26",
        lambda: km.plot.rollout(MODEL, EPISODES[0], 26, start=5),
    ),
    (
        SHAPE,
        "the episode has 3 states and 0 inputs, the predictor 2 and 1",
        lambda: km.plot.rollout(MODEL, km.Episode(X=np.zeros((4, 3)))),
    ),
    (SHAPE, "bands has 4 rows of 2, expected 5 of 2", lambda: km.plot.rollout(MODEL, EPISODES[0], 5, np.ones((4, 2)))),
    (
        DATA,
        "bands holds -1; half-widths are 0 or above",
        lambda: km.plot.rollout(MODEL, EPISODES[0], 5, -np.ones((5, 2))),
    ),
    (
        DATA,
        "the band is for predictions with relift=True; pass relift=True",
        lambda: km.plot.rollout(MODEL, EPISODES[0], 5, km.validate.conformal(MODEL, EPISODES, 5, relift=True)),
    ),
    (
        DATA,
        "asked for 0 states; choose 1 to 12 with states=…",
        lambda: km.plot.rollout(MODEL, EPISODES[0], 5, states=[]),
    ),
    (DATA, "there is no score; pass one", lambda: km.plot.error({})),
    (
        SHAPE,
        r"one score is of \(angle .*\), another of \(a \[m\], .*\); compare models of the same states",
        lambda: km.plot.error(
            {"one": km.score(MODEL, EPISODES, 3), "other": replace(km.score(MODEL, EPISODES, 3), states=CUBE.states)}
        ),
    ),
    (
        DATA,
        "the figure is asked for state 'x'; the states are angle",
        lambda: km.plot.error(km.score(MODEL, EPISODES, 3), states="x"),
    ),
    (
        DATA,
        r"the plane is asked for state 'd'; the states are a \[m\], b",
        lambda: planes(0, ("a", "d"), SQUARE),
    ),
    (DATA, r"both axes of the plane are b \[m/s\]; name two different states", lambda: planes(0, ("b", 1), SQUARE)),
    (
        DATA,
        r"the range of a \[m\] is 1 to -1; pass \(low, high\)",
        lambda: planes(0, (0, 1), [(1, -1), (0, 1)]),
    ),
    (SHAPE, r"at has shape \(2,\), expected \(3,\)", lambda: planes(0, (0, 1), SQUARE, [0, 0])),
    (DATA, r"there is no eigenfunction 3; the predictor has 0 … 2", lambda: planes(3, (0, 1), SQUARE)),
    (DATA, "which is empty; pass the index of an eigenfunction", lambda: planes([], (0, 1), SQUARE)),
    (
        DATA,
        r"eigenfunction 2 is 0 on the whole plane; fix the other states",
        lambda: planes([0, 2], (0, 1), SQUARE),
    ),
    (
        DATA,
        "there is no eigenfunction 2; the predictor has 0 … 1",
        lambda: km.plot.eigenfunction_maps(turning(), 2, (0, 1), SQUARE),
    ),
    (
        DATA,
        r"asked for state 'x'; the states are angle \[rad\]",
        lambda: km.plot.eigenfunction_maps(turning(), 0, ("x", 1), SQUARE),
    ),
    (SHAPE, r"residuals has shape \(3,\), expected \(2,\)", lambda: km.plot.spectrum(turning(), [0, 0, 0])),
    (DATA, "residuals holds -1; residuals are norms, 0 or above", lambda: km.plot.spectrum(turning(), [0, -1])),
    (
        SHAPE,
        "there are 2 residuals and 4 eigenvalues; pass the residuals of this",
        lambda: km.plot.spectrum(diagonal(), km.validate.residual_dmd(turning(), EPISODES)),
    ),
    (
        DATA,
        "the residuals are those of another predictor",
        lambda: km.plot.spectrum(turning(0.5), km.validate.residual_dmd(turning(), EPISODES)),
    ),
]


@pytest.mark.parametrize(("error", "text", "mistake"), MISTAKES, ids=[text for _, text, _ in MISTAKES])
def test_a_mistake_says_what_was_got_and_what_to_do(error: Any, text: str, mistake: Any) -> None:
    with pytest.raises(error, match=text):
        mistake()


def test_a_picture_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(DATA, match=r"a\.gif does not end like a picture; end it with one of \.png, \.pdf"):
        km.plot.save(Figure(), tmp_path / "a.gif")
    (tmp_path / "file").write_text("")
    with pytest.raises(km.errors.LogError, match=r"cannot be written: .*; pass another path"):
        km.plot.save(Figure(), tmp_path / "file" / "a.png")
