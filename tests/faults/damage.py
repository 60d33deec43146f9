"""Files of every kind that the library writes, ways to damage them, and a disk that is full."""

import ctypes
import random
import resource
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import koopmpc as km
from koopmpc.apps.bench.store import RunRow, open_sweep, read_store, record_of, write_results
from koopmpc.base.page import Curves, Page
from koopmpc.plants import routines
from koopmpc.synthesis.designed import SavedDesign, read_controller
from koopmpc.views.recording.plots import record_curves
from tests.synthesis.test_design import usual
from tests.views.runs import make_run

TEMPLATE = Path(km.__file__).parent / "apps" / "bench" / "template.txt"


def episodes(seed: int = 0, steps: int = 30) -> km.Episodes:
    """Return a few random walks; a state has the name of time, so that a table of them might pass for a plain one."""
    rng = np.random.default_rng(seed)
    made = [
        km.Episode(X=0.1 * rng.standard_normal((steps + i, 3)).cumsum(0), U=rng.standard_normal((steps + i - 1, 2)))
        for i in range(4)
    ]
    return km.Episodes(made, 0.1, ["t [s]", "x [m]", "v [m/s]"], ["u [N]", "f"])


def model(seed: int = 0) -> km.LinearPredictor:
    """Return a model of these walks whose file is some kilobytes long."""
    data, rng = episodes(seed), np.random.default_rng(seed)
    return km.edmd(data, km.State() + km.Constant() + km.Gaussian(rng.standard_normal((12, 3)), 1.0))


def controller() -> km.KoopmanMPC:
    """Return a controller on this model, with limits and an estimator."""
    cost, limits = km.Cost(Q=[1.0, 1.0, 0.1], R=0.1, R_delta=0.2), km.Limits(u_min=-1, u_max=1, x_max=[2.0, 2.0, 3.0])
    return km.KoopmanMPC(model(), cost, limits, 6, estimator=km.LiftedDisturbance(), latency=1, moves=3)


def saved(path: Path) -> Any:
    """Return what is in the file of a controller or a design, of which a controller was made."""
    km.load_controller(path)
    return read_controller(path)


@cache
def rows() -> list[RunRow]:
    """Return the rows of a sweep."""
    figures = km.metrics(make_run(T=30))
    return [RunRow("plant", f"case {i}", "lqr", figures, x0=(0.1 * i, -1.0)) for i in range(20)]


def texts(rows: Iterable[RunRow]) -> list[str]:
    """Return all that the rows hold."""
    return [repr(record_of(row)) for row in rows]


def store(path: Path) -> None:
    """Write the store of these runs, as they end."""
    with open_sweep(path.parent, {"problems": ["a"], "controllers": ["lqr"], "seed": 1}) as sweep:
        for row in rows():
            sweep.add(row)


def results(path: Path) -> None:
    write_results([RunRow("plant", f"case {i}", "lqr", failure="none") for i in range(40)], path)


def report(path: Path) -> None:
    page = Page(path.parent)
    page.text("# Report", "words " * 2000)
    page.write(path.name)


def figure(path: Path) -> None:
    made, axes = plt.subplots()
    axes.plot([0, 1], [0, 1])
    try:
        km.plot.save(made, path)
    finally:
        plt.close(made)


def recorded(path: Path) -> None:
    """Write a log while its loop runs."""
    from tests.views.runs import about, steps_of

    run = make_run(T=60)
    with km.Recorder(path, **about(run)) as recorder:
        for step in steps_of(run):
            recorder(step)


def curves(path: Path) -> None:
    X = np.random.default_rng(0).standard_normal((500, 2))
    record_curves([Curves("tab", 0.1, ("a", "b"), {"one": X})], path, application="test", page="words")


WRITERS: dict[str, Callable[[Path], Any]] = {
    "model.npz": lambda path: model().save(path),
    "controller.npz": lambda path: controller().save(path),
    "design.npz": lambda path: usual().save(path),
    "episodes.npz": lambda path: episodes().save(path),
    "episodes.csv": lambda path: episodes().save(path),
    "episodes.parquet": lambda path: episodes().save(path),
    "run.rrd": lambda path: km.record(make_run(T=60), path),
    "model.rrd": lambda path: km.recording.record_model(model(), episodes(1), path, horizon=5),
    "curves.rrd": curves,
    "results.parquet": results,
    "report.md": report,
    "figure.png": figure,
    "figure.pdf": figure,
    "figure.svg": figure,
}
"""What writes each kind of file."""

READERS: dict[str, tuple[Callable[[], Any], Callable[[Path], Any]]] = {
    "model.npz": (model, km.load_model),
    "controller.npz": (lambda: controller().as_data(), saved),
    "design.npz": (lambda: SavedDesign(usual().controller.as_data(), usual().evidence), saved),
    "episodes.npz": (episodes, km.load_episodes),
    "episodes.parquet": (episodes, km.load_episodes),
    "run.rrd": (lambda: make_run(T=60), km.load_run),
    "sweep.sqlite": (lambda: texts(rows()), lambda path: texts(read_store(path).rows.values())),
}
"""Each kind of file that is read: what was written, and what reads it."""


def column_file(path: Path, mark: str) -> None:
    t = 0.1 * np.arange(200)
    np.savetxt(path, np.column_stack([t, np.sin(t), np.cos(3 * t)]), "%.5f", mark)


def columns_of(path: Path) -> list[bytes]:
    data = km.load_episodes(path, states=["x"], inputs=["u"], columns=["t", "x", "u"])
    return [values.tobytes() for each in data for values in (each.X, each.U)]


def network(path: Path) -> None:
    from onnx import TensorProto, helper, numpy_helper

    weights = np.random.default_rng(0).standard_normal((2, 4)).astype(np.float32)
    x, z = (
        helper.make_tensor_value_info(*of)
        for of in (("x", TensorProto.FLOAT, [1, 2]), ("z", TensorProto.FLOAT, [1, 4]))
    )
    nodes = [helper.make_node("MatMul", ["x", "w"], ["a"]), helper.make_node("Tanh", ["a"], ["z"])]
    graph = helper.make_graph(nodes, "g", [x], [z], [numpy_helper.from_array(weights, "w")])
    path.write_bytes(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)]).SerializeToString())


def unit(path: Path) -> None:
    from tests.plants import units

    builds = {"pendulum2": units.build_pendulum, "pendulum3": lambda folder: units.build_pendulum3(folder.parent)}
    builds |= {f"tank{fmi}": lambda to, fmi=fmi: units.build_tank(to.parent, fmi) for fmi in (2, 3)}
    (path.parent / "built").mkdir(exist_ok=True)
    path.write_bytes(Path(builds[path.stem](path.parent / "built" / "made.fmu")).read_bytes())


def unit_of(path: Path) -> Any:
    if path.stem.startswith("tank"):
        made = km.plants.fmu(path, dt=0.5, interface="co-simulation")
        return made.states, made.inputs, made.reset(None).tolist()
    made = km.plants.fmu(path, dt=0.05, interface="model exchange")
    return made.states, made.inputs, made([0.1, 0.2], [0.3]).tolist()


@cache
def certificate() -> Any:
    from tests.guarantees.plants import INVARIANT, Invariant, published_data

    data = published_data(Invariant(), [-1, -1], [1, 1], 100, 0.0)[1]
    return km.certify(
        km.bilinear_edmd(data, INVARIANT),
        data,
        options=km.guarantees.CertifyOptions(error=(3e-4, 3e-4), region=(-12, 12)),
    )


def pid() -> Any:
    return km.control.PID(kp=[0.35, 1], ki=[0.004, 0.1], kd=[0.1, 0], dt=4.0, outputs=[1, 0], bias=3.0)


def spare() -> Any:
    return km.LQR(model(), km.Cost(Q=[1.0, 1.0, 0.1], R=0.1, R_delta=0.2), km.Limits(-1, 1))


def parts_of_model_log(path: Path) -> Any:
    from koopmpc.views.recording.model import load_model_log

    log = load_model_log(path)
    return dict(log.facts), log.states, log.dt, [error.tobytes() for error in log.errors]


_CODE = "double koopmpc_twice(double x) { return 2 * x; }\n"


def code_in(cache: Path) -> Any:
    cache.mkdir(exist_ok=True)
    return routines.load_library(_CODE, routines.find_compiler(), cache)


def code(path: Path) -> None:
    code_in(path.parent / "cache")
    path.write_bytes(next((path.parent / "cache").glob("*.so")).read_bytes())


def code_of(path: Path) -> float:
    """Return what a routine says whose file in the cache is this one: it is built again if it is damaged."""
    cache = path.parent / "cache"
    code_in(cache)
    (path.parent / "new").write_bytes(path.read_bytes())
    (path.parent / "new").replace(next(cache.glob("*.so")))  # a new file: what is loaded stays as it is
    twice = code_in(cache).koopmpc_twice
    twice.restype, twice.argtypes = ctypes.c_double, [ctypes.c_double]
    return twice(2.0)


FORMATS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "pid.npz": (lambda path: pid().save(path), saved),
    "lqr.npz": (lambda path: spare().save(path), saved),
    "guarded.npz": (lambda path: km.supervise.Guarded(controller(), spare()).save(path), saved),
    "station.npz": (
        lambda path: km.supervise.Station(controller(), spare(), limits=km.Limits(-1, 1)).save(path),
        saved,
    ),
    "certified.npz": (lambda path: certificate().controller().save(path), saved),
    "certificate.npz": (lambda path: certificate().save(path), km.guarantees.load_certificate),
    "model.rrd": (WRITERS["model.rrd"], parts_of_model_log),
    "code.so": (code, code_of),
    # What others write has no checksums: values may be others in silence.
    "columns.dat": (lambda path: column_file(path, " "), columns_of),
    "columns.txt": (lambda path: column_file(path, "\t"), columns_of),
    "net.onnx": (network, lambda path: km.lifting.ONNX(path).bind(["a", "b"])([0.1, 0.2]).tolist()),
    "problem.py": (lambda path: path.write_bytes(TEMPLATE.read_bytes()), lambda path: repr(km.load_problem(path).cost)),
    "pendulum2.fmu": (unit, unit_of),
    "pendulum3.fmu": (unit, unit_of),
    "tank2.fmu": (unit, unit_of),
    "tank3.fmu": (unit, unit_of),
}
"""More kinds of files that are read: what writes one, and what reads it; from columns.dat on without checksums."""

PLAIN = list(FORMATS)[list(FORMATS).index("columns.dat") :]


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes cut, or with a bit, a block or some bytes changed, doubled or zeroed."""
    size = min(rng.choice([8, 64, 512, 4096]), len(data))
    at = rng.randrange(len(data) - size + 1)
    block, bit = data[at : at + size], 1 << rng.randrange(8)
    put = {
        "bit": bytes([block[0] ^ bit]) + block[1:],
        "doubled": 2 * block,
        "zeroed": bytes(size),
        "other": rng.randbytes(rng.randrange(1, 64)),
        "cut": None,
    }[rng.choice(["bit", "doubled", "zeroed", "other", "cut"])]
    return data[:at] if put is None else data[:at] + put + data[at + size :]


@contextmanager
def room_for(size: int) -> Generator[None]:
    """Let no file grow beyond `size` bytes: the system refuses the next byte, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
