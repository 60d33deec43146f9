# pyright: basic
"""km.plants.fmu: a Functional Mock-up Unit as a plant, by model exchange as a step map or by co-simulation."""

import shutil
import weakref
from collections import deque
from collections.abc import Mapping, Sequence
from ctypes import c_double, c_uint
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.disk import make_temporary_folder
from koopmpc.base.errors import DataError, LogError
from koopmpc.base.scene import Scene
from koopmpc.plants.dynamics import RK4, Integrator, check_integrator
from koopmpc.plants.fmu_equations import FMUStepMap, read_equations
from koopmpc.plants.fmu_files import (
    StartValue,
    UnitDescription,
    UnitVariable,
    collect_limits,
    import_fmpy,
    read_description,
    require_numbers,
)

_ROUNDING = 1e-9  # share by which the state after a reset may differ from x0
# FMPy knows one logger for all units of FMI 2 in a process, the last one, and calls it also after its unit was freed.
_HEARD = deque[str](maxlen=10)  # what units said last
_LOGGERS: dict[int, Any] = {}  # the last logger of each version of FMI, so that it stays in memory


def fmu(
    path: str | Path,
    *,
    dt: float | None = None,
    interface: str | None = None,
    start_values: Mapping[str, StartValue] | None = None,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    integrator: Integrator = RK4(),  # noqa: B008
    scene: Scene | None = None,
) -> "FMUStepMap | FMUPlant":
    """Return a Functional Mock-up Unit (FMI 2 or 3) as a plant for `collect`, `simulate`, `realtime` and controllers.

    An FMU holds native code, which runs in this process with all rights of the user: load only files that you trust.

    Model exchange gives ẋ = f(x, u) to CasADi: the plant is a StepMap x⁺ = F(x, u), with the derivatives that the unit
    provides, else finite differences, and NonlinearMPC and LinearMPC take it as their model. Co-simulation integrates
    inside the unit: the plant has a state of its own, and controllers learn it from data.

    Parameters
    ----------
    path
        The .fmu file.
    dt
        Sample time [s]; by default the step size of the unit's default experiment.
    interface
        "model exchange" or "co-simulation"; by default model exchange, and co-simulation for units that have events or
        know nothing else.
    start_values
        Name → value of parameters, of inputs that stay fixed, and of start values. They act before the initialisation.
    states
        Names of the state's variables. Co-simulation: by default the variables whose derivatives the unit names, else
        the outputs. Model exchange knows them itself.
    inputs
        Names of the inputs that u moves, in this order; by default all real ones. The others keep their start values.
    outputs
        Names of the variables of y; by default the real outputs, and the states of a unit without outputs.
    integrator
        For model exchange: Euler, RK4, ImplicitMidpoint, Collocation or CVODES.
    scene
        scene(x, u) → shapes, for the animation in the logs.

    Returns
    -------
    FMUStepMap or FMUPlant
        Both have `x0`, the unit's start values of the states, and the limits `u_min`, `u_max`, `x_min` and `x_max` that
        it declares.

    Raises
    ------
    ImportError
        FMPy is not installed (extra ``fmu``).
    LogError
        The file is no FMU, or a path in it leaves its folder.
    DataError
        FMI 1, no binary for this platform, an unknown variable, model exchange with events, time-dependent equations,
        an output that depends on the inputs directly.

    References
    ----------
    Functional Mock-up Interface Specification 2.0.4 and 3.0.1, Modelica Association.
    """
    if start_values is not None:
        checks.kind(start_values, "start_values", Mapping, 'pass {"name": value}')
    check_integrator(integrator)
    unit = read_description(path, interface)
    step = unit.step_size if dt is None else dt
    if step is None:
        raise DataError(f"{unit.file} does not tell a step size; pass dt= in s")
    dt = checks.positive(step, "dt", "s")
    moved = unit.inputs if inputs is None else unit.choose(checks.texts(inputs, "inputs"), "inputs")
    strange = [each.name for each in moved if each not in unit.inputs]
    if strange:
        raise DataError(
            f"inputs names {strange[0]}, which {unit.file} does not take as an input; set it by start_values"
        )
    require_numbers(moved, "the inputs", unit.file)
    values = _read_start_values(unit, start_values or {})
    chosen = None if outputs is None else unit.choose(checks.texts(outputs, "outputs"), "outputs")
    if unit.interface == "co-simulation":
        named = None if states is None else unit.choose(checks.texts(states, "states"), "states")
        return FMUPlant(unit, dt, values, named, moved, chosen, scene)
    if states is not None:
        raise DataError("model exchange knows its states: leave states out; outputs= chooses what is measured")
    return FMUStepMap(unit, dt, read_equations(unit, values, moved, chosen), integrator, scene)


class _EventError(Exception):
    """A unit stopped at an event inside a step, at this time [s]."""

    def __init__(self, time: float) -> None:
        self.time = time


def _read_start_values(unit: UnitDescription, given: Mapping[str, StartValue]) -> dict[str, StartValue]:
    """Return the start values by the names of their variables, after a check that each may be set."""
    found: dict[str, StartValue] = {}
    for name, value in given.items():
        variable = unit.find(name, "start_values")
        if not variable.is_settable:
            raise DataError(f"start_values names {variable.name}, which {unit.file} calculates itself; leave it out")
        if variable.is_array or variable.kind in ("Binary", "Clock"):
            raise DataError(f"start_values names {variable.name}, which does not hold a single value; leave it out")
        if variable.kind == "String" and isinstance(value, str):
            found[variable.name] = value
        elif variable.kind == "Boolean":
            found[variable.name] = bool(value)
        elif variable.kind in ("Real", "Float64", "Float32"):
            found[variable.name] = float(checks.array(value, f"the start value of {name}", ()))
        else:
            found[variable.name] = checks.count(cast("int", value), f"the start value of {name}", -(2**62))
    return found


class FMUPlant:
    """y after each step of a co-simulation unit, held u: `km.plants.fmu` makes it.

    Attributes
    ----------
    dt, states, inputs, outputs
        As of every plant; names carry the unit's units.
    x0
        Start values of the states, NaN where the unit declares none.
    u_min, u_max, x_min, x_max
        The limits that the unit declares, ±inf where it declares none.
    ended
        Why the unit ended the episode; empty while it goes on.
    """

    def __init__(
        self,
        unit: UnitDescription,
        dt: float,
        values: Mapping[str, StartValue],
        states: tuple[UnitVariable, ...] | None,
        moved: tuple[UnitVariable, ...],
        measured: tuple[UnitVariable, ...] | None,
        scene: Scene | None,
    ) -> None:
        self._made_of = unit, dt, dict(values), states, moved, measured, scene
        own = states or unit.states or measured or unit.outputs
        measured = measured or unit.outputs or own
        if not own:
            raise DataError(f"{unit.file} has no real outputs and no states; name variables by outputs=")
        require_numbers((*own, *measured), "the states and outputs", unit.file)
        self.dt, self.scene = dt, scene
        self.states, self.inputs, self.outputs = (tuple(v.label for v in group) for group in (own, moved, measured))
        (self.x_min, self.x_max), (self.u_min, self.u_max) = collect_limits(own), collect_limits(moved)
        given = [values.get(each.name, each.start) for each in own]
        self.x0 = np.array(given, dtype=np.float64)
        self._unit, self._values, self._own, self._measured = unit, values, own, measured
        self._slave: Any = _load(unit)
        weakref.finalize(self, _free, self._slave)
        self._is_fresh, self._has_run, self._steps, self.ended = True, False, 0, "not started"
        # One call reads outputs and states: their references in one array, the values in another.
        read = (*measured, *own)
        self._refs, self._read = (c_uint * len(read))(*(v.reference for v in read)), (c_double * len(read))()
        self._u_refs, self._u = (c_uint * len(moved))(*(v.reference for v in moved)), (c_double * len(moved))()
        self._values_read, self._values_sent = np.ctypeslib.as_array(self._read), np.ctypeslib.as_array(self._u)

    @property
    def state(self) -> Float[np.ndarray, " nx"] | None:
        """A copy of the state's variables (nx,); None before the first `reset`."""
        return self._values_read[len(self._measured) :].copy() if self._has_run else None

    def reset(self, x0: ArrayLike | None, rng: np.random.Generator | int = 0) -> Float[np.ndarray, " ny"]:
        """Begin an episode at x0 (nx,), or at the unit's own start values without x0, and return y (ny,).

        Raises
        ------
        DataError
            The unit calculates a state of x0 itself, or refuses a start value.
        """
        start = None if x0 is None else checks.array(x0, "x0", (len(self._own),))
        for each in self._own if start is not None else ():
            if not each.is_settable:
                raise DataError(
                    f"x0 cannot be set: {self._unit.file} calculates {each.name} itself; pass x0=None, and set what it "
                    "allows by start_values, or name other variables by states="
                )
        self.ended = "not started"
        try:
            self._initialise(start)
            self._look()
        except Exception as error:  # FMPy raises bare Exceptions
            raise self._refused("the reset", error) from error
        self._has_run, self._steps, self.ended = True, 0, ""
        observed = self._values_read[len(self._measured) :]
        if start is not None and not np.allclose(observed, start, rtol=_ROUNDING, atol=_ROUNDING):
            raise DataError(f"{self._unit.file} was put into x0 = {start}, but begins at {observed}; pass x0=None")
        return self._values_read[: len(self._measured)].copy()

    def step(self, u: ArrayLike) -> Float[np.ndarray, " ny"]:
        """Hold u (nu,) for dt and return the new y (ny,).

        Raises
        ------
        DataError
            The unit was never reset, has ended, refuses the step, or stops at an event inside it.
        """
        if self.ended:
            raise DataError(f"{self._unit.file} does not run ({self.ended}); call reset(x0, rng) before step")
        self._values_sent[:] = checks.vector(u, "u", len(self.inputs))
        slave, start, n = self._slave, self._steps * self.dt, len(self._u_refs)
        try:
            if self._unit.version == 2:
                slave.fmi2SetReal(slave.component, self._u_refs, n, self._u)
                slave.fmi2DoStep(slave.component, start, self.dt, 1)
            else:
                slave.fmi3SetFloat64(slave.component, self._u_refs, n, self._u, n)
                event, ended, early, reached = slave.doStep(start, self.dt)
                if event or early:
                    raise _EventError(reached)
                if ended:
                    self.ended = "the unit ended the simulation"
            self._look()
        except _EventError as error:
            self.ended = "it met an event"
            raise DataError(
                f"{self._unit.file} met an event inside the step from t = {start:g} s by {self.dt:g} s and stopped at "
                f"t = {error.time:g} s; koopmpc handles no events: export the unit so that it handles them inside "
                "doStep, or pass a dt that its events fall on"
            ) from None
        except Exception as error:  # FMPy raises bare Exceptions
            raise self._refused(
                f"the step from t = {start:g} s by {self.dt:g} s with u = {self._values_sent}", error
            ) from error
        self._steps += 1
        return self._values_read[: len(self._measured)].copy()

    def __reduce__(self) -> tuple[Any, ...]:
        return _reload, (str(self._unit.path), *self._made_of[1:-1], None)  # a scene does not pickle

    def _refused(self, what: str, error: Exception) -> DataError:
        """Return the error that says what the unit refused, with its own last message; only a reset helps then."""
        self.ended = "it refused a step"
        said = f", and said: {_HEARD[-1]}" if _HEARD else ""
        return DataError(
            f"{self._unit.file} refused {what}: {error}{said}; try another dt, or inputs inside u_min … u_max"
        )

    def _look(self) -> None:
        """Read outputs and states."""
        slave, n = self._slave, len(self._refs)
        if self._unit.version == 2:
            slave.fmi2GetReal(slave.component, self._refs, n, self._read)
        else:
            slave.fmi3GetFloat64(slave.component, self._refs, n, self._read, n)

    def _initialise(self, start: Float[np.ndarray, " nx"] | None) -> None:
        """Set parameters and start values, and initialise the unit."""
        slave, is_two = self._slave, self._unit.version == 2
        if not self._is_fresh:
            slave.reset()
        self._is_fresh = False
        _HEARD.clear()
        if is_two:
            slave.setupExperiment(startTime=0.0)
        values: dict[str, StartValue] = dict(self._values)
        if start is not None:
            values |= {each.name: float(value) for each, value in zip(self._own, start, strict=True)}
        for name, value in values.items():
            variable = self._unit.variables[name]
            kind = variable.kind
            if kind == "Enumeration":
                kind = "Integer" if is_two else "Int64"
            getattr(slave, f"set{kind}")([variable.reference], [value])
        slave.enterInitializationMode()
        slave.exitInitializationMode()


def _reload(path: str, *parts: Any) -> FMUPlant:
    """Return the plant of a pickle, with an instance of its own."""
    return FMUPlant(read_description(path, "co-simulation"), *parts)


def _load(unit: UnitDescription) -> Any:
    """Return an instance of a co-simulation unit in FMPy; its machine code is unpacked into a temporary folder."""
    fmpy = import_fmpy()
    folder = str(make_temporary_folder())
    try:
        fmpy.extract(str(unit.path), folder)
        slave = fmpy.instantiate_fmu(folder, unit.source, "CoSimulation", logger=_log)
    except Exception as error:  # FMPy raises bare Exceptions
        shutil.rmtree(folder, ignore_errors=True)
        said = f", and said: {_HEARD[-1]}" if _HEARD else ""
        raise LogError(f"{unit.file} could not be loaded: {error}{said}") from error
    _LOGGERS[unit.version] = getattr(slave, "callbacks", None)
    _HEARD.clear()
    return slave


def _log(*parts: Any) -> None:
    """Keep what a unit says."""
    if isinstance(parts[-1], bytes) and parts[-1]:
        _HEARD.append(parts[-1].decode(errors="replace"))


def _free(slave: Any) -> None:
    """Free an instance, its machine code and its folder."""
    try:
        slave.freeInstance()
    finally:
        shutil.rmtree(slave.unzipDirectory, ignore_errors=True)
