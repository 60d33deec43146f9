"""Files of edition 0.1 still read, each in a process that has imported no part of koopmpc before."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent / "fixtures" / "edition_0_1"
MODELS = ("linear_delay", "bilinear", "thin_plate_fourier", "traced", "families", "reduced")

OPENED = """
import json
from pathlib import Path
import koopmpc as km
folder = Path({folder!r})
expected = json.loads((folder / "expected.json").read_text())
def near(a, b):
    import numpy as np
    np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)
"""

MODEL = """
model, told = km.load_model(folder / "{name}.npz"), expected["{name}"]
assert type(model).__name__ == told["class"], type(model)
history = None
x0 = [0.4, -0.3]
if model.embedding is not None:
    X, U = expected["episodes"]["X"][0], expected["episodes"]["U"][0]
    history, x0 = km.Episode(X=X[:3], U=U[:2]), X[2]
near(model.rollout(x0, [[-1 + 2 * k / 9] for k in range(10)], history=history), told["rollout"])
assert model.report.samples > 0
"""

LOG = """
run, told = km.load_run(folder / "{name}.rrd"), expected["run {name}"]
assert run.X.tolist() == told["X"] and run.U.tolist() == told["U"]
assert [s.name for s in run.status] == told["status"] and [f.name for f in run.fallback] == told["fallback"]
assert run.metadata["controller"] == "{name}" and (run.plans is not None) == ("{name}" == "mpc")
near(km.metrics(run).cost, told["cost"])
"""

TRUST = """
from koopmpc.values import from_data
report = from_data(json.loads((folder / "trust_{name}.json").read_text()))
assert type(report).__module__.startswith("koopmpc.validate"), type(report)
assert report.score.rmse.tolist() == expected["trust {name}"]["rmse"]
assert str(report)
"""

EPISODES = """
for suffix in (".npz", ".parquet"):
    data, told = km.load_episodes(folder / ("episodes" + suffix)), expected["episodes"]
    assert [e.X.tolist() for e in data] == told["X"] and [e.U.tolist() for e in data] == told["U"]
    assert list(data.states) == told["states"] and data.dt == told["dt"]
    assert data == km.load_episodes(folder / "episodes.npz")
    wind = km.load_episodes(folder / ("wind" + suffix))
    assert len(km.load_episodes(folder / "mpc.rrd")[0]) == 30
    assert wind.disturbances == ("wind [N]",) and wind[0].W.tolist() == [[0.1]] * 3
"""

OPENINGS = {
    **{f"model {name}": MODEL.format(name=name) for name in MODELS},
    **{f"log {name}": LOG.format(name=name) for name in ("mpc", "lqr", "nonlinear")},
    **{f"trust {name}": TRUST.format(name=name) for name in ("bilinear", "thin_plate_fourier", "traced")},
    "episodes": EPISODES,
}


FORKED = """
import json, os, sys
import casadi, jaxtyping, numpy, pyarrow.parquet, rerun, rerun.chunk, scipy.linalg, scipy.sparse, scipy.spatial.transform  # slow, and know nothing of koopmpc
ended = {}
for name, script in json.load(sys.stdin).items():
    child = os.fork()
    if not child:
        assert not [part for part in sys.modules if part.startswith("koopmpc")]
        with open(name + ".txt", "w", buffering=1) as file:
            os.dup2(file.fileno(), 2)
        code = 1
        try:
            exec(script, {"__name__": "__main__"})
            code = 0
        except BaseException:
            sys.excepthook(*sys.exc_info())
        os._exit(code)
    ended[name] = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
print(json.dumps(ended))
"""


def fresh(script, **how):
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False, **how
    )


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """Return the exit code of a process for each of the openings, and what it printed of its errors."""
    folder = tmp_path_factory.mktemp("opened")
    scripts = {what: OPENED.format(folder=str(FOLDER)) + opening for what, opening in OPENINGS.items()}
    if not hasattr(os, "fork"):
        each = {what: fresh(script) for what, script in scripts.items()}
        return {what: (ran.returncode, ran.stderr) for what, ran in each.items()}
    ran = fresh(FORKED, input=json.dumps(scripts), cwd=folder)
    assert ran.returncode == 0, ran.stderr
    return {what: (code, (folder / f"{what}.txt").read_text()) for what, code in json.loads(ran.stdout).items()}


@pytest.mark.parametrize("what", OPENINGS)
def test_a_file_of_edition_0_1_reads_in_a_fresh_process(opened, what):
    code, said = opened[what]
    assert code == 0, said


def test_every_class_that_a_room_serves_is_found_in_a_fresh_process():
    ran = fresh(
        "import koopmpc\n"
        "from koopmpc.values import Value, class_of\n"
        "assert not Value._kinds, 'nothing is imported yet'\n"
        "assert class_of('TrustReport').__module__.startswith('koopmpc.validate')\n"
        "assert class_of('Selection').__module__.startswith('koopmpc.synthesis')\n"
        "assert class_of('Popen') is None and class_of('trust') is None\n"
        "assert 'rerun' not in __import__('sys').modules\n"
    )
    assert ran.returncode == 0, ran.stderr


def test_the_fixtures_are_small_and_listed():
    most = {".rrd": 900_000}  # a log holds the layout of its plots too
    assert all(file.stat().st_size < most.get(file.suffix, 20_000) for file in FOLDER.iterdir())
    assert {*json.loads((FOLDER / "expected.json").read_text())} >= {*MODELS, "episodes"}


def test_what_a_killed_writer_left_goes_with_the_next_save_and_what_one_holds_stays(tmp_path):
    fcntl = pytest.importorskip("fcntl")
    import koopmpc as km

    old, held, fresh, other = (
        tmp_path / f".model.npz.{name}.part" for name in ("0123abcd", "1123abcd", "2123abcd", "notahexa")
    )
    for part in (old, held, fresh, other):
        part.write_bytes(b"half")
    for part in (old, held, other):
        os.utime(part, (0, 0))
    with held.open("rb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        km.LinearPredictor([[0.5]], [[1.0]], [[1.0]], km.State(), 0.1, ["x"], ["u"]).save(tmp_path / "model.npz")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([held.name, fresh.name, other.name, "model.npz"])
