"""What the program says of itself: the four ways in, and what is installed for what."""

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import NamedTuple

from rich.table import Table
from rich.text import Text

from koopmpc.apps.cli.console import console, format_command
from koopmpc.base.errors import install

WAYS = (
    ("a problem that comes with koopmpc", ("run", "cart_pole"), "koopmpc list names them all"),
    ("equations of your own", ("new", "my_plant"), "writes my_plant.py, which runs; put your plant in its place"),
    ("logs of a plant", ("fit", "LOGS"), "a .csv or a folder; --goal-template begins a controller's design"),
    ("a controller on hardware", ("export", "CONTROLLER.npz"), "C99 without a heap; in Python: km.realtime"),
)
"""What somebody has, the words of the next command, and what it does."""

CORE = ("numpy", "scipy", "casadi", "osqp", "daqp", "cvxpy", "rerun-sdk", "pyarrow", "matplotlib")


class Extra(NamedTuple):
    """What an optional package is for."""

    modules: tuple[str, ...]
    extra: str
    purpose: str


EXTRAS = (
    Extra(("distributed",), "dask", "sweeps and fits on a Dask cluster"),
    Extra(("gymnasium",), "gym", "plants that are Gymnasium environments"),
    Extra(("imageio_ffmpeg",), "video", "export-video to .mp4"),
    Extra(("sklearn",), "sklearn", "KoopmanRegressor in a pipeline"),
    Extra(("fmpy",), "fmu", "plants that are FMUs"),
    Extra(("pandas",), "pandas", "data frames in and out"),
    Extra(("h5py",), "hdf5", "logs in .h5 and MATLAB's v7.3 files"),
    Extra(("asammdf",), "mdf", "logs in .mf4"),
    Extra(("rosbags", "mcap"), "ros", "logs in .mcap and .db3"),
    Extra(("piqp",), "piqp", "long plans solved over their stages"),
    Extra(("asyncua",), "opcua", "plants behind an OPC UA server"),
)


def show_ways() -> None:
    """Show the four ways in, each with the command that comes next; `koopmpc` alone does so too."""
    out = console()
    out.print(Text("koopmpc: from equations or logs to a controller that is tried in closed loop\n"))
    for have, words, does in WAYS:
        out.print(Text.assemble(f"{have}: ", (does, "dim")))
        out.print(Text(f"    {format_command(*words)}", "bold"), soft_wrap=True)  # a line that can be copied
    for word, says in (("doctor", "what is installed, and what is missing for what"), ("--help", "all commands")):
        out.print(Text(f"{says}:"))
        out.print(Text(f"    {format_command(word)}", "bold"), soft_wrap=True)


def doctor() -> None:
    """Say what is installed, and what is missing for what: packages, extras, compiler, viewer, BLAS threads."""
    from koopmpc.plants.routines import find_compiler, try_compiler
    from koopmpc.views.recording.viewer import program

    rows: list[tuple[bool, str, str]] = [
        (True, f"koopmpc {_version_of('koopmpc')}", f"Python {platform.python_version()}, {platform.platform()}"),
        (True, "packages", ", ".join(f"{name} {_version_of(name)}" for name in CORE)),
    ]
    compiler = find_compiler()
    lacks = "none of $CC, cc, gcc, clang is there" if compiler is None else try_compiler(compiler)
    well = f"{' '.join(compiler or ())}: km.compiled, --compiled, and plants at full speed"
    rows.append(
        (not lacks, "C compiler", f"{lacks}; until one works: no km.compiled, and slower plants" if lacks else well)
    )
    there = program().exists()
    shown = sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    what = "opens logs" if there and shown else "no display: logs are written all the same" if there else "not found"
    rows.append((there and shown, "viewer", f"Rerun {_version_of('rerun-sdk')}, {what}"))
    threads = os.environ.get("OPENBLAS_NUM_THREADS")
    said = f"OPENBLAS_NUM_THREADS={threads}" if threads else "not pinned; OPENBLAS_NUM_THREADS=1 makes timings steady"
    rows.append((threads == "1", "BLAS threads", f"{said}; {os.cpu_count()} processors"))
    for extra in EXTRAS:
        found = all(find_spec(module) is not None for module in extra.modules)
        rows.append((found, extra.extra, extra.purpose + f": {install(extra.extra)}" * (not found)))
    table = Table.grid(padding=(0, 1))
    for good, name, says in rows:
        mark = Text("✓", "green") if good else Text("–", "yellow")
        table.add_row(mark, Text(name, "bold"), Text(says))
    console().print(table)


def _version_of(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "(not installed as a package)"
