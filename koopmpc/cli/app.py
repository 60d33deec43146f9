"""The command line: each command parses, calls one function, and prints."""

import os
import re
import shlex
import shutil
import sys
import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.console import Console
from rich.text import Text

from koopmpc.cli.ending import ENDING
from koopmpc.errors import FitWarning, FullDiskError, KoopmpcError, LogError

if TYPE_CHECKING:
    from koopmpc.bench.problem import Problem

app = typer.Typer(name="koopmpc", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

_PROBLEM = "A name that `koopmpc list` shows, or the path of a problem file; `:case` after it keeps one case."
Live = Annotated[bool, typer.Option("--live", help="Stream each run to a Rerun viewer while it runs.")]
Logs = Annotated[Path, typer.Option("--logs", help="Where the folder of this call is made.")]
Watched = Annotated[
    bool, typer.Option("--monitor", help="Count the steps at which a learned model is beyond its data.")
]
Faults = Annotated[bool, typer.Option("--faults", help="Run each case again with sensors, actuator or solver broken.")]
LogFiles = Annotated[list[Path], typer.Argument(help="Logs that koopmpc wrote.")]
Controllers = Annotated[
    list[str] | None,
    typer.Option("--controller", "-c", help="One of the ten; may be repeated. Default: those that suit any plant."),
]


def _version(asked: bool) -> bool:
    if asked:
        from importlib.metadata import version

        _console().print(f"koopmpc {version('koopmpc')}", highlight=False)
        raise typer.Exit
    return asked


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """From a CasADi model or from data to a constrained controller with a lifted linear predictor."""


@app.command("list")
def list_() -> None:
    """Show all problems with their cases, and how the best learned controller did on those that come with koopmpc."""
    from koopmpc.bench.library import list_problems, load_problem, shipped
    from koopmpc.bench.measured import in_words

    out, own = _console(), shipped()
    for entry in list_problems():
        out.print(Text.assemble((entry.name, "bold"), "  ", entry.title))
        try:
            out.print(Text(f"  cases: {', '.join(load_problem(entry.path).cases)}"))
        except KoopmpcError as error:
            out.print(Text(f"  {error}", style="red"))
        if entry.path in own and (words := in_words(entry.name)):
            out.print(Text(f"  {words}", style="dim"))


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="Name of the problem; the file <name>.py is written here.")],
) -> None:
    """Write a commented problem file that runs, to be changed into your own."""
    from koopmpc.bench.library import new_problem

    out = _console()
    with _friendly():
        path = new_problem(name)
    out.print(Text(f"written: {path}; it holds a mass on a spring, put your plant in its place"), soft_wrap=True)
    out.print(Text(f"run it: {shlex.join([*_program(), 'run', str(path)])}"), soft_wrap=True)


@app.command()
def run(
    problem: Annotated[str, typer.Argument(help=_PROBLEM)],
    controller: Controllers = None,
    faults: Faults = False,
    monitor: Watched = False,
    live: Live = False,
    logs: Logs = Path("logs"),
) -> None:
    """Run controllers in closed loop on one problem; one log a run, and a table."""
    from koopmpc.bench.library import load_problem

    with _friendly():
        loaded = load_problem(problem)
        _sweep([loaded], controller, logs, loaded.name, faults=faults, monitor=monitor, live=live)


@app.command()
def bench(
    problems: Annotated[list[str] | None, typer.Argument(help=_PROBLEM + " Default: five, see --all.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Run all problems that come with koopmpc.")] = False,
    controller: Controllers = None,
    faults: Faults = False,
    monitor: Watched = False,
    live: Live = False,
    compiled: Annotated[
        bool, typer.Option("--compiled", help="Run in C the controllers that C is written for.")
    ] = False,
    logs: Logs = Path("logs"),
) -> None:
    """Compare the controllers that each problem names, else the eight that suit any, on several problems."""
    from koopmpc.bench.library import DEFAULT, load_problem, shipped

    with _friendly():
        named = shipped() if every else problems or DEFAULT
        chosen = [load_problem(p) for p in named]
        _sweep(chosen, controller, logs, "bench", faults=faults, monitor=monitor, live=live, compiled=compiled)


@app.command()
def fit(
    data: Annotated[list[Path], typer.Argument(help="A folder of .npz, .parquet, .csv and .rrd files, or files.")],
    states: Annotated[str | None, typer.Option("--states", help="Columns of a table that are states: a,b,…")] = None,
    inputs: Annotated[str | None, typer.Option("--inputs", help="Columns that are inputs: u,v,…")] = None,
    dt: Annotated[float | None, typer.Option("--dt", help="Sample time in s, where no column tells it.")] = None,
    resample: Annotated[
        float | None, typer.Option("--resample", help="Sample time in s to bring unequal steps to.")
    ] = None,
    horizon: Annotated[
        int | None, typer.Option("--horizon", help="Steps ahead that the model is chosen and judged by.")
    ] = None,
    linear: Annotated[bool, typer.Option("--linear", help="Try linear models only.")] = False,
    workers: Annotated[
        int | None, typer.Option("--workers", help="Local processes, or those of --scheduler local.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help='tcp://host:port of a Dask cluster, or "local".')
    ] = None,
    logs: Logs = Path("logs"),
    name: Annotated[str, typer.Option("--name", help="Ends the name of the folder.")] = "fit",
    goal: Annotated[Path | None, typer.Option("--goal", help="A goal file: design a controller that keeps it.")] = None,
    goal_template: Annotated[
        bool, typer.Option("--goal-template", help="Write goal.toml for these logs, to be changed, and stop.")
    ] = False,
) -> None:
    """Choose a model for logged data, fit it, and say whether to trust it; with a goal, design a controller."""
    from koopmpc.fitting.control import design_data, template_of
    from koopmpc.fitting.fit import fit_data

    out, err = _console(), Console(stderr=True)
    source: Any = data[0] if len(data) == 1 else data
    reading: dict[str, Any] = {
        "dt": dt,
        "states": None if states is None else _split(states),
        "inputs": None if inputs is None else _split(inputs),
        "resample": resample,
    }
    if goal_template:
        with _friendly():
            path = _new_file(Path("goal.toml"), template_of(source, **reading))
        out.print(Text(f"written: {path}; say in it what you want"), soft_wrap=True)
        again = [*_program(), "fit", *map(str, data), "--goal", str(path)]
        out.print(Text(f"then: {shlex.join(again)}"), soft_wrap=True)
        return
    if goal is not None:
        with _friendly(), _folder_of(logs, name) as folder, _bar("reading") as progress:
            designed = design_data(
                source,
                goal,
                folder,
                bilinear=not linear,
                workers=workers,
                scheduler=scheduler,
                say=lambda text: out.print(Text(text + "\n"), soft_wrap=True),
                progress=progress,
                **reading,
            )
        out.print(Text(f"controller: {designed.controller}, report: {designed.page}"), soft_wrap=True)
        checked = shlex.join([*_program(), "check", str(designed.controller)])
        out.print(Text(f"check it: {checked}\nuse it:\n{designed.usage}"), soft_wrap=True)
        return
    with _friendly(), _folder_of(logs, name) as folder, _bar("reading") as progress:
        done = fit_data(
            source,
            folder,
            horizon=horizon,
            bilinear=not linear,
            workers=workers,
            scheduler=scheduler,
            say=lambda text: out.print(Text(text + "\n"), soft_wrap=True),
            progress=progress,
            **reading,
        )
    for failure in done.failures:
        err.print(Text.assemble(("not made: ", "yellow"), failure), soft_wrap=True)
    out.print(Text(f"model, report and pictures: {folder}"), soft_wrap=True)
    if done.recording is not None:
        out.print(Text(f"look at it: {shlex.join([*_program(), 'view', str(done.recording)])}"), soft_wrap=True)
    out.print(Text(f"use it:\n{done.usage}"), soft_wrap=True)


@app.command()
def check(
    controller: Annotated[Path, typer.Argument(help="What `koopmpc fit --goal` or the save of a design wrote.")],
    runs: Annotated[int, typer.Option("--runs", help="Runs of each kind.")] = 12,
    logs: Logs = Path("logs"),
) -> None:
    """Test a designed controller from random starts, with noise, inputs 20 % off and faults; exit 1 where it fails."""
    from koopmpc.fitting.check import check_controller

    out = _console()
    with _friendly(), _folder_of(logs, "check") as folder, _bar("runs") as progress:
        done = check_controller(controller, folder, runs=runs, progress=progress)
    out.print(Text(f"{done}\n\nreport: {done.page}"), soft_wrap=True)
    if not done.kept:
        raise typer.Exit(1)


@app.command()
def export(
    controller: Annotated[Path, typer.Argument(help="What the save of a controller or of a design wrote.")],
    out: Annotated[Path, typer.Option("--out", help="The folder to write; it may hold an older export.")],
    precision: Annotated[str, typer.Option("--precision", help="double or float.")] = "double",
    problem: Annotated[
        str | None, typer.Option("--problem", help="The example controls the plant of this problem: name or name:case.")
    ] = None,
) -> None:
    """Write a controller as C99: sources, Makefile, CMakeLists.txt, an example, and a README with its sizes."""
    import numpy as np

    from koopmpc.bench.controllers import Prepared
    from koopmpc.bench.library import load_problem
    from koopmpc.codegen.export import export as write
    from koopmpc.synthesis.designed import load_controller

    example: dict[str, Any] = {}
    with _friendly():
        loaded = load_controller(controller)
        if problem is not None:
            given = load_problem(problem)
            name, case = next(iter(given.cases.items()))
            row = np.atleast_2d(np.asarray(case.reference))[0]
            example = {"plant": Prepared(given).truth_of(name), "x0": case.x0, "reference": row, "steps": case.steps}
        folder = write(loaded, out, precision=cast("Any", precision), **example)
    _console().print(Text(f"{folder}: make run builds it and prints its closed loop"), soft_wrap=True)


@app.command()
def inspect(logs: LogFiles) -> None:
    """Recompute the metrics of runs from their logs alone."""
    from koopmpc.loop.metrics import metrics
    from koopmpc.recording.format.reader import load_run

    out = _console()
    with _friendly():
        for log in logs:
            loaded = load_run(log)
            keys = ("problem", "case", "controller", "fault")
            title = " ".join(str(loaded.metadata[key]) for key in keys if key in loaded.metadata)
            out.print(Text.assemble((title or str(log), "bold"), f"\n{metrics(loaded)}"), soft_wrap=True)


@app.command()
def view(
    logs: LogFiles,
    compare: Annotated[bool, typer.Option("--compare", help="Draw all runs in one set of plots.")] = False,
    web: Annotated[bool, typer.Option("--web", help="Serve to a browser on 127.0.0.1 until Ctrl-C.")] = False,
    port: Annotated[int, typer.Option("--port", help="Port of the page that --web serves.")] = 9090,
) -> None:
    """Open logs in one Rerun viewer, one beside the other or, with --compare, in the same plots."""
    import tempfile

    from koopmpc.recording.viewer import need_display, served
    from koopmpc.recording.viewer import view as open_viewer
    from koopmpc.recording.views.comparison import record_comparison

    out = _console()
    with _friendly():
        shown = list(logs)
        if compare and not web:
            need_display(logs, options="--compare ")
        if compare:
            shown = [Path(tempfile.mkdtemp(prefix="koopmpc-")) / "comparison.rrd"]
            record_comparison(logs, shown[0])
        if web:
            with served(shown, port) as (address, data):
                out.print(Text(f"open {address}", style="bold"), soft_wrap=True)
                tunnel = f"ssh -L {port}:127.0.0.1:{port} -L {data}:127.0.0.1:{data} HOST"
                out.print(Text(f"from another machine first: {tunnel}\nCtrl-C ends it"), soft_wrap=True)
                with suppress(KeyboardInterrupt):
                    Event().wait()
            return
        open_viewer(shown)
        if len(shown) > 1:
            out.print(Text("the first panel button at the top right lists the logs; --compare draws all in one set"))


@app.command("export-video")
def export_video(
    log: Annotated[Path, typer.Argument(help="A log whose plant has a scene.")],
    video: Annotated[Path, typer.Argument(help="The .gif or .mp4 to write.")],
    fps: Annotated[int, typer.Option("--fps", help="Pictures a second.")] = 20,
    width: Annotated[int, typer.Option("--width", help="Width of the picture in pixels.")] = 640,
    speed: Annotated[float, typer.Option("--speed", help="Seconds of the run in a second of the video.")] = 1.0,
    until: Annotated[float | None, typer.Option("--until", help="Time in s at which the video ends.")] = None,
) -> None:
    """Write the animation of a log as a .gif or .mp4; no screen is needed."""
    from koopmpc.recording.video import export_video as export

    with _friendly():
        export(log, video, fps=fps, width=width, speed=speed, until=until)
    _console().print(Text(f"{video}, {video.stat().st_size / 1000:.0f} kB"), soft_wrap=True)


@app.command()
def explain(
    term: Annotated[
        list[str] | None, typer.Argument(help="A word of a table, a report or a picture; all if left out.")
    ] = None,
) -> None:
    """Explain a word that stands in a table, a report or a picture."""
    from koopmpc.cli.terms import TERMS
    from koopmpc.cli.terms import explain as explained

    out = _console()
    with _friendly():
        if term:
            out.print(Text(explained(" ".join(term))))
            return
    for name, text in TERMS.items():
        out.print(Text.assemble((name, "bold"), f": {text}"))


@app.command()
def reproduce(paper: Annotated[str, typer.Argument(help="The paper: snyder.")], logs: Logs = Path("logs")) -> None:
    """Reproduce a paper: its figures, its numbers, and a verdict on each of its claims."""
    from time import perf_counter

    from koopmpc.papers.registry import find_paper, verdict_table

    out, err = _console(), Console(stderr=True)
    with _friendly():
        found = find_paper(paper)
        folder = _new_folder(logs, paper)
        start = perf_counter()
        with err.status("") as status:
            outcome = found.reproduce(folder, False, status.update)
        out.print(verdict_table(found.title, outcome.claims))
        for path in (outcome.report, outcome.recording):
            out.print(Text(str(path)), soft_wrap=True)
        out.print(Text(f"done in {perf_counter() - start:.0f} s"))


def _sweep(
    problems: Sequence["Problem"],
    controllers: list[str] | None,
    logs: Path,
    what: str,
    *,
    faults: bool,
    monitor: bool,
    live: bool,
    compiled: bool = False,
) -> None:
    """Sweep with a progress bar, print the table, and exit with 1 where a run did not end as it should."""
    from koopmpc.bench.controllers import controller_names
    from koopmpc.bench.results import row_to_view
    from koopmpc.bench.sweep import sweep
    from koopmpc.bench.table import results_table

    controller_names(controllers)
    folder = _new_folder(logs, what)
    with _bar("") as progress:
        asked: dict[str, bool] = {"faults": faults, "monitor": monitor, "live": live, "compiled": compiled}
        rows = sweep(problems, controllers, folder=folder, progress=progress, **asked)
    out = _console()
    out.print(results_table(rows))
    out.print(Text(f"\nlogs and results.parquet: {folder}"), soft_wrap=True)
    shown = row_to_view(rows)
    if shown is not None:
        out.print(Text(f"look at a run: {shlex.join([*_program(), 'view', str(shown.log)])}"), soft_wrap=True)
    if any(row.failure is not None for row in rows):
        raise typer.Exit(1)


def _split(names: str) -> list[str]:
    """Return the names in ``"a, b"``; an empty text has none."""
    return [name.strip() for name in names.split(",") if name.strip()]


def _program() -> list[str]:
    """Return the command that calls this program from here: its name if that is on PATH, else its path."""
    beside = shutil.which("koopmpc", path=str(Path(sys.executable).parent))
    if beside is None:
        return [_near(sys.executable), "-m", "koopmpc"]
    known = shutil.which("koopmpc")
    return ["koopmpc" if known is not None and Path(known).samefile(beside) else _near(beside)]


def _near(path: str) -> str:
    """Return the path, relative to the current folder where that is shorter."""
    try:
        return min(os.path.relpath(path), path, key=len)
    except ValueError:  # on another drive
        return path


@contextmanager
def _bar(first: str) -> Generator[Callable[[str, int, int | None], None]]:
    """Show a progress bar on stderr and yield the function that moves it: (what, done, total)."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:40}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(first, total=None)
        yield lambda what, done, total: bar.update(task, description=what[:40], completed=done, total=total)


def _console() -> Console:
    """Return the console of stdout, 100 columns wide where it is no terminal."""
    out = Console()
    return out if out.is_terminal else Console(width=100)


def _new_folder(logs: Path, what: str) -> Path:
    """Make and return logs/<time>-<what>; a number follows where two calls share a second.

    Raises
    ------
    LogError
        `what` is a path, or no folder can be made there.
    """
    if not what or Path(what).name != what:
        raise LogError(f"--name is {what!r}, and ends the name of one folder; leave out what makes it a path")
    stem = f"{datetime.now():%Y-%m-%dT%H-%M-%S}-{what}"
    tries = 0
    while True:
        folder = logs / (stem if tries == 0 else f"{stem}-{tries}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            tries += 1
        except OSError as error:
            raise LogError(
                f"--logs {logs}: no folder can be made there, {error.strerror}; pass a folder that you may write to"
            ) from error
        else:
            ENDING.folder = folder
            return folder


@contextmanager
def _folder_of(logs: Path, what: str) -> Generator[Path]:
    """Yield a new folder; an error of koopmpc takes it away again where nothing was written."""
    folder = _new_folder(logs, what)
    try:
        yield folder
    except KoopmpcError:
        if not any(folder.iterdir()):
            folder.rmdir()
        raise


def _new_file(path: Path, text: str) -> Path:
    """Write a file that is not there yet, and return its path."""
    try:
        with path.open("x") as stream:
            stream.write(text)
    except FileExistsError as error:
        raise LogError(f"{path} is there already; move it away first, or pass it with --goal") from error
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror}") from error
    return path


_OPTION = re.compile(r"\b(dt|states|inputs|resample|horizon|workers|scheduler)=")
_SUBJECT = re.compile(r"(^|: )(dt|resample|horizon|workers|scheduler|runs)(?= is )")


def _as_options(message: str) -> str:
    """Return the message with the options of this program in place of Python's arguments."""
    told = _OPTION.sub(lambda found: f"--{found.group(1)} ", message).replace(" ;", ";").replace(" ,", ",")
    return _SUBJECT.sub(r"\1--\2", told)


@contextmanager
def _friendly() -> Generator[None]:
    """Show each warning and error of koopmpc as one message on stderr; an error exits with 2, a full disk with 1."""
    err, shown = Console(stderr=True), set[str]()

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if str(message) not in shown:
            err.print(Text.assemble((f"{category.__name__}: ", "yellow"), _as_options(str(message))), soft_wrap=True)
        shown.add(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", FitWarning)
        warnings.showwarning = show
        try:
            yield
        except KoopmpcError as error:
            err.print(Text.assemble((f"{type(error).__name__}: ", "red"), _as_options(str(error))), soft_wrap=True)
            raise typer.Exit(1 if isinstance(error, FullDiskError) else 2) from error
