"""The command line: each command parses, calls one function, and prints; and the words that `explain` knows."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Annotated, Any, cast

import typer
from rich.console import Console
from rich.text import Text

from koopmpc.apps.cli import start, sweeps
from koopmpc.apps.cli.console import (
    as_options,
    bar,
    console,
    folder_of,
    format_command,
    friendly,
    new_file,
    new_folder,
    say,
    say_page,
    split_columns,
)
from koopmpc.apps.cli.explain import explain
from koopmpc.apps.cli.options import take_options
from koopmpc.apps.cli.sweeps import Logs
from koopmpc.apps.fitting.options import FitOptions
from koopmpc.base.errors import DataError, KoopmpcError, ProblemError

app = typer.Typer(name="koopmpc", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

FIT_HELP = {  # of the lists that a shell writes with commas
    "inputs": 'Columns that are inputs: u,v,… or 2; "" where there are none.',
    "columns": "Names to use: old=new,old=new,…; or of all columns: a,b,…",
}
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
    from koopmpc.apps.bench.measured import describe_best
    from koopmpc.apps.bench.problem_files import list_problems, load_problem, shipped

    out, own = console(), shipped()
    for entry in list_problems():
        out.print(Text.assemble((entry.name, "bold"), "  ", entry.title))
        try:
            out.print(Text(f"  cases: {', '.join(load_problem(entry.path).cases)}"))
        except KoopmpcError as error:
            out.print(Text(f"  {error}", style="red"))
        if entry.path in own and (words := describe_best(entry.name)):
            out.print(Text(f"  {words}", style="dim"))


@app.command()
def new(name: Annotated[str, typer.Argument(help="Name of the problem; the file <name>.py is written here.")]) -> None:
    """Write a commented problem file that runs, to be changed into your own."""
    from koopmpc.apps.bench.problem_files import new_problem

    with friendly():
        path = new_problem(name)
    say(f"written: {path}; it holds a mass on a spring, put your plant in its place")
    say(f"run it: {format_command('run', path)}")


@app.command()
@take_options(FitOptions, help=FIT_HELP)
def fit(
    data: Annotated[
        list[Path],
        typer.Argument(help="A folder of logs, or files: .csv, .parquet, .npz, .rrd, .mat, .h5, .mf4, .mcap, .db3."),
    ],
    *,
    options: FitOptions,
    logs: Logs = Path("logs"),
    name: Annotated[str, typer.Option("--name", help="Ends the name of the folder.")] = "fit",
    goal: Annotated[Path | None, typer.Option("--goal", help="A goal file: design a controller that keeps it.")] = None,
    goal_template: Annotated[
        bool, typer.Option("--goal-template", help="Write goal.toml for these logs, to be changed, and stop.")
    ] = False,
) -> None:
    """Choose a model for logged data, fit it, and say whether to trust it; with a goal, design a controller."""
    from koopmpc.apps.fitting.designing import design_data
    from koopmpc.apps.fitting.fit import fit_data
    from koopmpc.apps.fitting.goal import write_template

    source: Any = data[0] if len(data) == 1 else data
    with friendly():
        if options.columns is not None:
            options = replace(options, columns=split_columns(",".join(options.columns)))

    def say_line(text: str) -> None:
        notes = (as_options(line) if line.startswith("! ") else line for line in text.split("\n"))
        say("\n".join([*notes, ""]))

    if goal_template:
        with friendly():
            path = new_file(Path("goal.toml"), write_template(source, options, say_line))
        say(f"written: {path}; say in it what you want")
        more = ["--linear"] * options.linear + ["--feedthrough"] * options.feedthrough
        for option, value, usual in (
            ("--workers", options.workers, None),
            ("--scheduler", options.scheduler, None),
            ("--logs", logs, Path("logs")),
            ("--name", name, "fit"),
        ):
            more += [option, str(value)] * (value != usual)
        say(f"then: {format_command('fit', *data, '--goal', path, *more)}")
    elif goal is not None:
        with friendly():
            if (horizon := options.horizon) is not None:
                raise DataError(f"--horizon {horizon} is of no use with --goal; write horizon = {horizon} into {goal}")
        with friendly(), folder_of(logs, name) as folder, bar("reading") as progress:
            designed = design_data(source, goal, folder, options, say_line, progress)
        say(f"controller: {designed.controller}, report: {designed.page}")
        say(f"check it: {format_command('check', designed.controller)}\nuse it:\n{designed.usage}")
    else:
        with friendly():
            options.refuse_design()
        with friendly(), folder_of(logs, name) as folder, bar("reading") as progress:
            done = fit_data(source, folder, options, say_line, progress)
        for failure in done.failures:
            Console(stderr=True).print(Text.assemble(("not made: ", "yellow"), failure), soft_wrap=True)
        say(f"model, report and pictures: {folder}")
        if done.recording is not None:
            say(f"look at it: {format_command('view', done.recording)}")
        say(f"use it:\n{done.usage}")


@app.command()
def check(
    controller: Annotated[Path, typer.Argument(help="What `koopmpc fit --goal` or the save of a design wrote.")],
    runs: Annotated[int, typer.Option("--runs", help="Runs of each kind.")] = 12,
    new: Annotated[
        list[Path] | None, typer.Option("--new", help="New logs of the plant: has it changed since the design?")
    ] = None,
    faults: Annotated[
        bool, typer.Option("--faults", help="Ask that the goal is kept with broken sensors, inputs and solvers, too.")
    ] = False,
    rate: Annotated[
        float, typer.Option("--rate", help="Wished bound on the share of failing loops; it says how many are run.")
    ] = 0.05,
    on_plant: Annotated[
        Path | None,
        typer.Option("--on-plant", help="Logs of this controller on its plant, an episode a run: a file or a folder."),
    ] = None,
    logs: Logs = Path("logs"),
) -> None:
    """Test a designed controller from random starts, with noise, inputs 20 % off and faults.

    Exit code 0: the goal is kept. 1: it is not. 3: the logs do not show whether it is.
    """
    from koopmpc.apps.fitting.changed import read_new_logs, read_plant_runs
    from koopmpc.apps.fitting.check import check_controller
    from koopmpc.apps.fitting.verdict import plan_verdict
    from koopmpc.base.disk import existing
    from koopmpc.data.files.folder import list_files

    with friendly():
        existing(controller, "pass the .npz of a saved Controller or Design")
        say(plan_verdict(rate))
        seen = None if on_plant is None else read_plant_runs(controller, list_files(on_plant))
    with friendly(), folder_of(logs, "check") as folder, bar("runs") as progress:
        logged = None if not new else read_new_logs(controller, new)
        done = check_controller(
            controller, folder, runs=runs, faults=faults, rate=rate, on_plant=seen, new=logged, progress=progress
        )
    say(f"{done}\n\nreport: {done.page}")
    if done.verdict != "kept":
        raise typer.Exit(1 if done.reasons else 3)


@app.command("export")
def run_export(
    controller: Annotated[Path, typer.Argument(help="What the save of a controller or of a design wrote.")],
    out: Annotated[Path, typer.Option("--out", help="The folder to write; it may hold an older export.")],
    name: Annotated[str, typer.Option("--name", help="What its files and symbols start with.")] = "koopmpc",
    precision: Annotated[str, typer.Option("--precision", help="double or float.")] = "double",
    problem: Annotated[
        str | None, typer.Option("--problem", help="The example controls the plant of this problem: name or name:case.")
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option("--reference", help='Reference rows of the C code: "0.5,0", or several as "0,0; 0.5,0".'),
    ] = None,
    fmu: Annotated[
        int | None, typer.Option("--fmu", help="2 or 3: also write the controller as an FMI co-simulation unit.")
    ] = None,
) -> None:
    """Write a controller as C99: sources, Makefile, CMakeLists.txt, an example, and a README with its sizes."""
    import numpy as np

    from koopmpc.apps.bench.controllers import Prepared
    from koopmpc.apps.bench.problem_files import load_problem
    from koopmpc.codegen.export import export as write
    from koopmpc.synthesis.designed import SavedDesign, read_controller, rebuild_controller

    example: dict[str, Any] = {}
    with friendly():
        saved = read_controller(controller)
        loaded = rebuild_controller(saved, controller)
        if isinstance(saved, SavedDesign):  # the model itself, from a start of the design to its reference
            asked = saved.evidence.task
            example = {"x0": asked.starts[0], "reference": asked.reference if asked.moves else asked.reference[:1]}
        if problem is not None:
            given = load_problem(problem)
            case_name, case = next(iter(given.cases.items()))
            row = np.atleast_2d(np.asarray(case.reference))
            truth = Prepared(given).truth_of(case_name)
            example = {"plant": truth, "x0": case.x0, "reference": row, "steps": case.steps}
        if reference is not None:
            example["reference"] = _read_rows(reference)
        folder = write(loaded, out, name=name, precision=cast("Any", precision), fmu=fmu, **example)
    say(f"{folder}: make run builds it and prints its closed loop")
    if fmu is not None:
        say(f"{folder / name}.fmu: the controller as a co-simulation unit, FMI {fmu}")


def _read_rows(text: str) -> list[list[float]]:
    """Return the numbers of rows such as "0,0; 0.5,0"."""
    try:
        return [[float(word) for word in row.split(",")] for row in text.split(";") if row.strip()]
    except ValueError as error:
        raise DataError(f'--reference is "{text}"; write numbers, a row as "0.5,0", rows as "0,0; 0.5,0"') from error


@app.command("view")
def run_view(
    logs: LogFiles,
    compare: Annotated[bool, typer.Option("--compare", help="Draw all runs in one set of plots.")] = False,
    web: Annotated[bool, typer.Option("--web", help="Serve to a browser on 127.0.0.1 until Ctrl-C.")] = False,
    port: Annotated[int, typer.Option("--port", help="Port of the page that --web serves.")] = 9090,
) -> None:
    """Open logs in one Rerun viewer, one beside the other or, with --compare, in the same plots."""
    import tempfile

    from koopmpc.views.recording.comparison import record_comparison
    from koopmpc.views.recording.viewer import need_display, serve
    from koopmpc.views.recording.viewer import view as open_viewer

    with friendly():
        shown = list(logs)
        if compare and not web:
            need_display(logs, options="--compare ")
        if compare:
            shown = [Path(tempfile.mkdtemp(prefix="koopmpc-")) / "comparison.rrd"]
            record_comparison(logs, shown[0])
        if web:
            with serve(shown, port) as (address, data):
                say_page(address, port, data)
                with suppress(KeyboardInterrupt):
                    Event().wait()
            return
        open_viewer(shown)
        if len(shown) > 1:
            console().print(
                Text("the first panel button at the top right lists the logs; --compare draws all in one set")
            )


@app.command("export-video")
def run_export_video(
    log: Annotated[Path, typer.Argument(help="A log whose plant has a scene.")],
    video: Annotated[Path, typer.Argument(help="The .gif or .mp4 to write.")],
    fps: Annotated[int, typer.Option("--fps", help="Pictures a second.")] = 20,
    width: Annotated[int, typer.Option("--width", help="Width of the picture in pixels.")] = 640,
    speed: Annotated[float, typer.Option("--speed", help="Seconds of the run in a second of the video.")] = 1.0,
    until: Annotated[float | None, typer.Option("--until", help="Time in s at which the video ends.")] = None,
) -> None:
    """Write the animation of a log as a .gif or .mp4; no screen is needed."""
    from koopmpc.views.recording.video import export_video as export

    with friendly():
        export(log, video, fps=fps, width=width, speed=speed, until=until)
    say(f"{video}, {video.stat().st_size / 1000:.0f} kB")


@app.command()
def reproduce(
    paper: Annotated[str | None, typer.Argument(help="Name of the paper, as snyder; a wrong one lists all.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Every paper, two at a time.")] = False,
    logs: Logs = Path("logs"),
) -> None:
    """Reproduce a paper: its figures, its numbers, and a verdict on each claim; 1 where a required number is missed."""
    from time import perf_counter

    from koopmpc.apps.papers import PAPERS, find_paper, make_summary_table, make_verdict_table, reproduce_all

    out, err = console(), Console(stderr=True)
    start = perf_counter()
    with friendly():
        if (paper is None) is not every:
            raise ProblemError(f"name one paper, or pass --all; there are {', '.join(PAPERS)}")
        if paper is None:
            folder = new_folder(logs, "papers")
            with err.status("") as status:
                found = reproduce_all(folder, False, status.update)
            out.print(make_summary_table(found))
            paths, failed = [folder / "index.md"], any(each.outcome.failures for each in found)
        else:
            one = find_paper(paper)
            folder = new_folder(logs, paper)
            with err.status("") as status:
                outcome = one.reproduce(folder, False, status.update)
            out.print(make_verdict_table(one.title, outcome.claims))
            paths, failed = [outcome.report, outcome.recording], bool(outcome.failures)
        for path in paths:
            say(str(path))
        out.print(Text(f"done in {perf_counter() - start:.0f} s"))
    if failed:
        raise typer.Exit(1)


app.command("run")(sweeps.run_problem)
app.command("start")(start.show_ways)
for command in (explain, sweeps.bench, sweeps.report, sweeps.compare, sweeps.inspect, sweeps.replay, start.doctor):
    app.command()(command)
