# pyright: basic
"""Files of Functional Mock-up Units: what a unit says about its variables, and FMPy, which reads and loads it."""

import re
import struct
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.disk import path_of
from koopmpc.base.errors import DataError, KoopmpcError, LogError, install

Interface = Literal["model exchange", "co-simulation"]
INTERFACES: Mapping[Interface, str] = {"model exchange": "modelExchange", "co-simulation": "coSimulation"}
StartValue = float | int | bool | str

_REAL = ("Real", "Float64")  # types of the variables that koopmpc moves and measures: FMI 2's, FMI 3's
_OPENING = 10_000  # bytes at the head of a description in which its version stands
_FREE = ("exact", "approx")  # `initial` of variables that may be set before the initialisation
_SETTABLE = ("parameter", "structuralParameter", "input")  # causalities that may be set whatever their `initial`


def import_fmpy() -> ModuleType:
    """Return FMPy, the library that reads model descriptions and calls co-simulation units.

    Raises
    ------
    ImportError
        It is not installed.
    """
    try:
        import fmpy
        import fmpy.simulation
    except ImportError as error:
        raise ImportError(f"km.plants.fmu needs FMPy, which is not installed: {install('fmu')}") from error
    return fmpy


@dataclass(frozen=True)
class UnitVariable:
    """A variable of a unit: its name, type, number, unit, limits and start value."""

    name: str
    kind: str
    reference: int
    unit: str
    low: float
    high: float
    start: float
    is_settable: bool
    is_array: bool

    @property
    def label(self) -> str:
        """The name with the unit: ``"theta [rad]"``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True)
class UnitDescription:
    """What a unit's modelDescription.xml says; `source` is the same as FMPy's object.

    `states` are the variables whose derivatives are variables too, `events` counts event indicators.
    """

    path: Path
    source: Any
    interface: Interface
    version: int
    variables: Mapping[str, UnitVariable]
    inputs: tuple[UnitVariable, ...]
    outputs: tuple[UnitVariable, ...]
    states: tuple[UnitVariable, ...]
    step_size: float | None
    events: int

    @property
    def file(self) -> str:
        """Name of the file, for messages."""
        return self.path.name

    def find(self, name: str, what: str) -> UnitVariable:
        """Return the variable of this name; the unit in brackets may be left out.

        Raises
        ------
        DataError
            The unit has no such variable.
        """
        bare = name.split(" [")[0]
        if bare not in self.variables:
            near = get_close_matches(bare, self.variables, n=3) or list(self.variables)[:8]
            raise DataError(f"{what} names {name!r}, a variable that {self.file} lacks; it has {', '.join(near)}")
        return self.variables[bare]

    def choose(self, names: Sequence[str], what: str) -> tuple[UnitVariable, ...]:
        """Return variables by name; all of them must be real numbers."""
        found = tuple(self.find(name, what) for name in names)
        require_numbers(found, what, self.file)
        return found


def require_numbers(variables: Iterable[UnitVariable], what: str, file: str) -> None:
    """Raise where a variable does not hold a single real number."""
    for each in variables:
        if each.kind not in _REAL or each.is_array:
            got = f"an array of {each.kind}" if each.is_array else each.kind
            raise DataError(
                f"{what} holds {each.name} of {file}, which is {got}; koopmpc moves and measures single variables of "
                "type Real (FMI 2) or Float64 (FMI 3): name others, or give it a fixed value by start_values"
            )


def collect_limits(variables: Sequence[UnitVariable]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the least and the greatest values that the unit declares, ±inf where it declares none."""
    return np.array([each.low for each in variables]), np.array([each.high for each in variables])


def read_description(path: str | Path, interface: str | None) -> UnitDescription:
    """Return what the unit says about itself, after a check of the file.

    Raises
    ------
    LogError
        The file is missing, no zip, holds a path that leaves its folder, or its description cannot be read.
    DataError
        The unit is FMI 1, lacks the interface, or holds no binary for this platform.
    """
    if interface is not None and not checks.among(interface, INTERFACES):
        raise DataError(f'interface is {interface!r}; pass "model exchange" or "co-simulation"')
    fmpy, place = import_fmpy(), path_of(path, "pass the path of an .fmu file")
    names = _check_archive(place)
    try:
        with zipfile.ZipFile(place) as archive:
            opening = archive.read("modelDescription.xml")[:_OPENING]
        if re.search(rb"""fmiVersion\s*=\s*["']1""", opening):
            raise DataError(f"{place.name} is FMI 1.0; koopmpc loads FMI 2 and 3: export the model in one of these")
        source = fmpy.read_model_description(str(place), validate=False)  # CasADi, for one, leaves units undefined
        return _read_source(fmpy, source, place, names, interface)
    except KoopmpcError:
        raise
    except Exception as error:  # FMPy raises bare Exceptions, lxml and zipfile their own, a damaged text any
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        raise LogError(f"the modelDescription.xml of {place.name} cannot be read: {reason}") from error


def _read_source(
    fmpy: ModuleType, source: Any, place: Path, names: list[str], interface: str | None
) -> UnitDescription:
    """Return what FMPy read of a unit, in our words."""
    version = int(source.fmiVersion[0])
    chosen = _choose_interface(source, place.name, interface)
    _require_binary(fmpy, names, getattr(source, INTERFACES[chosen]).modelIdentifier, version, place.name)
    variables = {each.name: _read_variable(each) for each in source.modelVariables}
    by_cause: dict[str, list[UnitVariable]] = {"input": [], "output": []}
    for each in source.modelVariables:
        if each.causality in by_cause and variables[each.name].kind in _REAL:
            by_cause[each.causality].append(variables[each.name])
    states = [each.derivative.name for each in source.modelVariables if each.derivative is not None]
    step = None if source.defaultExperiment is None else source.defaultExperiment.stepSize
    return UnitDescription(
        place.resolve(), source, chosen, version, variables,
        tuple(by_cause["input"]), tuple(by_cause["output"]), tuple(variables[name] for name in states),
        None if step is None else float(step), int(source.numberOfEventIndicators or 0),
    )  # fmt: skip


def _check_archive(path: Path) -> list[str]:
    """Return the names in the zip; raise where it is not a zip file, or a name leads out of the folder."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except FileNotFoundError as error:
        raise LogError(f"there is no file {path}; pass the path of an .fmu file") from error
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError, struct.error) as error:
        raise LogError(f"{path} is no .fmu file: it cannot be read as a zip archive ({error})") from error
    for name in names:
        parts = PurePosixPath(name)
        if parts.is_absolute() or ".." in parts.parts or "\\" in name or ":" in name:
            raise LogError(f"{path.name} holds the path {name!r}, which leaves the unit's folder; nothing was unpacked")
    if "modelDescription.xml" not in names:
        raise LogError(f"{path.name} holds no modelDescription.xml; pass an .fmu file")
    return names


def _choose_interface(source: Any, file: str, interface: str | None) -> Interface:
    """Return the interface to load: model exchange where the unit has it and no events, else co-simulation."""
    known: list[Interface] = [each for each, name in INTERFACES.items() if getattr(source, name) is not None]
    if not known:
        raise DataError(f"{file} offers neither model exchange nor co-simulation; export it with one of these")
    if interface is None:
        return known[-1] if source.numberOfEventIndicators else known[0]
    if interface not in known:
        raise DataError(f'{file} offers no {interface}; pass interface="{known[0]}"')
    return cast("Interface", interface)


def _require_binary(fmpy: ModuleType, names: list[str], identifier: str, version: int, file: str) -> None:
    """Raise where the unit holds no machine code for this platform."""
    folder = fmpy.platform if version == 2 else fmpy.platform_tuple
    if f"binaries/{folder}/{identifier}{fmpy.sharedLibraryExtension}" in names:
        return
    held = sorted({PurePosixPath(name).parts[1] for name in names if name.startswith("binaries/") and name[-1] != "/"})
    sources = any(name.startswith("sources/") and name.endswith(".c") for name in names)
    advice = "compile its C sources by `fmpy compile FILE`" if sources else f"export the model for {folder}"
    others = f", only for {', '.join(held)}" if held else ""
    raise DataError(f"{file} holds no binary for {folder}{others}; {advice}")


def _read_variable(each: Any) -> UnitVariable:
    """Return what the description says about a variable; unit and limits may stand in its declared type."""

    def stated(name: str) -> Any:
        own = getattr(each, name)
        return getattr(each.declaredType, name) if own is None and each.declaredType is not None else own

    def number(value: Any, default: float) -> float:
        try:
            return default if value is None else float(value)
        except ValueError:
            return default

    settable = each.causality in _SETTABLE or (each.initial in _FREE and each.variability != "constant")
    array = bool(each.dimensions)
    return UnitVariable(
        each.name, each.type, each.valueReference, stated("unit") or "",
        number(stated("min"), -np.inf), number(stated("max"), np.inf), number(None if array else each.start, np.nan),
        settable, array,
    )  # fmt: skip
