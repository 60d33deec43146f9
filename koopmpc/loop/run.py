"""Run: everything that happened in one closed loop, and what does not change in it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import Hint
from koopmpc.base.scene import Scene
from koopmpc.base.values import Value
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Interval, Limits
from koopmpc.control.move import Status
from koopmpc.data.files.frames import build_frame
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.state import State
from koopmpc.loop.rows import OF_STATES, Plans, StepRows
from koopmpc.models.base import Predictor

SECONDS = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}  # in a unit of `metadata["time unit"]`


@dataclass(frozen=True, eq=False, kw_only=True)
class About(Value):
    """The data of a closed loop that do not change from step to step."""

    cost: Cost | None  # what the run is judged by
    limits: Limits | None
    dt: float  # sampling time [s]
    states: tuple[str, ...]  # names with units
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    angles: tuple[int, ...] = ()  # indices of states whose errors wrap at ±π
    metadata: Mapping[str, Any] = field(default_factory=dict[str, Any])  # problem, controller, case, seeds, versions

    def __post_init__(self) -> None:
        check_judges(self.cost, self.limits)
        names = self.states, self.inputs
        for part in ("cost", "limits"):
            given: Cost | Limits | None = getattr(self, part)
            traced = isinstance(given, Cost) and callable(given.stage)
            if given is not None and (traced or any(isinstance(value, Mapping) for value in vars(given).values())):
                object.__setattr__(self, part, given.resolve(*names))
        check_rows = getattr(super(), "__post_init__", None)
        if check_rows is not None:
            check_rows()

    def about(self) -> dict[str, Any]:
        """Return these fields as keywords of a Run, or of an About."""
        return {f.name: getattr(self, f.name) for f in fields(About)}

    def name_references(self, nr: int) -> tuple[str, ...]:
        """Return the names of the `nr` outputs that the references belong to."""
        tracked = None if self.cost is None else bind_outputs(self.cost.of, self.states)
        names = self.states if tracked is None else tracked.names
        return tuple(names) if len(names) == nr else tuple(f"reference {i}" for i in range(nr))


def check_judges(cost: object, limits: object) -> None:
    """Raise unless cost and limits are of the classes Cost and Limits, or None."""
    if cost is not None:
        checks.kind(cost, "cost", Cost, "pass km.Cost(Q=…, R=…), or leave it out")
    if limits is not None:
        checks.kind(limits, "limits", Limits, "pass km.Limits(u_min=…, u_max=…), or leave it out")


def limits_of(about: About, kind: str, k: Int[np.ndarray, " n"]) -> Interval:
    """Return the limits of the "states" or the "inputs" at steps k, a row each; ±inf where there is none."""
    count, limits = len(getattr(about, kind)), about.limits or Limits()
    at = k if limits.in_time else np.zeros_like(k)
    rows = int(at.max(initial=-1)) + 1
    low, high = limits.input_rows(count, 0, rows) if kind == "inputs" else limits.output_rows(count, 0, 0, rows)
    return Interval(low[at], high[at])


def bind_outputs(outputs: Lifting, states: Sequence[str]) -> Lifting | None:
    """Return what a cost tracks or limits are of, bound to these states; None where it is the states themselves."""
    whole = isinstance(outputs, State) and outputs.states is None
    return None if whole else outputs.bind(tuple(states))


@dataclass(frozen=True, eq=False, kw_only=True)
class Run(About, StepRows):
    """A closed loop of T steps of dt seconds, complete: `metrics` and the log need nothing else.

    It has the columns of `StepRows`, with T moves and T + 1 states, and the facts of `About`.

    Attributes
    ----------
    X, Y, reference
        (T+1, nx) true states, (T+1, ny) measurements, (T+1, nr) references.
    U, u_reference
        (T, nu) inputs as applied, and the inputs that hold the reference.
    status, fallback, solve_time, iterations, slack, known, solver, refused, actor
        T entries each: how each step ended, how long it took [s], what its solver did, whether its model knew,
        which solver it was, whether the measurement was refused, and who acted.
    plans
        The plan of each step, where asked for.
    cost, limits, dt, states, inputs, outputs, angles, metadata
        What does not change from step to step.
    scene
        scene(x, u) → shapes, where the plant has one: `record` draws it. No log keeps it, and `==` does not look.
    model
        The controller's predictor, where it has one: `record` shows its eigenvalues. Kept no longer than the scene.
    """

    plans: Plans | None = None
    scene: Scene | None = field(default=None, compare=False)
    model: Predictor | None = field(default=None, compare=False)

    def take_first(self, steps: int) -> "Run":
        """Return the first steps of this run as a run without plans; itself where it has no more."""
        if checks.count(steps, "steps") >= self.steps:
            return self
        rows = {name: values[: steps + (name in OF_STATES)] for name, values in self.columns().items()}
        return replace(self, **rows, plans=None)

    plot = Hint("km.plot.run(run) draws it, km.record(run, path) and koopmpc view show it")
    metrics = Hint("km.metrics(run) judges it")
    save = Hint("km.record(run, 'run.rrd') writes it, km.load_run reads it")

    def to_frame(self) -> Any:
        """Return a pandas.DataFrame of step, time [s], states, measurements, references, inputs and status.

        Columns of measurements begin with ``measured``, those of references with ``reference``. The last row has no
        input, status or solve time.

        Raises
        ------
        KoopmpcError
            pandas is not installed.
        """
        last = [None] * (len(self.X) - self.steps)
        columns: dict[str, Any] = {"step": np.arange(len(self.X)), "time [s]": self.time}
        columns |= dict(zip(self.states, self.X.T, strict=True))
        columns |= {f"measured {name}": column for name, column in zip(self.outputs, self.Y.T, strict=True)}
        tracked = self.name_references(self.reference.shape[1])
        columns |= {f"reference {name}": column for name, column in zip(tracked, self.reference.T, strict=True)}
        inputs = np.vstack([self.U, np.full((len(last), self.U.shape[1]), np.nan)])
        columns |= dict(zip(self.inputs, inputs.T, strict=True))
        columns["status"] = [*(Status(code).name for code in self.status), *last]
        columns["solve time [s]"] = np.append(self.solve_time, [np.nan] * len(last))
        return build_frame(columns)

    @property
    def steps(self) -> int:
        """Number of steps T."""
        return len(self.U)

    @property
    def time(self) -> Float[np.ndarray, " T1"]:
        """Time of every state [s], or in the unit that `metadata["time unit"]` names."""
        return np.arange(len(self.X)) * self.dt
