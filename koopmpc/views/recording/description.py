"""What a log holds: its columns, and the description of a run as exact JSON and as a page to read."""

import dataclasses
import json
import re
import unicodedata
from collections.abc import Mapping
from enum import StrEnum
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple, cast

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import LogError
from koopmpc.base.text import format_markdown_table
from koopmpc.base.values import from_data, to_data
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.move import Fallback, Status
from koopmpc.lifting.base import Lifting
from koopmpc.loop.metrics import Metrics
from koopmpc.loop.rows import MOVE_COLUMNS, StepRows
from koopmpc.loop.run import About, bind_outputs

_FORMAT = "koopmpc-log-2"


class Entity(StrEnum):
    """Where the columns of a log stand.

    An entity holds rows of numbers in its component "scalars", row k at step k; other components are named beside it.
    What only the viewer draws is not in it: `world`, `model`, `plots`, `title`, and components `koopmpc.View:…`:
    one state alone in single precision, the power of ten of a time. `MOVE_COLUMNS` names further columns: numbers in
    the rows where they differ from the column's absent value, words in "state" in the rows where they change. The last
    row of a log is `checksum`, of all its bytes.
    """

    DESCRIPTION = "description"  # static: the page that people read, and "json", the same data to the bit
    STATE = "state"  # x_k, NaN where the plant hides it; written last, so a row that has its state is whole
    MEASUREMENT = "measurement"  # y_k, in the rows where it is not x_k to the bit
    REFERENCE = "reference"  # r_k
    INPUT = "control/u"  # u_k as applied
    INPUT_REFERENCE = "control/u_reference"  # the input that holds r_k, in the rows where it is not 0
    INPUT_LIMITS = "control/limits"  # the finite limits of u, at the first and last step of a run or live block
    SOLVER = "solver/time_ms"  # solve time [ms]; "seconds" where it is not ms / 1000 to the bit; "iterations" above 0
    DEADLINE = "solver/deadline_ms"  # dt [ms], at the same steps
    STATUS = "solver/status"  # "state": STATUS or STATUS → FALLBACK, in the rows where it changes
    PLAN_STATES = "prediction/x"  # the planned states of a step, flat; "last_width" is nx
    PLAN_INPUTS = "prediction/u"  # the planned inputs of a step, flat; "last_width" is nu
    FALLBACKS = "log"  # text: a line where a fallback sets in
    METRICS = "metrics"  # static, at the end: a page, "steps", "cost", "effort", "violation"


DRAWN = (Entity.INPUT_LIMITS, Entity.DEADLINE, Entity.FALLBACKS)  # for people who look; `load_run` needs all others
READ = tuple(entity for entity in Entity if entity not in DRAWN)
NO_WORD = "none"  # word of a step without one, such as the solver of a step that asked none; also before all rows


# entity -> the column of words that it keeps
WORDS = {column.log: column.name for column in MOVE_COLUMNS if column.log and column.dtype is None}


class Sparse(NamedTuple):
    """Where a log keeps a column of numbers, in the rows where it is not, to the bit, the `absent` value."""

    entity: str
    component: str
    absent: np.ndarray


def sparse_columns(X: np.ndarray, ms: np.ndarray, ny: int, nu: int) -> dict[str, Sparse]:
    """Return how the columns of `StepRows` are kept that follow, as a rule, from the states and the solve times."""
    measured = X if X.shape[1] == ny else np.full((len(X), ny), np.nan)
    found = {
        "Y": Sparse(Entity.MEASUREMENT, "scalars", measured),
        "u_reference": Sparse(Entity.INPUT_REFERENCE, "scalars", np.zeros((len(ms), nu))),
        "solve_time": Sparse(Entity.SOLVER, "seconds", ms / 1e3),
        "iterations": Sparse(Entity.SOLVER, "iterations", np.zeros(len(ms), dtype=np.int64)),
    }
    for column in MOVE_COLUMNS:
        if column.log and column.dtype is not None:
            found[column.name] = Sparse(column.log, "scalars", np.full(len(ms), column.absent, dtype=column.dtype))
    return found


def word_columns(rows: StepRows) -> dict[str, list[str]]:
    """Return the words of each row by entity; a log keeps them where they change."""
    words: dict[str, list[str]] = {
        entity: [word or NO_WORD for word in getattr(rows, name)] for entity, name in WORDS.items()
    }
    words[Entity.STATUS] = [status_value(*pair) for pair in zip(rows.status, rows.fallback, strict=True)]
    return words


def application_of(about: About) -> str:
    """Return the Rerun application of a problem and a controller, by which Rerun stores layouts: each has its own."""
    plant = about.metadata.get("problem", "run-" + "-".join((*about.states, *about.inputs)))
    controller = about.metadata.get("controller")
    parts = [str(part) for part in (plant, controller) if part is not None]
    return "koopmpc-" + re.sub(r"[^A-Za-z0-9_-]+", "_", "-".join(parts))


def title_of(about: About) -> str:
    """Return problem, case, controller and fault in one line, without those that are unknown; or the run's own title.

    A run has a title of its own by ``simulate(…, metadata={"title": "tank, new valve"})``. That of a run of a problem
    file is the problem's, the same for all its controllers.
    """
    if "title" in about.metadata and "problem" not in about.metadata:
        return str(about.metadata["title"])
    parts = [about.metadata.get(key) for key in ("problem", "case", "controller", "fault")]
    known = [str(p) for p in parts if p is not None]
    if "problem" not in about.metadata:  # a user's own script: the plant's names tell what was driven
        known.insert(0, ", ".join(re.sub(r"\s*\[.*?\]", "", name) for name in about.states[:4]))
    return " · ".join(known)


STATUS_WORDS = {
    Status.UNCONSTRAINED: "free",
    Status.OPTIMAL: "optimal",
    Status.SOFTENED: "softened",
    Status.SATURATED: "clipped",
    Status.MAX_ITERATIONS: "unfinished",
    Status.TIME_LIMIT: "out of time",
    Status.INFEASIBLE: "infeasible",
    Status.BAD_MEASUREMENT: "bad y",
    Status.FAILED: "failed",
}
"""Status → its word in tables and pictures; `koopmpc explain WORD` says what it means."""


def status_words(status: Status, fallback: Fallback) -> str:
    """Return how a step ended in words: ``"free"``, ``"unfinished, then shifted plan"``."""
    word = STATUS_WORDS.get(status, status.name.lower().replace("_", " "))
    return word if fallback is Fallback.NONE else f"{word}, then {fallback.name.lower().replace('_', ' ')}"


def status_value(status: Status, fallback: Fallback) -> str:
    """Return "STATUS" or "STATUS → FALLBACK", as the log holds it."""
    return status.name if fallback is Fallback.NONE else f"{status.name} → {fallback.name}"


def to_json(about: About, steps: int | None) -> str:
    """Return `about` as JSON, exact to the bit; `steps` where the length is known beforehand."""
    tree = {"format": _FORMAT, "steps": steps, "written_with": written_with(), "about": to_data(about)}
    return json.dumps(tree, ensure_ascii=False)


def from_json(text: str) -> tuple[About, int | None]:
    """Return the description and the number of steps that `to_json` wrote.

    Raises
    ------
    LogError
        The text is damaged or of another format.
    """
    try:
        tree: Any = json.loads(text)
        if tree["format"] != _FORMAT:
            raise LogError(f"the description has format {tree['format']!r}, this koopmpc reads {_FORMAT!r}")
        about, steps = from_data(tree["about"]), tree["steps"]
    except (ValueError, KeyError, TypeError) as error:
        raise LogError(f"the description is damaged: {error}") from error
    if not isinstance(about, About):
        raise LogError(f"the description holds {checks.article(about)} in place of the description of a run")
    return about, steps


def to_markdown(about: About) -> str:
    """Return a page with the problem, the cost, the limits, the seeds and the versions of a run."""
    lines = [f"# {title_of(about)}", ""]
    if "title" in about.metadata:
        lines += [str(about.metadata["title"]), ""]
    lines += [f"**States** {', '.join(about.states)}  ", f"**Inputs** {', '.join(about.inputs)}  "]
    lines += [f"**Sampling time** {about.dt:g} {_time_unit(about)}", ""]
    if about.cost is not None:
        lines += [_table("cost", _fields(about.cost, about)), ""]
    if about.limits is not None:
        lines += [_table("limits", _fields(about.limits, about)), ""]
    run = {key: value for key, value in about.metadata.items() if key != "title"}
    lines += [_table("run", run | {"written with": written_with()}), ""]
    return "\n".join(lines)


def metrics_to_markdown(metrics: Metrics, about: About, nr: int) -> str:
    """Return the metrics as a table."""
    return _table("metric", table_figures(metrics, about, nr))


def table_figures(metrics: Metrics, about: About, nr: int) -> dict[str, str]:
    """Return the metrics in words by their names, with the unit of the effort and the statuses in words."""
    figures = metrics.figures(about.name_references(nr), _time_unit(about))
    statuses = [f"{n} {STATUS_WORDS.get(Status[name], name)}" for name, n in metrics.status.items()]
    fallbacks = [f"{n} {name.lower().replace('_', ' ')}" for name, n in metrics.fallback.items() if name != "NONE"]
    figures |= {"status": ", ".join(statuses), "fallback": ", ".join(fallbacks) or "none"}
    return {_with_unit(name, about): value for name, value in figures.items()}


def _time_unit(about: About) -> str:
    return str(about.metadata.get("time unit", "s"))


def _with_unit(name: str, about: About) -> str:
    """Return the name of a figure; the effort, Σ ‖u‖² dt, with the unit that its inputs share."""
    units = {
        f"({found[-1]})" if " " in found[-1] or "/" in found[-1] else found[-1]
        for found in (re.findall(r"\[(.*?)\]", each) for each in about.inputs)
        if found
    }
    return f"effort [{units.pop()}² {_time_unit(about)}]" if name == "effort" and len(units) == 1 else name


def _table(heading: str, values: Mapping[str, Any]) -> str:
    """Return a table of two columns: names and values."""
    return format_markdown_table((heading, "value"), [(name, _short(value)) for name, value in values.items()])


def _fields(value: Cost | Limits, about: About) -> dict[str, Any]:
    """Return the fields of a cost or of limits that are given, a lifting by the names of its observables."""
    fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    for name, lifting in fields.items():
        if isinstance(lifting, Lifting):
            bound = bind_outputs(lifting, about.states)
            fields[name] = ", ".join(about.states if bound is None else bound.names)
    return {name: v for name, v in fields.items() if v is not None}


def _short(value: Any) -> str:
    """Return `value` in a few characters, fit for a cell."""
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_short(v)}" for k, v in cast("Mapping[str, Any]", value).items())
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, np.ndarray):
        text = np.array2string(cast("np.ndarray", value), precision=4, threshold=16, separator=", ")
    else:
        text = str(value)
    text = " ".join(text.split())
    return text if len(text) <= 200 else text[:199] + "…"


@cache
def written_with() -> dict[str, str]:
    """Return the versions of the packages that a run depends on."""
    versions: dict[str, str] = {}
    for package in ("koopmpc", "numpy", "casadi", "osqp", "rerun-sdk"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "unknown"
    return versions


# Ranges of the signs in Inter, the font of the viewer; a few rare signs of the font are left out.
_RANGES = (
    (0x0020, 0x007E), (0x00A0, 0x0148), (0x014A, 0x01C3), (0x01C5, 0x031E), (0x0384, 0x038A), (0x038E, 0x03A1),
    (0x03A3, 0x03E1), (0x03F0, 0x049D), (0x04A0, 0x04FF), (0x1E00, 0x1F15), (0x2010, 0x2027), (0x202F, 0x205F),
    (0x2074, 0x208E), (0x2090, 0x209C), (0x20A0, 0x20BF), (0x2190, 0x2199), (0x2264, 0x2265),
)  # fmt: skip
_SINGLE = "\n\t⁰ⁱᵏᵢᵣᵤᵥₓ℃ℓ№™Ω⇒⇔∂∅∆∏∑−√∞∫≈≠■▲▶▼◆●★✓✗"
_HELD = frozenset(_SINGLE).union(*(map(chr, range(first, last + 1)) for first, last in _RANGES))
_WORDS = {"ᵀ": "^T", "ᴴ": "^H", "∇": "grad ", "∈": " in ", "⟨": "<", "⟩": ">", "⊤": "^T", "⋅": "·", "∣": "|"}
_UNKNOWN = "?"


def drawable(text: str) -> str:
    """Return `text` with other spellings of signs that the viewer's font lacks: 𝜓 is ψ, Uᵀ is U^T, the rest "?"."""
    return "".join(sign if sign in _HELD else _spell(sign) for sign in text)


def _spell(sign: str) -> str:
    plain = _WORDS.get(sign) or unicodedata.normalize("NFKC", sign)
    return plain if _HELD.issuperset(plain) else _UNKNOWN
