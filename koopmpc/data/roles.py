"""What the columns of a user's table are: time, episode, states, inputs; by what is told and by their names."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from koopmpc.errors import DataError

_TIME = re.compile(r"t|time|timestamp|sim_time|elapsed|seconds")
_EPISODE = re.compile(r"episode|run|trial|trajectory")
_INPUT = re.compile(
    r"u\d*|u_.*|(input|inputs|control|command|cmd|action|force|torque|thrust|voltage|steering|throttle|duty)"
    r"([\W_\d].*)?|.*_(cmd|command|input|ref_input)"
)
_DISTURBANCE = re.compile(r"w\d*|w_.*|disturbance([\W_\d].*)?")
_PER_SECOND = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0}


@dataclass(frozen=True)
class Roles:
    """The columns of a table by what they are; `scale` is the time's unit in seconds."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    disturbances: tuple[str, ...]
    time: str | None
    scale: float
    episode: str | None
    step: str | None
    guessed: bool

    @property
    def values(self) -> tuple[str, ...]:
        """Names of states, inputs and disturbances."""
        return self.states + self.inputs + self.disturbances


def roles(
    names: Sequence[str],
    where: str,
    *,
    states: Sequence[str] | None,
    inputs: Sequence[str] | None,
    disturbances: Sequence[str] | None,
    numeric: Sequence[str],
) -> Roles:
    """Return what each column is.

    What is not told is read from the names: ``t``, ``time [s]`` and ``timestamp`` are time; ``episode``, ``run``,
    ``trial`` and ``trajectory`` number the episodes; ``u``, ``u0``, ``u_left``, and what begins with input, control,
    command, cmd, action, force, torque, thrust, voltage, steering, throttle or duty, are inputs; ``w``, ``w0`` and
    ``disturbance`` are measured disturbances; every other column of numbers is a state.

    Parameters
    ----------
    names, numeric
        All columns, and those of numbers.
    where
        The file, for messages.
    states, inputs, disturbances
        What is told.

    Raises
    ------
    DataError
        A told column is missing or there twice, or no column is left for a state.
    """
    for what, given in (("states", states), ("inputs", inputs), ("disturbances", disturbances)):
        if isinstance(given, str):
            raise DataError(f"{what} is {given!r}; pass a tuple of names")
        for name in given or ():
            if names.count(name) != 1:
                has = "has two columns" if name in names else "has no column"
                raise DataError(f"{where} {has} {name!r}; its columns are {', '.join(names)}")
    told = {name for given in (states, inputs, disturbances) for name in given or ()}
    rest = [name for name in dict.fromkeys(names) if names.count(name) == 1 and name not in told]
    time = next((name for name in rest if _TIME.fullmatch(_stem(name))), None)
    episode = next((name for name in rest if _EPISODE.fullmatch(_stem(name))), None)
    step = next((name for name in rest if name == "step"), None)
    free = [name for name in rest if name not in (time, episode, step) and name in numeric]
    if any(names.count(name) > 1 for name in numeric) and (states is None or inputs is None):
        twice = next(name for name in numeric if names.count(name) > 1)
        raise DataError(f"{where} has two columns {twice!r}; rename one")
    found_inputs = [n for n in free if _INPUT.fullmatch(_stem(n))] if inputs is None else list(inputs)
    pushes = [n for n in free if _DISTURBANCE.fullmatch(_stem(n)) and n not in found_inputs]
    found_pushes = (pushes if states is None else []) if disturbances is None else list(disturbances)
    if states is None:
        taken = {*found_inputs, *found_pushes}
        found_states = [name for name in free if name not in taken]
    else:
        found_states = list(states)
    if not found_states:
        raise DataError(
            f"{where} has no column that could be a state: its columns are {', '.join(names)}; pass states="
        )
    unit = "s" if time is None else _unit(time)
    if unit not in _PER_SECOND:
        raise DataError(
            f"{where}: the unit of {time!r} is not one of {', '.join(_PER_SECOND)}; rename it, or pass dt="
        )
    return Roles(
        tuple(found_states),
        tuple(found_inputs),
        tuple(found_pushes),
        time,
        _PER_SECOND[unit],
        episode,
        step,
        guessed=states is None or inputs is None,
    )


def label(name: str) -> bool:
    """Return whether a column of this name tells rows or episodes apart, and so need not hold numbers."""
    return _TIME.fullmatch(_stem(name)) is not None or _EPISODE.fullmatch(_stem(name)) is not None


def _stem(name: str) -> str:
    """Return the name without its unit, in lower case."""
    return re.split(r"\s*[\[(]", name)[0].strip().lower()


def _unit(name: str) -> str:
    found = re.search(r"[\[(]([^\])]*)[\])]", name)
    return found.group(1).strip() if found else "s"
