"""Mistakes at figures and recordings say what was got and what to do; each case is called with an empty folder."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import koopmpc as km
from tests.views.models import BILINEAR, DEFECTIVE, diagonal, episodes, three_states, turning
from tests.views.runs import about, make_run, steps_of

DATA, SHAPE, LOG = km.errors.DataError, km.errors.ShapeError, km.errors.LogError
MODEL, EPISODES, CUBE, RUN = turning(), episodes(12), three_states(), make_run()
SQUARE = [(-1, 1), (-2, 2)]
SCORE, RESIDUALS = km.score(MODEL, EPISODES, 3), km.validate.residual_dmd(MODEL, EPISODES)
rollout = partial(km.plot.rollout, MODEL, EPISODES[0])


def planes(which: Any, axes: Any, over: Any, at: Any = None, of: Any = CUBE) -> Any:
    return km.plot.eigenfunction_maps(of, which, axes, over, at=at, points=5)


def recorded(path: Path, **more: Any) -> None:
    with km.Recorder(path, **(about(RUN) | more)) as recorder:
        recorder(steps_of(RUN)[0])


def model(folder: Path, predictor: Any = MODEL, **more: Any) -> None:
    km.recording.record_model(predictor, EPISODES, folder / "a.rrd", **more)


def below_a_file(folder: Path) -> Path:
    (folder / "file").touch()
    return folder / "file" / "run.rrd"


def notes(folder: Path) -> Path:
    (folder / "notes.rrd").write_text("these are notes")
    return folder / "notes.rrd"


def relifted() -> Any:
    return rollout(5, km.validate.conformal(MODEL, EPISODES, 5, relift=True))


MISTAKES = [
    (DATA, "the episode has 25 steps from step 5 on, the horizon is 26", lambda _: rollout(26, start=5)),
    (SHAPE, "the episode has 3 states and 0 inputs, the predictor 2 and 1",
        lambda _: km.plot.rollout(MODEL, km.Episode(X=np.zeros((4, 3))))),
    (SHAPE, "bands has 4 rows of 2, expected 5 of 2", lambda _: rollout(5, np.ones((4, 2)))),
    (DATA, "bands holds -1; half-widths are 0 or above", lambda _: rollout(5, -np.ones((5, 2)))),
    (DATA, "the band is for predictions with relift=True; pass relift=True", lambda _: relifted()),
    (DATA, "asked for 0 states; choose 1 to 12 with states=…", lambda _: rollout(5, states=[])),
    (DATA, "there is no score; pass one", lambda _: km.plot.error({})),
    (SHAPE, r"one score is of \(angle .*\), another of \(a \[m\], .*\); compare models of the same states", lambda _: km.plot.error(
        {"one": SCORE, "other": replace(SCORE, states=CUBE.states)})),
    (DATA, "asked for state 'x'; the states are angle", lambda _: km.plot.error(SCORE, states="x")),
    (DATA, r"asked for state 'd'; the states are a \[m\], b", lambda _: planes(0, ("a", "d"), SQUARE)),
    (DATA, r"both axes are 'b \[m/s\]'; name two different", lambda _: planes(0, ("b", 1), SQUARE)),
    (DATA, r"the range of a \[m\] is 1 to -1; pass \(low, high\)", lambda _: planes(0, (0, 1), [(1, -1), (0, 1)])),
    (SHAPE, r"at has shape \(2,\), expected \(3,\)", lambda _: planes(0, (0, 1), SQUARE, [0, 0])),
    (DATA, "there is no eigenfunction 3; the predictor has 0 … 2", lambda _: planes(3, (0, 1), SQUARE)),
    (DATA, "which is empty; pass the index of an eigenfunction", lambda _: planes([], (0, 1), SQUARE)),
    (DATA, "eigenfunction 2 is 0 on the whole plane; fix the other states",
        lambda _: planes([0, 2], (0, 1), SQUARE)),
    (SHAPE, r"residuals has shape \(3,\), expected \(2,\)", lambda _: km.plot.spectrum(MODEL, [0, 0, 0])),
    (DATA, "residuals holds -1; residuals are norms, 0 or above", lambda _: km.plot.spectrum(MODEL, [0, -1])),
    (SHAPE, "there are 2 residuals and 4 eigenvalues; pass the residuals of this",
        lambda _: km.plot.spectrum(diagonal(), RESIDUALS)),
    (DATA, "the residuals are those of another predictor", lambda _: km.plot.spectrum(turning(0.5), RESIDUALS)),
    (DATA, r"a\.gif does not end like a picture; end it with one of \.png, \.pdf",
        lambda f: km.plot.save(Figure(), f / "a.gif")),
    (LOG, "cannot be written: .*; pass another path", lambda f: km.plot.save(Figure(), below_a_file(f) / "a.png")),
    (LOG, "is a folder; pass the path of a file in it", lambda f: km.record(RUN, f)),
    (LOG, r"file/run\.rrd cannot be written: .+; pass another path", lambda f: km.record(RUN, below_a_file(f))),
    (LOG, r"a\.csv would be a Rerun log under another name; name it a\.rrd", lambda f: km.record(RUN, f / "a.csv")),
    (LOG, "is a folder; pass the path of a file in it", recorded),
    (LOG, r"name; name it a\.rrd", lambda f: recorded(f / "a.csv")),
    (DATA, "dt is 0 s; it must be above zero", lambda f: recorded(f / "run.rrd", dt=0.0)),
    (DATA, "a Recorder needs somewhere to write: pass a path, live=True, or both", lambda _: km.Recorder(**about(RUN))),
    (DATA, "the Recorder is not open; call it inside `with Recorder",
        lambda f: km.Recorder(f / "run.rrd", **about(RUN))(steps_of(RUN)[0])),
    (LOG, r"nowhere\.rrd does not exist; pass the \.rrd of a run",
        lambda f: km.recording.view([f / "nowhere.rrd"])),
    (LOG, r"notes\.rrd is not a log of koopmpc: it does not start as",
        lambda f: km.recording.view(notes(f))),
    (LOG, r"no log to open; pass the \.rrd of a run", lambda _: km.recording.view([])),
    (LOG, r"is a folder; pass the \.rrd of a run", km.recording.view),
    (LOG, r"notes\.rrd is not a log of koopmpc", lambda f: km.load_episodes(notes(f))),
    (DATA, "episode 0 has 30 steps, the horizon is 31", lambda f: model(f, horizon=31)),
    (DATA, "there is no eigenfunction 2; the predictor has 0 … 1", lambda f: model(f, which=[2])),
    (DATA, "a bilinear predictor has no eigenfunctions; leave `which` out", lambda f: model(f, BILINEAR, which=[0])),
    (DATA, "A is defective", lambda f: model(f, DEFECTIVE, which=[0])),
    (LOG, "cannot be written", lambda f: model(below_a_file(f))),
]  # fmt: skip


@pytest.mark.parametrize(("error", "text", "mistake"), MISTAKES, ids=[text for _, text, _ in MISTAKES])
def test_a_mistake_says_what_was_got_and_what_to_do(error: Any, text: str, mistake: Any, tmp_path: Path) -> None:
    with pytest.raises(error, match=text):
        mistake(tmp_path)
    assert not [path for path in tmp_path.rglob("*") if path.name not in ("file", "notes.rrd")]
