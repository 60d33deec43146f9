"""The goal of a controller: a file that a person writes for the plant of some logs, and its template."""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from inspect import Parameter, signature
from os import PathLike
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from koopmpc.apps.fitting.fit import Say, describe_data
from koopmpc.apps.fitting.logs import Data, read_logs
from koopmpc.apps.fitting.options import FitOptions
from koopmpc.base import checks, disk
from koopmpc.base.errors import DataError, LogError
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.data.episodes import Episodes
from koopmpc.data.files.load import load_episodes
from koopmpc.lifting.state import State
from koopmpc.synthesis.search.folds import usual_horizon

SHORT = "record more episodes, or longer ones"  # what to do where logs are too few
_TOP = {"horizon", "margin", "certify", "logs", "states", "inputs"}
_READING = {
    name for name, argument in signature(load_episodes).parameters.items() if argument.kind is Parameter.KEYWORD_ONLY
}
_STATE = {"reference", "weight", "limits", "angle"}
_INPUT = {"weight", "limits", "change", "change_weight"}


@dataclass(frozen=True, eq=False)
class Goal:
    """The task of a controller that is to be designed."""

    cost: Cost
    limits: Limits
    horizon: int
    reference: Float[np.ndarray, "..."]  # (nr,) or rows (T+1, nr) of the states that the cost weighs
    angles: tuple[int, ...]  # indices of states whose errors wrap
    margin: float | None = None  # share of loops on stand-ins that are to keep their limits; None: no promise
    certify: bool = False  # a certificate of stability is sought at the reference


_EVENED = "  # nobody asked for it: steps of the logs are unequal; states are interpolated to so many s, inputs held"


def write_template(data: Data, wished: FitOptions, say: Say) -> str:
    """Return the text of a goal file for the plant of some logs, with the ranges found and how the logs are read.

    `say` is called with what was understood of the logs: which columns are states and inputs, and what is wrong.
    """
    split = read_logs(data, wished.horizon, checks.generator(0), wished.list_reading(), SHORT)
    if not split.seen.nu:
        advice = "the logs have no input, so nothing can be controlled; pass --inputs u,v"
        raise DataError("\n".join([advice, *split.notes]))
    say(describe_data(split))
    both = split.seen.with_episodes([*split.seen, *split.held_out])
    evened = "resample" in split.reading and "resample" not in wished.list_reading()
    return format_template(both, horizon=wished.horizon, reading=split.reading, evened=evened)


def format_template(
    data: Episodes, *, horizon: int | None = None, reading: Mapping[str, Any] | None = None, evened: bool = False
) -> str:
    """Return the text of a goal file for these data: hold the medians of the last states, with inputs in their range.

    The weight of a state is 1 / (half its range)², so that errors as large as the data weigh alike; that of an input is
    a tenth of this. `reading` holds the keywords of `load_episodes` that the logs are to be read with again; with
    `evened` a comment says that nobody asked for its ``resample``.
    """
    X = np.concatenate([episode.X for episode in data])
    U = np.concatenate([episode.U for episode in data])
    horizon = usual_horizon(data)[0] if horizon is None else checks.count(horizon, "horizon")
    rest = np.median([episode.X[-1] for episode in data], axis=0)
    lines = [
        "# What the controller must do. Numbers are in the units of the names; inf means without limit.",
        "# koopmpc fit LOGS --goal this-file designs it, koopmpc check CONTROLLER says whether it keeps the goal.",
        "# References are medians of the last rows of the logs: change them to where the plant must rest or go.",
        "",
        "# A weight says what an error costs, per unit²: as written, half a range in any state costs 1. Twice the",
        "# weight of a state follows it more closely; twice that of an input, or a change_weight, calms the loop.",
        "# The horizon is not found from these data: it is as asked, or 20 steps, or fewer in short episodes. Set",
        "# about half of the time in which the closed loop is to settle; a shorter one sees limits and overshoot late.",
        "",
        f"horizon = {horizon}  # steps of {data.dt:g} s that the controller looks ahead",
        "# margin = 0.95  # share of loops on learned stand-ins that are to keep the limits; verified on fresh ones",
        "# certify = true  # seek a certificate of stability at the reference, from logs that the model has not seen",
    ]
    if reading:
        lines += ["", "[logs]  # how koopmpc fit reads them; an option such as --resample replaces the value here"]
        why = {"resample": _EVENED} if evened else {}
        lines += [f"{name} = {_format_toml(value)}{why.get(name, '')}" for name, value in reading.items()]
    for i, name in enumerate(data.states):
        low, high = X[:, i].min(), X[:, i].max()
        unit = _find_unit(name)
        lines += [
            "",
            f'[states."{_escape_text(name)}"]  # in the data from {low:.4g} to {high:.4g}',
            f"reference = {_format_number(rest[i])}  # [{unit}] target value; or a list, one value a step",
            f"weight = {_format_number(4 / max(high - low, 1e-12) ** 2)}  # of its squared error, per [{unit}]²; 0 for "
            "none",
            f"limits = [-inf, inf]  # [{unit}] kept wherever that is possible",
            "angle = false  # true where errors wrap at ±pi",
        ]
    for i, name in enumerate(data.inputs):
        low, high = U[:, i].min(), U[:, i].max()
        unit = _find_unit(name)
        lines += [
            "",
            f'[inputs."{_escape_text(name)}"]  # in the data from {low:.4g} to {high:.4g}',
            f"weight = {_format_number(0.4 / max(high - low, 1e-12) ** 2)}  # of its squared distance from the input "
            f"that holds the reference, per [{unit}]²",
            f"limits = [{_format_number(low)}, {_format_number(high)}]  # [{unit}] always kept",
            f"change = inf  # [{unit}] most change from step to step",
            f"change_weight = 0.0  # of its squared change, per [{unit}]²",
        ]
    return "\n".join(lines) + "\n"


def list_goal_inputs(path: str | PathLike[str]) -> tuple[str, ...]:
    """Return the names of the inputs that a goal file has sections for."""
    given = load_toml(Path(path)).get("inputs", {})
    return tuple(cast("dict[str, Any]", given)) if isinstance(given, dict) else ()


def load_reading(path: str | PathLike[str]) -> dict[str, Any]:
    """Return the keywords of `load_episodes` in the section [logs] of a goal file; none without such a section."""
    file = Path(path)
    given = load_toml(file).get("logs", {})
    if not isinstance(given, dict):
        raise DataError(f"{file}: logs is {given!r}; write a section [logs] with keys {', '.join(sorted(_READING))}")
    reading = cast("dict[str, Any]", given)
    _check_keys(reading, _READING, f"{file}: [logs]")
    return reading


def load_toml(file: Path) -> dict[str, Any]:
    """Return the content of a TOML file; a LogError where it is missing or no TOML."""
    disk.existing(file, "koopmpc fit LOGS --goal-template writes one")
    try:
        return tomllib.loads(file.read_text())
    except RecursionError as error:
        raise LogError(
            f"{file} nests its brackets too deep to be read; koopmpc fit LOGS --goal-template shows what is needed"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise LogError(f"{file} is not valid TOML: {error}; koopmpc fit LOGS --goal-template shows one") from error


def read_goal(path: str | PathLike[str], data: Episodes) -> Goal:
    """Return the goal in a file, for the plant of these data.

    Raises
    ------
    LogError
        The file is missing or no TOML.
    DataError
        An unknown key, name or unit, NaN, text in place of a number, limits that cross, lists of unequal lengths, or no
        state with a weight.
    """
    file = Path(path)
    tree = load_toml(file)
    if "coverage" in tree:
        raise DataError(f"{file}: coverage is called margin now; write margin = {tree['coverage']}")
    _check_keys(tree, _TOP, str(file))
    states = _find_sections(tree, "states", data.states, _STATE, file)
    inputs = _find_sections(tree, "inputs", data.inputs, _INPUT, file)
    Q, x_low, x_high, angles, rows = _read_states(states, data.states, file)
    R, R_delta, u_low, u_high, change = _read_inputs(inputs, data.inputs, file)
    tracked = [i for i in range(data.nx) if Q[i] > 0]
    if not tracked:
        raise DataError(f"{file} gives no state a weight above 0, so nothing is asked; set one")
    reference = _stack_references([rows[i] for i in tracked], file)
    horizon, certify = tree.get("horizon", usual_horizon(data)[0]), tree.get("certify", False)
    if not isinstance(horizon, int) or isinstance(horizon, bool) or horizon < 1:
        raise DataError(
            f"{file} gives a horizon of {horizon!r}; write a whole number of steps of {data.dt:g} s, 1 or more"
        )
    if certify not in (True, False):
        raise DataError(f"{file}: certify is {certify!r}; write true or false")
    margin = _read_number(tree, "margin", 0.0, str(file))
    if "margin" in tree and not 0 < margin < 1:
        raise DataError(f"{file}: margin is {margin:g}; write a share between 0 and 1, such as 0.95")
    of = State() if len(tracked) == data.nx else State([data.states[i] for i in tracked])
    limited = change if np.isfinite(change).any() else None
    return Goal(
        cost=Cost(Q=Q[tracked], R=R, R_delta=R_delta if R_delta.any() else None, of=of),
        limits=Limits(u_min=u_low, u_max=u_high, x_min=x_low, x_max=x_high, du_max=limited),
        horizon=horizon,
        reference=reference[0] if len(reference) == 1 else reference,
        angles=tuple(angles),
        margin=margin or None,
        certify=bool(certify),
    )


def _stack_references(rows: Sequence[Float[np.ndarray, "..."]], file: Path) -> Float[np.ndarray, "T nr"]:
    lengths = {len(np.atleast_1d(row)) for row in rows} - {1}
    if len(lengths) > 1:
        raise DataError(f"{file} has references of {sorted(lengths)} values; write lists of one length, or numbers")
    return np.column_stack([np.broadcast_to(row, max(lengths, default=1)) for row in rows])


SignalColumn = Float[np.ndarray, " n"]


def _read_states(
    sections: Sequence[Mapping[str, Any]], names: Sequence[str], file: Path
) -> tuple[SignalColumn, SignalColumn, SignalColumn, list[int], dict[int, Float[np.ndarray, "..."]]]:
    """Return weights, lower and upper limits, angles, and the reference of each state that has one."""
    Q, low, high = np.zeros(len(names)), np.full(len(names), -np.inf), np.full(len(names), np.inf)
    angles, rows = list[int](), dict[int, Float[np.ndarray, "..."]]()
    for i, (name, section) in enumerate(zip(names, sections, strict=True)):
        where = f"{file}, {name}"
        Q[i] = _read_number(section, "weight", 0.0, where)
        low[i], high[i] = _read_limits(section, where)
        if section.get("angle", False) not in (True, False):
            raise DataError(f"{where}: angle is {section['angle']!r}; write true or false")
        angles += [i] * bool(section.get("angle", False))
        if "reference" in section:
            rows[i] = checks.array(_check_numbers(section["reference"], f"{where}: reference"), f"{where}: reference")
        elif Q[i] > 0:
            raise DataError(f"{where} has a weight and no reference; give its target value, or set weight = 0")
    return Q, low, high, angles, rows


def _read_inputs(
    sections: Sequence[Mapping[str, Any]], names: Sequence[str], file: Path
) -> tuple[SignalColumn, SignalColumn, SignalColumn, SignalColumn, SignalColumn]:
    """Return weights, weights of changes, lower and upper limits, and limits of changes."""
    nu = len(names)
    R, R_delta, change = np.zeros(nu), np.zeros(nu), np.full(nu, np.inf)
    low, high = np.full(nu, -np.inf), np.full(nu, np.inf)
    for i, (name, section) in enumerate(zip(names, sections, strict=True)):
        where = f"{file}, {name}"
        R[i] = _read_number(section, "weight", 0.0, where)
        R_delta[i] = _read_number(section, "change_weight", 0.0, where)
        change[i] = _read_number(section, "change", np.inf, where)
        low[i], high[i] = _read_limits(section, where)
    return R, R_delta, low, high, change


def _find_sections(
    tree: Mapping[str, Any], what: str, names: tuple[str, ...], keys: set[str], file: Path
) -> list[Mapping[str, Any]]:
    """Return the section of each name, empty where there is none; refuse names and units that the data do not have."""
    given = tree.get(what, {})
    if not isinstance(given, dict):
        raise DataError(f'{file}: {what} is {given!r}; write a section for each, such as [{what}."{names[0]}"]')
    sections = cast("dict[str, Any]", given)
    for name, section in sections.items():
        where = f'{file}: [{what}."{name}"]'
        if name not in names:
            own = next((known for known in names if _drop_unit(known) == _drop_unit(name)), None)
            if own is not None:
                if _find_unit(own) == _find_unit(name) or "[" not in name:
                    raise DataError(f"{where} is not written as in the logs, which have {own!r}; write that")
                raise DataError(
                    f"{where} is in another unit than the logs, which have {own!r}; write its numbers in that"
                )
            raise DataError(
                f"{where} names nothing in the logs{checks.nearest(name, names)}; there are {', '.join(names)}"
            )
        if not isinstance(section, dict):
            raise DataError(f"{where} is {section!r}; write it as a section with keys {', '.join(sorted(keys))}")
        _check_keys(cast("dict[str, Any]", section), keys, where)
    return [cast("Mapping[str, Any]", sections.get(name, {})) for name in names]


def _check_keys(tree: Mapping[str, Any], keys: set[str], where: str) -> None:
    for key in tree:
        if key not in keys:
            raise DataError(f"{where} has {key!r}{checks.nearest(key, keys)}; there are {', '.join(sorted(keys))}")


def _read_number(section: Mapping[str, Any], key: str, default: float, where: str) -> float:
    value = section.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value) or value < 0:
        raise DataError(f"{where}: {key} is {value!r}; write a number of 0 or above")
    return float(value)


def _read_limits(section: Mapping[str, Any], where: str) -> tuple[float, float]:
    value = _check_numbers(section.get("limits", [-math.inf, math.inf]), f"{where}: limits")
    if not isinstance(value, list) or len(value) != 2:
        raise DataError(f"{where}: limits is {value!r}; write [low, high], with -inf or inf where there is none")
    low, high = value
    if low > high:
        raise DataError(f"{where}: limits {low:g} … {high:g} cross; write the lower one first")
    return low, high


def _check_numbers(value: Any, where: str) -> float | list[float]:
    """Return a number, or a list of numbers."""
    many = cast("list[Any]", value) if isinstance(value, list) else [value]
    for one in many:
        if isinstance(one, bool) or not isinstance(one, int | float) or math.isnan(one):
            raise DataError(f"{where} is {value!r}; write a number, or a list of numbers")
    return [float(one) for one in many] if isinstance(value, list) else float(value)


def _drop_unit(name: str) -> str:
    return name.partition("[")[0].strip().lower()


def _find_unit(name: str) -> str:
    return name.partition("[")[2].rstrip("] ") or "1"


def _escape_text(name: str) -> str:
    return name.replace("\\", "\\\\").replace('"', '\\"')


def _format_toml(value: Any) -> str:
    """Return a number, a text, a sequence or a mapping of these as TOML."""
    if isinstance(value, bool | int | float):
        return repr(value).lower()
    if isinstance(value, str):
        return f'"{_escape_text(value)}"'
    if isinstance(value, Mapping):
        table = cast("Mapping[str, Any]", value)
        pairs = (f'"{_escape_text(key)}" = {_format_toml(item)}' for key, item in table.items())
        return f"{{ {', '.join(pairs)} }}"
    return f"[{', '.join(map(_format_toml, value))}]"


def _format_number(value: float) -> str:
    """Return three digits as TOML writes a float."""
    text = f"{float(value):.3g}"
    return text if any(letter in text for letter in ".en") else f"{text}.0"
