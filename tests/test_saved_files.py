"""Files of the commit before the third house still read, each in a process that has imported no part of koopmpc before."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent / "fixtures" / "before_house"
MODELS = ("linear", "delay", "families", "bilinear", "subspace", "neural", "reduced")
CONTROLLERS = ("mpc", "kalman", "rti", "lqr", "known", "guarded")

OPENED = """
import json, lzma
from pathlib import Path
import koopmpc as km
folder = Path({folder!r})
expected = json.loads((folder / "expected.json").read_text())
def near(a, b, tolerance=1e-10):
    import numpy as np
    np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)
def moves(controller):
    plant, x, made = km.discretize(km.load_problem("pendulum").dynamics, 0.05), [0.4, -0.3], []
    for _ in range(6):
        made.append(controller(x, [0.0, 0.0]).u.tolist())
        x = plant(x, made[-1])
    return made
"""

MODEL = """
model, saved = km.load_model(folder / "{name}.npz"), expected["{name}"]
assert type(model).__name__ == saved["class"], type(model)
X, U, past = expected["X"], expected["U"], saved["past"]
rows = [row[:1] if model.embedding is not None else row for row in X]
history = None if model.embedding is None else km.Episode(X=rows[: past + 1], U=U[:past])
near(model.rollout(rows[past], [[-1 + 2 * k / 5] for k in range(6)], history=history), saved["rollout"])
assert model.report.samples > 0
"""

CONTROLLER = """
near(moves(km.load_controller(folder / "controller_{name}.npz")), expected["controller {name}"], 1e-6)
"""

DESIGN = """
controller, saved = km.load_controller(folder / "design.npz"), expected["design"]
near(moves(controller), saved["moves"], 1e-6)
assert controller.horizon == saved["horizon"]
"""

LOG = """
Path("run.rrd").write_bytes(lzma.decompress((folder / "run.rrd.xz").read_bytes()))
run, saved = km.load_run("run.rrd"), expected["run"]
assert run.X.tolist() == saved["X"] and run.U.tolist() == saved["U"]
assert [s.name for s in run.status] == saved["status"]
near(km.metrics(run).cost, saved["cost"])
assert len(km.load_episodes("run.rrd")[0]) == 8
"""

EPISODES = """
data = km.load_episodes(folder / "episodes.npz")
assert data[0].X.tolist() == expected["X"] and data[0].U.tolist() == expected["U"]
assert list(data.states) == expected["states"] and data.dt == expected["dt"]
for suffix in (".npz", ".parquet"):
    wind = km.load_episodes(folder / ("wind" + suffix))
    assert wind.disturbances == ("wind [N]",) and wind[0].W.tolist() == [[0.1]] * 3
"""

OPENINGS = {
    **{f"model {name}": MODEL.format(name=name) for name in MODELS},
    **{f"controller {name}": CONTROLLER.format(name=name) for name in CONTROLLERS},
    "design": DESIGN,
    "log": LOG,
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
def test_a_file_from_before_the_third_house_reads_in_a_fresh_process(opened, what):
    code, said = opened[what]
    assert code == 0, said


def test_the_fixtures_are_small_and_listed():
    assert sum(file.stat().st_size for file in FOLDER.iterdir()) < 200_000
    listed = {*MODELS, *(f"controller {name}" for name in CONTROLLERS), "design", "run"}
    assert {*json.loads((FOLDER / "expected.json").read_text())} >= listed
