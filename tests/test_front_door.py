"""The front door: what `import koopmpc` gives, when it is imported, and that type checkers see the same."""

import ast
import importlib
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import koopmpc as km
from tests.sources import trees

ROOT = Path(km.__file__).parent
SERVING = ["koopmpc", *(f"koopmpc.{room.name}" for room in ROOT.iterdir() if (room / "__init__.py").exists())]
SERVING = [name for name in SERVING if hasattr(importlib.import_module(name), "__all__")] + ["koopmpc.models.moments"]


def test_the_daily_names_are_few() -> None:
    assert len(km.__all__) <= 90
    assert km.__all__ == sorted(set(km.__all__))


def test_importing_every_module_leaves_every_public_name_what_it_was() -> None:
    before = {
        (room, name): getattr(importlib.import_module(room), name)
        for room in SERVING
        for name in importlib.import_module(room).__all__
    }
    for module in pkgutil.walk_packages(km.__path__, "koopmpc."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    for (room, name), found in before.items():
        assert getattr(importlib.import_module(room), name) is found, f"{room}.{name}"


@pytest.mark.parametrize("room", SERVING)
def test_type_checkers_see_the_same_names(room: str) -> None:
    module = importlib.import_module(room)
    tree = ast.parse(Path(module.__file__ or "").read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    shown = {
        alias.asname: f"{node.module}.{alias.name}"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    public = {name for name in shown if name in module.__all__}
    assert public == set(module.__all__)
    assert set(shown) == set(dir(module)) & set(shown) | public
    for name, path in shown.items():
        home, _, attribute = path.rpartition(".")
        value = getattr(module, name)
        held = getattr(importlib.import_module(home), attribute, None)
        assert value is (importlib.import_module(path) if held is None else held), name


def test_nothing_is_imported_before_the_first_name_and_no_extra_by_a_fit(tmp_path: Path) -> None:
    code = (
        "import sys, koopmpc as km\n"
        "ground = {'koopmpc', 'koopmpc.base', 'koopmpc.base.lazy', 'koopmpc.base.interrupts'}\n"
        "early = {m for m in sys.modules if m.split('.')[0] == 'koopmpc'} - ground\n"
        "assert not early, early\n"
        "km.Cost\n"
        "heavy = {'matplotlib', 'rerun', 'cvxpy', 'sklearn', 'pandas', 'distributed', 'osqp', 'scipy.stats'}\n"
        "heavy = (heavy | {'scipy.optimize', 'scipy.signal'}) & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "data = km.Episodes([km.Episode(X=[[1], [2], [4], [3]], U=[[2], [3], [1]])], 1.0)\n"
        "data.save('a.npz'); km.edmd(km.load_episodes('a.npz'), km.State())\n"
        "foreign = {'h5py', 'asammdf', 'rosbags', 'mcap', 'fmpy', 'onnx', 'asyncua', 'pandas', 'imageio_ffmpeg'}\n"
        "assert not foreign & set(sys.modules), foreign & set(sys.modules)\n"
    )
    path = os.pathsep.join([str(Path(km.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path})


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match=r"module 'koopmpc' has no attribute 'edmdd'"):
        km.edmdd  # noqa: B018


@pytest.mark.parametrize(
    ("room", "name"),
    [
        ("supervise", "Adaptive"),
        ("supervise", "Guarded"),
        ("supervise", "Monitor"),
        ("data", "Files"),
        ("data", "Stream"),
        ("identify", "KoopmanRegressor"),
        ("identify", "Prior"),
        ("identify", "constrained_edmd"),
        ("identify", "eigenfunctions"),
        ("identify", "kernel_edmd"),
        ("identify", "sparse_edmd"),
        ("identify", "stable_edmd"),
        ("plants", "GymPlant"),
        ("recording", "view"),
    ],
)
def test_a_name_that_moved_one_level_down_says_where_it_is(room: str, name: str) -> None:
    with pytest.raises(AttributeError, match=rf"km\.{name} has moved: it is km\.{room}\.{name} now"):
        getattr(km, name)
    assert getattr(getattr(km, room), name).__name__ == name


@pytest.mark.parametrize("name", ["Adaptive", "Guarded", "Monitor", "Station"])
def test_a_name_that_moved_to_another_room_says_where_it_is(name: str) -> None:
    with pytest.raises(AttributeError, match=rf"km\.control\.{name} has moved: it is km\.supervise\.{name} now"):
        getattr(km.control, name)


def named(node: ast.stmt) -> list[str]:
    """Return the public class, or alias of a type, that a statement of a module defines."""
    if isinstance(node, ast.ClassDef):
        names = [node.name]
    else:
        targets = node.targets if isinstance(node, ast.Assign) else []
        names = [target.id for target in targets if isinstance(target, ast.Name) and not target.id.isupper()]
    return [name for name in names if name[0].isupper()]


def test_the_name_of_a_class_means_one_thing() -> None:
    homes: dict[str, list[str]] = {}
    for file, tree in trees().items():
        for node in tree.body:
            for name in named(node):
                homes.setdefault(name, []).append(str(file))
    twice = {name: files for name, files in homes.items() if len(files) > 1}
    assert not twice
