"""Commands that run, compare and look back: run, bench, report, compare, inspect, replay."""

import warnings
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import fields, replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from koopmpc.apps.bench.options import SweepOptions
from koopmpc.apps.cli.console import bar, console, format_command, friendly, new_folder, say, say_page
from koopmpc.apps.cli.ending import ENDING
from koopmpc.apps.cli.options import take_options
from koopmpc.base.errors import LogError

if TYPE_CHECKING:
    from koopmpc.apps.bench.problem import Problem
    from koopmpc.apps.bench.store import RunRow

_PROBLEM = "A name that `koopmpc list` shows, or the path of a problem file; `:case` after it keeps one case."
Logs = Annotated[Path, typer.Option("--logs", help="Where the folder of this call is made.")]
Controllers = Annotated[
    list[str] | None,
    typer.Option("--controller", "-c", help="One of the ten; may be repeated. Default: those that suit any plant."),
]


@take_options(SweepOptions, ("faults", "monitor", "live", "paced"))
def run_problem(
    problem: Annotated[str, typer.Argument(help=_PROBLEM)],
    options: SweepOptions,
    controller: Controllers = None,
    logs: Logs = Path("logs"),
) -> None:
    """Run controllers in closed loop on one problem; one log a run, and a table."""
    from koopmpc.apps.bench.controllers import controller_names
    from koopmpc.apps.bench.problem_files import load_problem

    with friendly(), _page(options.live):
        loaded = load_problem(problem)
        controller_names(controller)  # raises before a folder is made
        _sweep([loaded], controller, new_folder(logs, loaded.name), options)


@take_options(SweepOptions, {field.name for field in fields(SweepOptions)} - {"log_starts"})
def bench(
    options: SweepOptions,
    problems: Annotated[list[str] | None, typer.Argument(help=_PROBLEM + " Default: five, see --all.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Run all problems that come with koopmpc.")] = False,
    controller: Controllers = None,
    logs: Logs = Path("logs"),
    name: Annotated[str, typer.Option("--name", help="Ends the name of the folder.")] = "bench",
    resume: Annotated[Path | None, typer.Option("--resume", help="Go on with the sweep in this folder.")] = None,
) -> None:
    """Compare the controllers that each problem names, else the eight that suit any, from one start or many."""
    from koopmpc.apps.bench.controllers import controller_names
    from koopmpc.apps.bench.problem_files import DEFAULT, load_problem, shipped
    from koopmpc.apps.bench.store import manifest_of

    with friendly(), _page(options.live):
        if resume is None:
            loaded = [load_problem(problem) for problem in (shipped() if every else problems or DEFAULT)]
            controller_names(controller)
            resume = new_folder(logs, name)
        else:
            asked: dict[str, Any] = manifest_of(resume)["asked"]
            loaded = [
                load_problem(each["file"] if len(each["cases"]) > 1 else f"{each['file']}:{each['cases'][0]}")
                for each in asked.pop("problems")
            ]
            controller = asked.pop("controllers")
            options = replace(options, **asked)
        _sweep(loaded, controller, resume, options)


def report(folder: Annotated[Path, typer.Argument(help="The folder of a sweep.")]) -> None:
    """Write report.html, report.md and summary.csv of a sweep, of the runs that are finished."""
    from koopmpc.apps.bench.report import write_report

    with friendly():
        say(str(write_report(folder)))


def compare(
    a: Annotated[Path, typer.Argument(help="A folder of a sweep, or a log: what is known to be good.")],
    b: Annotated[Path, typer.Argument(help="The same kind: what is new.")],
    threshold: Annotated[float, typer.Option("--threshold", help="Share by which B may be worse than A.")] = 0.02,
    times: Annotated[bool, typer.Option("--times", help="Step times count too, not only costs.")] = False,
) -> None:
    """Compare two sweeps, or two logs, run by run; exit 1 where B is worse than A by more than the threshold."""
    from koopmpc.apps.bench.inspect import compare_runs

    with friendly():
        found = compare_runs(a, b, threshold=threshold, times=times)
    console().print(found.table)
    console().print(Text(str(found)))
    if found.regressions:
        raise typer.Exit(1)


def inspect(
    logs: Annotated[list[Path], typer.Argument(help="Logs that koopmpc wrote, or folders of them.")],
    where: Annotated[str | None, typer.Option("--where", help='Only these, for example "violation > 0.01".')] = None,
    repair: Annotated[bool, typer.Option("--repair", help="Write <name>.repaired.rrd of a log that was cut.")] = False,
) -> None:
    """Say what ran, recompute its metrics from the log alone, and name its worst moments with their times."""
    from koopmpc.apps.bench.inspect import inspect_logs, inspection_table

    with friendly():
        found = list(inspect_logs(logs, where, repair=repair))
        if len(found) == 1 and found[0].refused is not None:
            raise LogError(found[0].refused)
    shown = [each for each in found if each.refused is None]
    if len(found) > 1:
        console().print(inspection_table(found))
    for each in shown if len(shown) == 1 or len(logs) == len(shown) <= 3 else ():
        console().print(Text.assemble((each.title, "bold"), f"\n{each}"), soft_wrap=True)
    for each in found:
        if each.refused is not None:
            say(f"{each.path}: {each.refused}", "red")
        elif each.repaired is not None:
            say(f"repaired: {each.repaired}")
    if not found:
        say(f"no log has {where}")
    if not shown and len(found) and where is None:
        raise typer.Exit(2)


def replay(log: Annotated[Path, typer.Argument(help="A log of `koopmpc run` or `koopmpc bench`.")]) -> None:
    """Run again what a log holds, and say whether it is the same to the bit; exit 1 where it is not."""
    from koopmpc.apps.bench.single import replay_log

    with friendly():
        found = replay_log(log)
    say(str(found))
    if found.differences:
        raise typer.Exit(1)


@contextmanager
def _page(live: bool) -> Generator[None]:
    """Serve a page in this block, in a terminal until Ctrl-C, where no viewer is up and none can be opened."""
    from koopmpc.views.recording.viewer import PORT, WEB_PORT, has_display, is_up, serve

    with ExitStack() as page:
        shown = None
        if live and not is_up(PORT) and not has_display():
            try:
                shown = page.enter_context(serve((), live=True))
            except LogError as error:
                warnings.warn(f"--live has no page to show the runs on: {error}", UserWarning, stacklevel=2)
        if shown is not None:
            say_page(shown[0], WEB_PORT, shown[1])
        yield
        if shown is not None and console().is_terminal:
            with suppress(KeyboardInterrupt):
                Event().wait()


def _sweep(problems: "Sequence[Problem]", controllers: list[str] | None, folder: Path, options: "SweepOptions") -> None:
    """Sweep with a progress bar, print the tables, and exit with 1 where a run did not end as it should."""
    from koopmpc.apps.bench.report import build_summary_table, case_table, explain_results, write_report
    from koopmpc.apps.bench.single import find_time_unit
    from koopmpc.apps.bench.store import row_to_view
    from koopmpc.apps.bench.sweep import sweep

    ENDING.folder = folder
    single = options.is_single
    units = {problem.name: find_time_unit(problem) for problem in problems}
    with bar("", rate=True) as progress:

        def show_case(runs: "list[RunRow]") -> None:
            if single:
                progress.print(case_table(runs, units[runs[0].problem]))

        rows = sweep(problems, controllers, folder=folder, options=options, progress=progress, on_case=show_case)
    console().print(explain_results(rows) if single else build_summary_table(rows))
    if not single:
        say(f"\nreport: {write_report(folder)}")
    say(f"\nlogs and results.parquet: {folder}")
    best = row_to_view(rows)
    if best is not None:
        say(f"look at a run: {format_command('view', best.log)}")
    if any(row.failure is not None for row in rows):
        raise typer.Exit(1)
