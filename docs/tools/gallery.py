"""A page a problem, from its file and from what the bench measured: `python docs/tools/gallery.py [NAME…]`.

It writes docs/problems/NAME.md, the picture of a run, and its animation; about two minutes for all. An animation is
made smaller until it has at most 200 kB. `--pages` writes the pages alone, after a change of measured.json.
"""

import ast
import dataclasses
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from drawn import stamp
from standings import format_goals, format_standings

import koopmpc as km
from koopmpc.apps.bench.controllers import Prepared, is_learned
from koopmpc.apps.bench.measured import find_baseline, find_best_learned, read_standings
from koopmpc.apps.bench.problem_files import shipped
from koopmpc.apps.bench.single import find_time_unit, run_closed_loop
from koopmpc.apps.bench.store import RunRow
from koopmpc.base.page import Page
from koopmpc.views.recording.video import export_video

DOCS = Path(__file__).parents[1]
FOLDER = DOCS / "problems"
LARGEST = 200_000  # bytes of an animation
SIZES = ((420, 12), (360, 10), (300, 8), (240, 6), (200, 5))  # width [pixels] and pictures a second, until it fits
SECONDS = 8.0  # of a run that an animation shows, at most
FEW = 6  # states that a picture shows


def page(path: Path, *, pictures: bool = True) -> Page:
    """Write the page of a problem file, with its picture and animation."""
    problem, source = km.load_problem(path), path.read_text(encoding="utf-8")
    name, found = problem.name, read_standings().get(problem.name, {})
    best = find_best_learned(found) or (problem.controllers or ("koopman-mpc",))[-1]
    case = next(iter(problem.cases))
    if pictures:
        draw(problem, best, case)
        stamp(f"problems/{name}/run.{kind}" for kind in ("png", "gif"))
    made = Page(FOLDER, beside=name)
    title, _, about = (ast.get_docstring(ast.parse(source)) or name).partition("\n\n")
    made.text(f"# {name}: {title.partition(': ')[2].rstrip('.') or title}", *about.split("\n\n"))
    moving = FOLDER / name / "run.gif"
    if moving.is_file():
        made.parts.append(f"![{name}, {case}, {best}]({name}/run.gif)")
    made.parts.append(f"*`koopmpc run {name}:{case} -c {best}`*. [All problems](../library.md)")
    made.text("## The plant")
    made.code((type(problem.dynamics).__doc__ or "").strip())
    told = f" Measured disturbances: {_listed(problem.dynamics.disturbances)}." if problem.dynamics.nw else ""
    made.text(f"States: {_listed(problem.dynamics.states)}. Inputs: {_listed(problem.dynamics.inputs)}.{told}")
    rows = parameters(problem.dynamics, source)
    if rows:
        made.table(("parameter", "value", "meaning"), rows)
    rest = ", ".join(f"{name} = {_vector(at)}" for name, at in zip("xuw", problem.equilibrium, strict=False))
    second = find_time_unit(problem)
    made.text(
        f"""Sampled every {problem.dt:g} {second} by {type(problem.integrator).__name__}. Linear controllers linearise
        at {rest}. Limits: {limits(problem, problem.limits)}."""
    )
    training, cost, ahead = problem.training, problem.cost, problem.horizon
    lasts = training.episodes * training.steps * problem.dt
    observables = problem.lifting.bind(problem.dynamics.states).nz
    made.text(
        "## How it is learned, and what counts",
        f"""{training.episodes} episodes of {training.steps} steps, {lasts:g} {second} in all, under
        {type(training.excitation).__name__}. {observables} observables; the
        horizon is {ahead} steps, {ahead * problem.dt:g} {second}.
        Weights: Q = {_weights(cost.Q)}, R = {_weights(cost.R)}.""",
    )
    made.table(
        ("case", "start", "reference", f"time [{second}]", "what is special"),
        [
            (each, _vector(one.x0), reference(one), f"{one.steps * problem.dt:g}", special(problem, one))
            for each, one in problem.cases.items()
        ],
    )
    if (FOLDER / name / "run.png").is_file():
        made.parts.append(f"![{name}, {case}: a run of {best}]({name}/run.png)\n\n*{best} on the case {case}*")
    made.text("## What the bench measured")
    if found:
        made.text(
            f"""Cost over that of {find_baseline(found)}, in the worst of the cases in which the equations are the
            plant's, and the median time of a step over its. † breaks a limit on a state that it keeps."""
        )
        made.table(
            ("controller", "cost", "time of a step"),
            [
                (f"**{c}**" if c == best else c, str(one), "1" if c == find_baseline(found) else _time(one.time))
                for c, one in found.items()
            ],
        )
        made.text(verdict(found, best))
    else:
        made.text(
            "This problem is for controllers that learn while they run, and has no row in the bench: "
            "see [Adaptive control](../adaptive.md)."
        )
    told = lessons(name)
    if "lqr" in found and (found["lqr"].ratio > 1.05 or found["lqr"].over):
        told.append("`lqr` knows no references that move and no limits on states; its inputs are clipped to theirs.")
    if told:
        made.text("## What fails here, and why")
        made.items(told)
    lines = len(source.splitlines())
    made.text("## The file { data-search-exclude }", f"`problems/{path.name}`, {lines} lines, to run and to copy:")
    made.code(f'--8<-- "problems/{path.name}"', "py")  # the site shows the file itself
    made.write(f"{name}.md")
    return made


def draw(problem: km.Problem, controller: str, case: str) -> None:
    """Run the case, and write its picture and its animation."""
    folder = FOLDER / problem.name
    folder.mkdir(parents=True, exist_ok=True)
    row = RunRow(problem.name, case, controller, x0=tuple(problem.cases[case].x0))
    run = run_closed_loop(Prepared(problem), row, plans=False)
    nx = len(problem.dynamics.states)
    states = None if nx <= FEW else list(range(0, nx, nx // 4))
    km.plot.save(km.plot.run(run, states=states, width="two columns"), folder / "run.png")
    with TemporaryDirectory() as scratch:
        log, made = Path(scratch) / "run.rrd", Path(scratch) / "run.gif"
        km.record(run, log)
        seconds = min(run.steps * run.dt, SECONDS)
        for width, fps in SIZES:
            export_video(log, made, width=width, fps=fps, until=seconds, speed=seconds / 5)
            if made.stat().st_size <= LARGEST:
                (folder / "run.gif").write_bytes(made.read_bytes())
                return
    raise RuntimeError(f"{problem.name}: no animation has at most {LARGEST} bytes")


def parameters(dynamics: Any, source: str) -> list[tuple[str, str, str]]:
    """Return name, value and meaning of the plant's parameters; the meaning is the comment behind each in the file."""
    comments = dict(re.findall(r"^    (\w+): float = [^#\n]+#\s*(.+?)(?:  # noqa.*)?$", source, re.MULTILINE))
    fields = [field for field in dataclasses.fields(dynamics) if isinstance(getattr(dynamics, field.name), float | int)]
    return [(field.name, f"{getattr(dynamics, field.name):g}", comments.get(field.name, "")) for field in fields]


def limits(problem: km.Problem, some: km.Limits) -> str:
    """Return the limits in words."""
    names = (*problem.dynamics.inputs, *problem.dynamics.states)
    nu, nx = len(problem.dynamics.inputs), len(problem.dynamics.states)
    low, high = (
        np.concatenate([_full(getattr(some, f"u_{end}"), nu, sign), _full(getattr(some, f"x_{end}"), nx, sign)])
        for end, sign in (("min", -np.inf), ("max", np.inf))
    )
    said = [
        f"{a:g} ≤ {n} ≤ {b:g}" if np.isfinite([a, b]).all() else f"{n} ≥ {a:g}" if np.isfinite(a) else f"{n} ≤ {b:g}"
        for n, a, b in zip(names, low, high, strict=True)
        if np.isfinite([a, b]).any()
    ]
    rest = [name for name in ("y_min", "y_max", "du_max") if getattr(some, name) is not None]
    said += [f"{name} = {_vector(getattr(some, name))}" for name in rest]
    return (", ".join(said[:FEW]) + (" …" if len(said) > FEW else "")) or "none"


def reference(case: km.Case) -> str:
    """Return the reference of a case in short."""
    r = np.asarray(case.reference)
    if r.ndim == 1:
        return _vector(r)
    return "moves" if len(np.unique(r, axis=0)) > FEW else "steps"


def special(problem: km.Problem, case: km.Case) -> str:
    """Return what a case has that others have not."""
    said = [] if case.limits is None else [limits(problem, case.limits)]
    if case.plant is not None:
        changed = (
            [
                f"{field.name} = {getattr(case.plant, field.name):g}"
                for field in dataclasses.fields(case.plant)
                if getattr(case.plant, field.name) != getattr(problem.dynamics, field.name, None)
            ]
            if type(case.plant) is type(problem.dynamics)
            else ["another plant"]
        )
        said.append("the plant has " + ", ".join(changed))
    said += [] if case.noise is None else ["measured with noise"]
    said += [str(fault) for fault in case.faults]
    return "; ".join(said)


def verdict(found: Any, best: str) -> str:
    """Return in a sentence which learned controller wins, and which lose."""
    lost = [name for name, one in found.items() if is_learned(name) and (one.ratio > 1.05 or one.over)]
    first = f"The best learned controller is {best}, at {found[best].ratio:.3g} of the cost."
    return first if not lost else first + f" Beyond 5 %, or a limit, are {', '.join(lost)}."


def lessons(name: str) -> list[str]:
    """Return the items of docs/library.md that are about a problem."""
    text = (DOCS / "library.md").read_text(encoding="utf-8")
    items = re.findall(r"^- (.+(?:\n  .+)*)", text, re.MULTILINE)
    return [" ".join(item.split()) for item in items if f"`{name}`" in item.partition(":")[0]]


def _listed(names: Any) -> str:
    shown = [f"`{name}`" for name in names]
    return ", ".join(shown) if len(shown) <= 8 else f"{shown[0]}, {shown[1]}, …, {shown[-1]}"


def _full(value: Any, n: int, fill: float) -> np.ndarray:
    return np.full(n, fill) if value is None else np.broadcast_to(np.asarray(value, dtype=float), (n,))


def _vector(value: Any) -> str:
    x = np.ravel(np.asarray(value, dtype=float))
    if len(x) > FEW:
        return f"{x[0]:.3g} everywhere" if np.ptp(x) == 0 else f"a shape of {len(x)} numbers"
    return f"[{', '.join(f'{v:.4g}' for v in x)}]"


def _weights(matrix: Any) -> str:
    Q = np.atleast_2d(np.asarray(matrix, dtype=float))
    return _vector(Q if min(Q.shape) == 1 else Q.diagonal())


def _time(ratio: float) -> str:
    return f"1/{1 / ratio:.0f}" if 0 < ratio < 0.7 else f"{ratio:.1f}"


def tables() -> None:
    """Write the tables of measured.json into docs/library.md."""
    path = DOCS / "library.md"
    text = path.read_text(encoding="utf-8")
    for begin, end, table in (("table", "end", format_standings), ("goals", "end of goals", format_goals)):
        before, rest = text.split(f"<!-- {begin} -->\n")
        text = (
            f"{before}<!-- {begin} -->\n\n{table(read_standings())}\n\n<!-- {end} -->"
            + rest.partition(f"<!-- {end} -->")[2]
        )
    path.write_text(text, encoding="utf-8")


def main(arguments: list[str]) -> None:
    """Write the tables of the library's page, and the pages of the problems named, by default of all."""
    tables()
    names = [each for each in arguments if not each.startswith("--")]
    for path in shipped():
        if not names or path.stem in names:
            page(path, pictures="--pages" not in arguments)
            print(path.stem, flush=True)  # noqa: T201


if __name__ == "__main__":
    main(sys.argv[1:])
