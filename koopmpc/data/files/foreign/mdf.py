# pyright: basic
"""Measurement data format of the automotive industry (.mf4, .mdf, .dat versions 3 and 4), read through asammdf."""

import ast
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import KoopmpcError, LogError
from koopmpc.data.files.formats import Channel, LogFormat, Recording, Samples, register_format
from koopmpc.data.files.recording import split_recording

EXTRA = "mdf"
_STEP = 100_000  # records that are read at once
_LONGEST = 1000  # characters of a formula; a conversion is one short line
_NAMES = {"inf": np.inf, "nan": np.nan, "pi": np.pi}  # asammdf turns each x into X, so case says nothing
_FUNCTIONS: dict[str, tuple[int, Callable[..., np.ndarray]]] = {  # name: number of arguments, function
    **{name: (1, getattr(np, name)) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "log10")},
    **{name: (1, getattr(np, name)) for name in ("sqrt", "abs", "floor", "ceil", "arcsin", "arccos", "arctan")},
    **{"asin": (1, np.arcsin), "acos": (1, np.arccos), "atan": (1, np.arctan), "ln": (1, np.log)},
    **{"pow": (2, np.power), "atan2": (2, np.arctan2), "arctan2": (2, np.arctan2)},
}
_OPERATORS: dict[type[ast.AST], Callable[..., np.ndarray]] = {
    **{ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.power},
    **{ast.UAdd: np.positive, ast.USub: np.negative},
}

Values = Float[np.ndarray, "*n"]


class MDFRecording(Recording):
    """The channels of numbers of an MDF file; a name that stands in several groups is ``name (group 2)`` there.

    asammdf runs the text of algebraic conversions as Python. Here such channels are read raw and converted by
    `read_formula`; a file with any other formula is refused before a value is read.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        with self._opened() as mdf:
            self._formulas = _read_formulas(mdf, file)
            found = list(self._find_channels(mdf))
            repeated = Counter(name for name, *_ in found)
            titles = [f"{name} (group {place[0]})" if repeated[name] > 1 else name for name, *_, place in found]
            self._places = {title: place for title, (*_, place) in zip(titles, found, strict=True)}
            self._channels = tuple(Channel(title, *of[1:3]) for title, of in zip(titles, found, strict=True))
            groups = {place[0]: count for _, _, count, place in found}
            ends = [self._read_time(mdf, g, k) for g, count in groups.items() for k in (0, count - 1)]
        self._span = (min(ends), max(ends)) if ends else (0.0, 0.0)

    def _find_channels(self, mdf: Any) -> Iterator[tuple[str, str, int, tuple[int, int]]]:
        """Yield name, unit, number of samples, and (group, index) of each channel of numbers with a clock."""
        for g, group in enumerate(mdf.groups):
            cycles, master = int(group.channel_group.cycles_nr), mdf.masters_db.get(g)
            if master is None or cycles == 0:
                continue
            for c, channel in enumerate(group.channels):
                if c != master:
                    head = self._read(mdf, (g, c), 0, 1)
                    if head.samples.dtype.kind in "fiub" and head.samples.ndim == 1:
                        yield str(channel.name), str(head.unit or ""), cycles, (g, c)

    def channels(self) -> tuple[Channel, ...]:
        """Return the channels of numbers."""
        return self._channels

    def span(self) -> tuple[float, float]:
        """Return the first and the last time [s]."""
        return self._span

    def read(
        self, names: Sequence[str], begin: float = -np.inf, end: float = np.inf, count: int | None = None
    ) -> list[Samples]:
        """Return times and values of channels between two times."""
        counts = {channel.name: channel.count for channel in self._channels}
        found: list[Samples] = []
        with self._opened() as mdf:
            stretches: dict[int, list[int]] = {}
            for name in names:
                group, index = self._places[name]
                if group not in stretches:
                    time = partial(self._read_time, mdf, group)
                    ends = {-np.inf: 0, np.inf: counts[name]}  # without a look into the file
                    stretches[group] = [
                        ends[edge] if edge in ends else bisect_left(range(counts[name]), edge, key=time)
                        for edge in (begin, end)
                    ]
                first, last = stretches[group]
                last = last if count is None else min(last, first + count)
                formula = self._formulas.get((group, index), np.asarray)
                times, values = [np.zeros(0)], [np.zeros(0)]
                for start in range(first, last, _STEP):
                    signal = self._read(mdf, (group, index), start, min(_STEP, last - start))
                    times.append(np.asarray(signal.timestamps, dtype=np.float64))
                    values.append(formula(np.asarray(signal.samples, dtype=np.float64)))
                found.append((np.concatenate(times), np.concatenate(values)))
        return found

    def _read(self, mdf: Any, place: tuple[int, int], first: int, count: int) -> Any:
        """Return records of a channel; one with a formula is read raw, so that asammdf does not run it."""
        raw = place in self._formulas
        return mdf.get(group=place[0], index=place[1], record_offset=first, record_count=count, raw=raw)

    def _read_time(self, mdf: Any, group: int, record: int) -> float:
        place = next(place for place in self._places.values() if place[0] == group)
        return float(self._read(mdf, place, record, 1).timestamps[0])

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        from asammdf import MDF

        try:
            # of a path asammdf reads whole channels; for logs of buses it converts channels before anything is checked
            options: Any = {"process_bus_logging": False}
            with self.file.open("rb") as stream, MDF(stream, **options) as mdf:
                yield mdf
        except (KoopmpcError, ModuleNotFoundError):
            raise
        except Exception as error:  # asammdf raises what it stumbles over: MdfException, struct.error, KeyError, …
            _complete_unfinished(error)
            raise LogError(f"{self.file} cannot be read as MDF: {error}; take another copy") from error


def _complete_unfinished(error: BaseException) -> None:
    """Give objects whose constructor raised this error the parts that their finalizer deletes, or it complains."""
    trace = error.__traceback__
    while trace is not None:
        made: Any = trace.tb_frame.f_locals.get("self")
        if type(made).__name__ in ("MDF3", "MDF4"):
            vars(made).setdefault("header", None)
            vars(made).setdefault("identification", None)
        trace = trace.tb_next


def _read_formulas(mdf: Any, file: Path) -> dict[tuple[int, int], Callable[[np.ndarray], np.ndarray]]:
    """Return the formulas of channels by (group, channel)."""
    formulas: dict[tuple[int, int], Callable[[np.ndarray], np.ndarray]] = {}
    for g, group in enumerate(mdf.groups):
        for c, channel in enumerate(group.channels):
            conversion = channel.conversion
            text = _find_formula(conversion)
            nested = any(map(_has_formula, _list_inner(conversion)))
            if nested or (text is not None and c == mdf.masters_db.get(g)):
                where = "inside another conversion" if nested else "for the time of its group"
                raise LogError(
                    f"{file}: channel {channel.name!r} has a formula {where}, which is not computed; export the log "
                    "with converted values"
                )
            if text is not None:
                try:
                    formulas[g, c] = read_formula(text, channel.name)
                except LogError as error:
                    raise LogError(f"{file}: {error}") from error
    return formulas


def _find_formula(conversion: Any) -> str | None:
    """Return the text of an algebraic conversion, of MDF 4 or 3; else None."""
    text = getattr(conversion, "formula", None)
    return text.replace("eX1p", "exp") if text else None  # asammdf writes X1 for each x of a formula in MDF 3


def _list_inner(conversion: Any) -> list[Any]:
    """Return the conversions that a table of values refers to, instead of texts."""
    return [block for block in (getattr(conversion, "referenced_blocks", None) or {}).values() if block is not None]


def _has_formula(conversion: Any) -> bool:
    return _find_formula(conversion) is not None or any(map(_has_formula, _list_inner(conversion)))


def read_formula(text: str, channel: str) -> Callable[[Values], Values]:
    """Return the function X → value of a conversion's formula, as MDF's standard writes it.

    A formula has numbers, ``X`` or ``X1``, + − * / and the power ^ or ``**``, parentheses, and functions such as
    ``sqrt``, ``exp``, ``log`` and ``sin``.
    """
    try:
        if len(text) > _LONGEST:
            raise ValueError(f"it has {len(text)} characters")
        formula = _build(ast.parse(text.strip().replace("^", "**"), mode="eval").body)
    except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError) as error:
        reason = error.args[0] if isinstance(error, ValueError) else "the text cannot be parsed"
        raise LogError(
            f"channel {channel!r} is converted by the formula {text[:60]!r}, which is not computed: {reason}; export "
            "the log with converted values, for only arithmetic of X and functions such as sqrt and log are computed"
        ) from error

    def convert(raw: Values) -> Values:
        with np.errstate(all="ignore"):
            return np.broadcast_to(formula(np.asarray(raw, dtype=np.float64)), raw.shape).copy()

    return convert


def _build(node: ast.AST) -> Callable[[Values], Values]:
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            number = np.array(float(value))
            return lambda _: number
        case ast.Name(id="X" | "X1"):
            return lambda x: x
        case ast.Name(id=name) if name.lower() in _NAMES:
            named = np.array(_NAMES[name.lower()])
            return lambda _: named
        case ast.UnaryOp(op=sign, operand=operand) if type(sign) in _OPERATORS:
            apply, arguments = _OPERATORS[type(sign)], [_build(operand)]
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _OPERATORS:
            apply, arguments = _OPERATORS[type(sign)], [_build(left), _build(right)]
        case ast.Call(func=ast.Name(id=name), args=operands, keywords=[]) if name.lower() in _FUNCTIONS:
            count, apply = _FUNCTIONS[name.lower()]
            if len(operands) != count:
                raise ValueError(f"{name.lower()} takes {count} number{'s' * (count > 1)}")
            arguments = [_build(operand) for operand in operands]
        case _:
            raise ValueError(f"it holds {ast.unparse(node)[:30]!r}")
    return lambda x: apply(*(argument(x) for argument in arguments))


register_format(LogFormat((".mf4", ".mdf"), MDFRecording, parts=partial(split_recording, MDFRecording), extra=EXTRA))
