"""Roles of a table's columns: time, episode, states, inputs and disturbances, as given or as their names say."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from koopmpc.base import checks
from koopmpc.base.errors import DataError

_EPISODE = re.compile(r"episode|run|trial|trajectory")
_DISTURBANCE = re.compile(r"w\d*|w_.*|disturbance([\W_\d].*)?")
_PER_SECOND = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_WORD = re.compile(r"[^\W\d_]+")

_CLOCKS = {"t", "ts", "time", "timestamp", "elapsed", "seconds"}  # a name is of time if it has one of these words …
_OF_CLOCKS = {"sim", "sampling", "sample", "system", "log", "local"}  # … and besides it only these
_COMMANDS = {"input", "inputs", "command", "cmd", "action", "excitation", "actuation"}  # inputs of any quantity
_QUANTITIES = {
    *("u", "control", "actuator", "manipulated", "force", "torque", "thrust", "voltage", "current", "power", "duty"),
    *("pwm", "throttle", "steering", "rudder", "aileron", "flap", "pedal", "brake"),
}  # inputs unless the name has a word of _MEASURED
_ACTUATORS = {"valve", "heater", "pump", "motor", "fan", "drive", "compressor"}  # the same, for a device's own name
_MEASURED = {
    *("output", "measured", "measurement", "sensor", "actual", "feedback", "estimated", "response", "error"),
    *("temperature", "temp", "speed", "velocity", "acceleration", "position", "displacement", "pressure", "level"),
    *("height", "flow", "concentration", "frequency", "vibration", "battery", "capacitor", "status", "state"),
}  # a signal of a device that does not drive it: "motor speed", "output voltage"
_TARGETS = {"setpoint", "reference", "ref", "target", "desired", "sp"}  # what a controller is asked for


@dataclass(frozen=True)
class TableSettings:
    """The caller's knowledge of a table; None is inferred from the table.

    `columns` names all columns, for a table without a line of names, or maps names in the log to the names to use.
    """

    dt: float | None = None
    states: Sequence[str] | None = None
    inputs: Sequence[str] | None = None
    disturbances: Sequence[str] | None = None
    resample: float | None = None
    columns: Sequence[str] | Mapping[str, str] | None = None

    def __post_init__(self) -> None:
        for name in ("dt", "resample"):
            if getattr(self, name) is not None:
                checks.positive(getattr(self, name), name, "s")
        if isinstance(self.columns, str):
            raise DataError(f"columns is {self.columns!r}; pass a tuple of names")

    @property
    def nothing(self) -> bool:
        """True where the caller gives nothing."""
        return all(value is None for value in vars(self).values())

    def rename(self, names: Sequence[str], where: str) -> list[str]:
        """Return the names of all columns after `columns`; a mapped name without a unit keeps that of the old one."""
        if self.columns is None:
            return list(names)
        if not isinstance(self.columns, Mapping):
            if len(self.columns) != len(names):
                raise DataError(
                    f"{where} has {len(names)} columns, columns= gives {len(self.columns)} names; pass one for each"
                )
            return list(map(str, self.columns))
        stems, renamed = [drop_unit(name) for name in names], list(names)
        for old, new in self.columns.items():
            at = [i for i, name in enumerate(names) if name == old]
            at = at or [i for i, stem in enumerate(stems) if stem == drop_unit(old)]
            if len(at) != 1:
                has = "has two columns" if at else "has no column"
                raise DataError(f"{where} {has} {old!r} to rename; its columns are {', '.join(names)}")
            unit = re.search(r"\s*[\[(][^\])]*[\])]$", names[at[0]])
            renamed[at[0]] = new if unit is None or "[" in new else f"{new}{unit.group(0)}"
        return renamed

    def match_names(self, names: Sequence[str]) -> "TableSettings":
        """Return the copy with names as the table writes them.

        ``"pump"`` means ``"pump [V]"``, and ``"2"`` the second column, where no other column has this name.
        """
        stems = [drop_unit(name) for name in names]

        def match_name(name: str) -> str:
            if name in names:
                return name
            if stems.count(name.strip().lower()) == 1:
                return names[stems.index(name.strip().lower())]
            number = int(name) if name.strip().isdecimal() else 0
            return names[number - 1] if 1 <= number <= len(names) else name

        given = {
            what: tuple(map(match_name, map(str, some)))
            for what, some in self.roles.items()
            if not isinstance(some, str)
        }
        return replace(self, **given)

    @property
    def roles(self) -> dict[str, Sequence[str]]:
        """The names that the caller gives, by their role."""
        every = {"states": self.states, "inputs": self.inputs, "disturbances": self.disturbances}
        return {what: some for what, some in every.items() if some is not None}

    @property
    def named(self) -> set[str]:
        """The columns that the caller names."""
        return {name for some in self.roles.values() for name in some}


@dataclass(frozen=True)
class ColumnRoles:
    """The role of each column of a table.

    `scale` is the unit of the time column in seconds; `targets` are set points, which do not belong to the plant.
    `guessed` says that names alone tell states or inputs.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    disturbances: tuple[str, ...]
    time: str | None
    scale: float
    episode: str | None
    step: str | None
    targets: tuple[str, ...]
    guessed: bool

    @property
    def values(self) -> tuple[str, ...]:
        """Names of states, inputs and disturbances."""
        return self.states + self.inputs + self.disturbances


def find_roles(
    names: Sequence[str],
    numeric: Sequence[str],
    told: TableSettings,
    where: str,
    driving: Sequence[str] | None = None,
    clock: str | None = None,
) -> ColumnRoles:
    """Return the role of each column.

    Roles that the caller does not give are read from the words of the names. ``t``, ``time [s]``, ``sampling_time`` and
    ``timestamp`` are time; ``episode``, ``run``, ``trial`` and ``trajectory`` number the episodes; `is_input` says
    which are inputs; ``w``, ``w0`` and ``disturbance`` are measured disturbances; a set point is left out;
    every other column of numbers is a state.

    Parameters
    ----------
    names, numeric
        All columns, and those of numbers.
    told
        The names that the caller gives; None leaves the role to the names.
    where
        The file, for messages.
    driving
        The columns that drive the plant, where the form of the table tells them; None leaves this to the names.
    clock
        The column of time where no name tells it.

    Raises
    ------
    DataError
        A given column is missing or stands twice, or no column is left for a state.
    """
    _require_columns(names, numeric, told, where)
    single = [name for name in dict.fromkeys(names) if names.count(name) == 1 and name not in told.named]
    time, episode, step = (next(filter(is_it, single), None) for is_it in (is_clock, is_episode, "step".__eq__))
    time = clock if time is None and clock in single else time
    free = [name for name in single if name not in (time, episode, step) and name in numeric]
    guessed = driving is None and None in (told.states, told.inputs)
    targets = tuple(filter(is_target, free)) if guessed else ()
    free = [name for name in free if name not in targets]
    states, inputs, disturbances = _fill_roles(free, told, driving)
    if not states:
        raise DataError(
            f"{where} has no column that could be a state: its columns are {', '.join(names)}; pass states="
        )
    return ColumnRoles(
        states,
        inputs,
        disturbances,
        time,
        1.0 if time is None else _find_scale(time, where),
        episode,
        step,
        targets if told.states is None else (),
        guessed=guessed,
    )


def _fill_roles(
    free: Sequence[str], told: TableSettings, driving: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Return states, inputs and disturbances: as the caller gives them, else those of these columns by their names."""
    may_drive = free if driving is None else [name for name in free if name in driving]
    pushes = list(filter(is_disturbance, may_drive))
    states, inputs, disturbances = told.states, told.inputs, told.disturbances
    if inputs is None:
        inputs = _pick_inputs(free) if driving is None else [name for name in may_drive if name not in pushes]
    if disturbances is None:
        disturbances = [name for name in pushes if name not in inputs and states is None]
    if states is None:
        states = [name for name in free if name not in (*inputs, *disturbances)]
    return tuple(states), tuple(inputs), tuple(disturbances)


def _require_columns(names: Sequence[str], numeric: Sequence[str], told: TableSettings, where: str) -> None:
    """Raise where a column that the caller names, or that a guess needs, is missing or stands twice."""
    for what, given in told.roles.items():
        if isinstance(given, str):
            raise DataError(f"{what} is {given!r}; pass a tuple of names")
        for name in given:
            if names.count(name) != 1:
                has = "has two columns" if name in names else "has no column"
                raise DataError(f"{where} {has} {name!r}; its columns are {', '.join(names)}")
    twice = next((name for name in numeric if names.count(name) > 1), None)
    if twice is not None and None in (told.states, told.inputs):
        raise DataError(f"{where} has two columns {twice!r}; rename one")


def _find_scale(time: str, where: str) -> float:
    """Return the unit of a column of time in seconds."""
    found = re.search(r"[\[(]([^\])]*)[\])]", time)
    unit = found.group(1).strip() if found else "s"
    if unit not in _PER_SECOND:
        raise DataError(f"{where}: the unit of {time!r} is not one of {', '.join(_PER_SECOND)}; rename it, or pass dt=")
    return _PER_SECOND[unit]


def is_input(name: str) -> bool:
    """Return whether the words of a column's name say that it drives the plant.

    A word for a command always says so (``speed command``). A word for a driving quantity or for an actuator says so
    (``pump voltage``, ``valve [%]``, ``u_left``) unless another word names a measurement (``motor speed``, ``output
    voltage``). A set point does not count as an input.
    """
    words = _list_words(name)
    if words & _COMMANDS:
        return not words & (_TARGETS - {"ref", "reference"})
    return bool(words & (_QUANTITIES | _ACTUATORS)) and not words & _MEASURED and not is_target(name)


def _pick_inputs(names: Sequence[str]) -> list[str]:
    """Return the inputs among these columns; a bare current or power is one only where there is no other.

    Beside a voltage the current of a motor is a state.
    """
    inputs = [name for name in names if is_input(name)]
    sure = [name for name in inputs if not _may_be_state(name)]
    return sure or inputs


def _may_be_state(name: str) -> bool:
    words = _list_words(name)
    return not words & _COMMANDS and ("current" in words or ("power" in words and not words & _ACTUATORS))


def is_target(name: str) -> bool:
    """Return whether the words of a column's name say that it is a set point of a controller."""
    words = _list_words(name)
    return bool(words & _TARGETS or {"set", "point"} <= words) and not words & _COMMANDS


def is_clock(name: str) -> bool:
    """Return whether a column's name says that it holds the time of its rows."""
    words = _list_words(name)
    return bool(words & _CLOCKS) and words <= _CLOCKS | _OF_CLOCKS and not re.search(r"\d", drop_unit(name))


def is_episode(name: str) -> bool:
    """Return whether a column's name says that it tells episodes apart."""
    return _EPISODE.fullmatch(drop_unit(name)) is not None


def is_disturbance(name: str) -> bool:
    """Return whether a column's name says that it is a measured disturbance."""
    return _DISTURBANCE.fullmatch(drop_unit(name)) is not None


def drop_unit(name: str) -> str:
    """Return the name without its unit, in lower case."""
    return re.split(r"\s*[\[(]", name)[0].strip().lower()


def _list_words(name: str) -> set[str]:
    """Return the words of a name without its unit, in lower case: ``"pumpVoltage_2 [V]"`` has pump and voltage."""
    stem = re.split(r"\s*[\[(]", name)[0]
    return {word.lower() for word in _WORD.findall(re.sub(r"(?<=[a-z])(?=[A-Z])", " ", stem))}
