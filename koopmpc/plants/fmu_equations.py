# pyright: basic
"""A model-exchange unit as a step map: its equations through CasADi, with their derivatives."""

import os
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base.disk import make_temporary_folder
from koopmpc.base.errors import DataError, LogError
from koopmpc.base.scene import Scene
from koopmpc.base.values import fingerprint, freeze
from koopmpc.plants.dynamics import Integrator
from koopmpc.plants.fmu_files import StartValue, UnitDescription, UnitVariable, collect_limits, read_description
from koopmpc.plants.step_map import StepMap

_LATER = 1234.5  # time [s] at which ẋ is compared with that at 0, to see whether it depends on time


@dataclass(frozen=True, eq=False, init=False)
class FMUStepMap(StepMap):
    """x⁺ = F(x, u), y = h(x) of a model-exchange unit, with the start values and limits that it declares.

    Pickles name the file of the unit, and load it again.
    """

    x0: Float[np.ndarray, " nx"]
    u_min: Float[np.ndarray, " nu"]
    u_max: Float[np.ndarray, " nu"]
    x_min: Float[np.ndarray, " nx"]
    x_max: Float[np.ndarray, " nx"]

    def __init__(
        self, unit: UnitDescription, dt: float, equations: "UnitEquations", integrator: Integrator, scene: Scene | None
    ) -> None:
        parts = equations.states, equations.inputs, equations.outputs
        states, inputs, outputs = ([each.label for each in group] for group in parts)
        super().__init__(integrator.step(equations.f, dt), dt, equations.h, states, inputs, outputs, scene)
        (x_min, x_max), (u_min, u_max) = collect_limits(parts[0]), collect_limits(parts[1])
        freeze(self, x0=equations.x0, u_min=u_min, u_max=u_max, x_min=x_min, x_max=x_max)
        names = ([each.name for each in group] for group in parts[1:])
        freeze(self, _made_of=(str(unit.path), dt, equations.values, *names, integrator))

    def __reduce__(self) -> tuple[Any, ...]:
        return _reload_step_map, cast("Any", self)._made_of  # CasADi 3.8 crashes on its own pickles of FMI 2 units


def _reload_step_map(
    path: str,
    dt: float,
    values: dict[str, StartValue],
    inputs: Sequence[str],
    outputs: Sequence[str],
    integrator: Integrator,
) -> "FMUStepMap":
    """Return the step map of a pickle."""
    unit = read_description(path, "model exchange")
    equations = read_equations(unit, values, unit.choose(inputs, "inputs"), unit.choose(outputs, "outputs"))
    return FMUStepMap(unit, dt, equations, integrator, None)


class UnitEquations(NamedTuple):
    """ẋ = f(x, u), y = h(x) of a model-exchange unit, and the start values of x; without h, y = x."""

    f: ca.Function
    h: ca.Function | None
    x0: Float[np.ndarray, " nx"]
    states: tuple[UnitVariable, ...]
    inputs: tuple[UnitVariable, ...]
    outputs: tuple[UnitVariable, ...]
    values: dict[str, StartValue]


def read_equations(
    unit: UnitDescription,
    values: dict[str, StartValue],
    moved: tuple[UnitVariable, ...],
    chosen: tuple[UnitVariable, ...] | None,
) -> UnitEquations:
    """Return the equations of a model-exchange unit as CasADi functions."""
    if unit.events:
        raise DataError(
            f"{unit.file} has {unit.events} event indicators: by model exchange koopmpc steps over events; pass "
            'interface="co-simulation" where the unit offers it, or export the model without events'
        )
    folder = _unpack(unit.path, fingerprint(unit.path.read_bytes()), os.getpid())
    try:
        builder = ca.DaeBuilder(unit.source.modelName, str(folder), {"enable_ls_serialization": False})
        for name, value in values.items():
            builder.set(name, value)
        names, all_inputs = builder.x(), builder.u()
        if not names:
            raise DataError(f"{unit.file} has no continuous states; load it by co-simulation")
        states = tuple(unit.variables[name] for name in names)
        measured = chosen or unit.outputs or states
        builder.set_y([each.name for each in measured])
        # Of CasADi 3.8 only whole Jacobians are right: products with a vector of zeros are those of the last vector.
        slopes = {"enable_forward": False, "enable_reverse": not builder.provides_directional_derivatives()}
        equations = builder.create("unit", ["x", "u"], ["ode", "y"], slopes)
        timed = builder.create("timed", ["t", "x", "u"], ["ode", "y"])  # CasADi 3.8 crashes in its second derivatives
        start, held = (
            np.array([float(values[name] if name in values else builder.get(name)) for name in group])
            for group in (names, all_inputs)
        )
        _require_autonomous(timed, start, held, unit.file)
        direct = _find_direct_outputs(equations, start, held, len(measured))
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise DataError(f"CasADi could not load {unit.file} for model exchange: {lines[-1]}") from error
    if direct:
        others = [each.name for i, each in enumerate(measured) if i not in direct]
        raise DataError(
            f"the output {measured[direct[0]].name} of {unit.file} depends on an input directly, but y = h(x); "
            f"pass outputs={others or names}"
        )
    x, u = ca.MX.sym("x", len(names)), ca.MX.sym("u", len(moved))
    whole = _place_inputs(u, [each.name for each in moved], all_inputs, held)
    (slope, _), (_, y) = equations(x, whole), equations(x, ca.DM(held))
    f = ca.Function("f", [x, u], [slope], ["x", "u"], ["dx"])
    h = None if measured == states else ca.Function("h", [x], [y], ["x"], ["y"])
    return UnitEquations(f, h, start, states, moved, measured, values)


def _place_inputs(u: ca.MX, moved: list[str], names: list[str], held: np.ndarray) -> ca.MX:
    """Return the values of all inputs: u of those that are moved, and of the others what is held."""
    place = {name: u[i] for i, name in enumerate(moved)}
    return ca.vertcat(*(place.get(name, ca.MX(value)) for name, value in zip(names, held, strict=True)))


@cache
def _unpack(path: Path, content: str, process: int) -> Path:
    """Return the folder of a unit that this process unpacked; `content` is the hash of its file.

    CasADi 3.8 itself would unpack into the present folder, and leave there what lives until the process ends.
    """
    folder = make_temporary_folder()
    try:
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
    except (OSError, RuntimeError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise LogError(f"{path.name} cannot be unpacked: {error}; take another copy") from error
    return folder


def _require_autonomous(f: ca.Function, x: np.ndarray, u: np.ndarray, file: str) -> None:
    """Raise where ẋ or y at the start values is another one later."""
    now, later = (ca.vertcat(*f(t, x, u)).full() for t in (0.0, _LATER))
    if not np.allclose(now, later, rtol=1e-6, atol=1e-9, equal_nan=True):
        raise DataError(
            f"the equations of {file} depend on time, x⁺ = F(x, u) does not; make what changes with time an input"
        )


def _find_direct_outputs(f: ca.Function, x: np.ndarray, u: np.ndarray, count: int) -> list[int]:
    """Return which outputs move with an input at fixed x; a unit seldom tells it."""
    now = f(x, u)[1].full().ravel()
    moved = np.zeros(count, dtype=bool)
    for share in (1.0, -0.37):
        y = f(x, u + share * (1 + np.abs(u)))[1].full().ravel()
        moved |= ~np.isclose(y, now, rtol=1e-9, atol=1e-12, equal_nan=True)
    return np.flatnonzero(moved).tolist()
