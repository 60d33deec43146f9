"""The command line: each command parses, calls one function, and prints."""

import shlex
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Annotated, Any, cast

import typer
from rich.console import Console
from rich.text import Text

from koopmpc.cli import sweeps
from koopmpc.cli.console import bar, console, folder_of, friendly, new_file, new_folder, program, say_page, split
from koopmpc.cli.sweeps import Logs
from koopmpc.errors import DataError, KoopmpcError, ProblemError

app = typer.Typer(name="koopmpc", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

LogFiles = Annotated[list[Path], typer.Argument(help="Logs that koopmpc wrote.")]


def _version(asked: bool) -> bool:
    if asked:
        from importlib.metadata import version

        console().print(f"koopmpc {version('koopmpc')}", highlight=False)
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

    out, own = console(), shipped()
    for entry in list_problems():
        out.print(Text.assemble((entry.name, "bold"), "  ", entry.title))
        try:
            out.print(Text(f"  cases: {', '.join(load_problem(entry.path).cases)}"))
        except KoopmpcError as error:
            out.print(Text(f"  {error}", style="red"))
        if entry.path in own and (words := in_words(entry.name)):
            out.print(Text(f"  {words}", style="dim"))


@app.command()
def new(name: Annotated[str, typer.Argument(help="Name of the problem; the file <name>.py is written here.")]) -> None:
    """Write a commented problem file that runs, to be changed into your own."""
    from koopmpc.bench.library import new_problem

    out = console()
    with friendly():
        path = new_problem(name)
    out.print(Text(f"written: {path}; it holds a mass on a spring, put your plant in its place"), soft_wrap=True)
    out.print(Text(f"run it: {shlex.join([*program(), 'run', str(path)])}"), soft_wrap=True)


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

    out, err = console(), Console(stderr=True)
    source: Any = data[0] if len(data) == 1 else data
    reading: dict[str, Any] = {
        "dt": dt,
        "states": None if states is None else split(states),
        "inputs": None if inputs is None else split(inputs),
        "resample": resample,
    }
    if goal_template:
        with friendly():
            path = new_file(Path("goal.toml"), template_of(source, **reading))
        out.print(Text(f"written: {path}; say in it what you want"), soft_wrap=True)
        again = [*program(), "fit", *map(str, data), "--goal", str(path)]
        out.print(Text(f"then: {shlex.join(again)}"), soft_wrap=True)
        return

    def say(text: str) -> None:
        out.print(Text(text + "\n"), soft_wrap=True)

    how: dict[str, Any] = {"bilinear": not linear, "workers": workers, "scheduler": scheduler, "say": say, **reading}
    if goal is not None:
        with friendly():
            if horizon is not None:
                raise DataError(f"--horizon {horizon} is of no use with --goal; write horizon = {horizon} into {goal}")
        with friendly(), folder_of(logs, name) as folder, bar("reading") as progress:
            designed = design_data(source, goal, folder, progress=progress, **how)
        out.print(Text(f"controller: {designed.controller}, report: {designed.page}"), soft_wrap=True)
        checked = shlex.join([*program(), "check", str(designed.controller)])
        out.print(Text(f"check it: {checked}\nuse it:\n{designed.usage}"), soft_wrap=True)
        return
    with friendly(), folder_of(logs, name) as folder, bar("reading") as progress:
        done = fit_data(source, folder, horizon=horizon, progress=progress, **how)
    for failure in done.failures:
        err.print(Text.assemble(("not made: ", "yellow"), failure), soft_wrap=True)
    out.print(Text(f"model, report and pictures: {folder}"), soft_wrap=True)
    if done.recording is not None:
        out.print(Text(f"look at it: {shlex.join([*program(), 'view', str(done.recording)])}"), soft_wrap=True)
    out.print(Text(f"use it:\n{done.usage}"), soft_wrap=True)


@app.command()
def check(
    controller: Annotated[Path, typer.Argument(help="What `koopmpc fit --goal` or the save of a design wrote.")],
    runs: Annotated[int, typer.Option("--runs", help="Runs of each kind.")] = 12,
    faults: Annotated[
        bool, typer.Option("--faults", help="Ask that the goal is kept with broken sensors, inputs and solvers, too.")
    ] = False,
    logs: Logs = Path("logs"),
) -> None:
    """Test a designed controller from random starts, with noise, inputs 20 % off and faults; exit 1 where it fails."""
    from koopmpc.fitting.check import check_controller

    out = console()
    with friendly(), folder_of(logs, "check") as folder, bar("runs") as progress:
        done = check_controller(controller, folder, runs=runs, faults=faults, progress=progress)
    out.print(Text(f"{done}\n\nreport: {done.page}"), soft_wrap=True)
    if not done.kept:
        raise typer.Exit(1)


@app.command()
def export(
    controller: Annotated[Path, typer.Argument(help="What the save of a controller or of a design wrote.")],
    out: Annotated[Path, typer.Option("--out", help="The folder to write; it may hold an older export.")],
    name: Annotated[str, typer.Option("--name", help="What its files and symbols start with.")] = "koopmpc",
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
    from koopmpc.synthesis.designed import SavedDesign, made, saved_controller

    example: dict[str, Any] = {}
    with friendly():
        saved = saved_controller(controller)
        loaded = made(saved, controller)
        if isinstance(saved, SavedDesign):  # the model itself, from a start of the design to its reference
            asked = saved.evidence.asked
            example = {"x0": asked.starts[0], "reference": asked.reference if asked.moves else asked.reference[:1]}
        if problem is not None:
            given = load_problem(problem)
            name, case = next(iter(given.cases.items()))
            row = np.atleast_2d(np.asarray(case.reference))
            example = {"plant": Prepared(given).truth_of(name), "x0": case.x0, "reference": row, "steps": case.steps}
        folder = write(loaded, out, name=name, precision=cast("Any", precision), **example)
    console().print(Text(f"{folder}: make run builds it and prints its closed loop"), soft_wrap=True)


@app.command()
def view(
    logs: LogFiles,
    compare: Annotated[bool, typer.Option("--compare", help="Draw all runs in one set of plots.")] = False,
    web: Annotated[bool, typer.Option("--web", help="Serve to a browser on 127.0.0.1 until Ctrl-C.")] = False,
    port: Annotated[int, typer.Option("--port", help="Port of the page that --web serves.")] = 9090,
) -> None:
    """Open logs in one Rerun viewer, one beside the other or, with --compare, in the same plots."""
    import tempfile

    from koopmpc.recording.comparison import record_comparison
    from koopmpc.recording.viewer import need_display, served
    from koopmpc.recording.viewer import view as open_viewer

    out = console()
    with friendly():
        shown = list(logs)
        if compare and not web:
            need_display(logs, options="--compare ")
        if compare:
            shown = [Path(tempfile.mkdtemp(prefix="koopmpc-")) / "comparison.rrd"]
            record_comparison(logs, shown[0])
        if web:
            with served(shown, port) as (address, data):
                say_page(address, port, data)
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

    with friendly():
        export(log, video, fps=fps, width=width, speed=speed, until=until)
    console().print(Text(f"{video}, {video.stat().st_size / 1000:.0f} kB"), soft_wrap=True)


@app.command()
def explain(
    term: Annotated[
        list[str] | None, typer.Argument(help="A word of a table, a report or a picture; all if left out.")
    ] = None,
) -> None:
    """Explain a word that stands in a table, a report or a picture."""
    from koopmpc.cli.terms import TERMS
    from koopmpc.cli.terms import explain as explained

    out = console()
    with friendly():
        if term:
            out.print(Text(explained(" ".join(term))))
            return
    for name, text in TERMS.items():
        out.print(Text.assemble((name, "bold"), f": {text}"))


@app.command()
def reproduce(
    paper: Annotated[str | None, typer.Argument(help="Name of the paper, as snyder; a wrong one lists all.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Every paper, two at a time.")] = False,
    logs: Logs = Path("logs"),
) -> None:
    """Reproduce a paper: its figures, its numbers, and a verdict on each claim; 1 where a required number is missed."""
    from time import perf_counter

    from koopmpc.papers.registry import PAPERS, find_paper, reproduce_all, summary_table, verdict_table

    out, err = console(), Console(stderr=True)
    start = perf_counter()
    with friendly():
        if (paper is None) is not every:
            raise ProblemError(f"name one paper, or pass --all; there are {', '.join(PAPERS)}")
        if paper is None:
            folder = new_folder(logs, "papers")
            with err.status("") as status:
                found = reproduce_all(folder, False, status.update)
            out.print(summary_table(found))
            paths, failed = [folder / "index.md"], any(each.outcome.failed for each in found)
        else:
            one = find_paper(paper)
            folder = new_folder(logs, paper)
            with err.status("") as status:
                outcome = one.reproduce(folder, False, status.update)
            out.print(verdict_table(one.title, outcome.claims))
            paths, failed = [outcome.report, outcome.recording], bool(outcome.failed)
        for path in paths:
            out.print(Text(str(path)), soft_wrap=True)
        out.print(Text(f"done in {perf_counter() - start:.0f} s"))
    if failed:
        raise typer.Exit(1)


for command in (sweeps.run, sweeps.bench, sweeps.report, sweeps.compare, sweeps.inspect, sweeps.replay):
    app.command()(command)
