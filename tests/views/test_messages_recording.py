"""Mistakes at recording say what was got and what to do; each case is called with an empty folder."""

from pathlib import Path
from typing import Any

import pytest

import koopmpc as km
from tests.views.models import turning
from tests.views.runs import about, make_run, steps_of
from tests.views.test_model import BILINEAR, DATA, DEFECTIVE

RUN = make_run()


def recorded(path: Path, **more: Any) -> None:
    with km.Recorder(path, **(about(RUN) | more)) as recorder:
        recorder(steps_of(RUN)[0])


def model(predictor: Any, path: Path, **more: Any) -> None:
    km.recording.record_model(predictor, DATA, path, **more)


def below_a_file(folder: Path) -> Path:
    (folder / "file").touch()
    return folder / "file" / "run.rrd"


def notes(folder: Path) -> Path:
    (folder / "notes.rrd").write_text("these are notes")
    return folder / "notes.rrd"


DATA_ERROR, LOG = km.errors.DataError, km.errors.LogError
MISTAKES = [
    (LOG, r"is a folder; pass the path of a file in it", lambda f: km.record(RUN, f)),
    (LOG, r"file/run\.rrd cannot be written: .+; pass another path", lambda f: km.record(RUN, below_a_file(f))),
    (LOG, r"is a folder; pass the path of a file in it", lambda f: recorded(f)),
    (DATA_ERROR, r"dt is 0 s; it must be above zero", lambda f: recorded(f / "run.rrd", dt=0.0)),
    (
        DATA_ERROR,
        r"a Recorder needs somewhere to write: pass a path, live=True, or both",
        lambda f: km.Recorder(**about(RUN)),
    ),
    (
        DATA_ERROR,
        r"the Recorder is not open; call it inside `with Recorder",
        lambda f: km.Recorder(f / "run.rrd", **about(RUN))(steps_of(RUN)[0]),
    ),
    (LOG, r"nowhere\.rrd does not exist; pass the \.rrd of a run", lambda f: km.recording.view([f / "nowhere.rrd"])),
    (LOG, r"notes\.rrd is not a log of koopmpc: it does not start as", lambda f: km.recording.view(notes(f))),
    (LOG, r"no log to open; pass the \.rrd of a run", lambda f: km.recording.view([])),
    (LOG, r"is a folder; pass the \.rrd of a run", lambda f: km.recording.view(f)),
    (LOG, r"notes\.rrd is not a log of koopmpc", lambda f: km.load_episodes(notes(f))),
    (DATA_ERROR, r"episode 0 has 30 steps, the horizon is 31", lambda f: model(turning(), f / "a.rrd", horizon=31)),
    (
        DATA_ERROR,
        r"there is no eigenfunction 2; the predictor has 0 … 1",
        lambda f: model(turning(), f / "a.rrd", which=[2]),
    ),
    (
        DATA_ERROR,
        r"a bilinear predictor has no eigenfunctions; leave `which` out",
        lambda f: model(BILINEAR, f / "a.rrd", which=[0]),
    ),
    (DATA_ERROR, r"A is defective", lambda f: model(DEFECTIVE, f / "a.rrd", which=[0])),
    (LOG, r"cannot be written", lambda f: model(turning(), below_a_file(f))),
]


@pytest.mark.parametrize(("error", "text", "mistake"), MISTAKES, ids=[text for _, text, _ in MISTAKES])
def test_a_mistake_says_what_was_got_and_what_to_do(error: Any, text: str, mistake: Any, tmp_path: Path) -> None:
    with pytest.raises(error, match=text):
        mistake(tmp_path)
