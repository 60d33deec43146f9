"""What a controller publishes of itself: the data that it is made of, for files, and the data of a step, for code."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, cast

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, Hint
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Interval, Limits
from koopmpc.control.solvers.scaled_qp import DAQPSetup
from koopmpc.control.target import Targets
from koopmpc.control.watching import StepMonitor
from koopmpc.data.delay import Delay
from koopmpc.lifting.base import strip_unit
from koopmpc.models.base import save_value
from koopmpc.models.hidden_state import HiddenState
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.plants.graph import Graph
from koopmpc.plants.step_map import StepMap

Restored = TypeVar("Restored")  # a class of controller that is made again of its data


@dataclass(frozen=True, eq=False)
class SavedController(Value):
    """The data that a controller is made of. A loaded controller begins as after `reset`.

    Attributes
    ----------
    name
        The class of the controller, as in the table of `koopmpc.synthesis.kinds`.
    model
        The predictor of the controller; None where it has none.
    cost, limits, horizon, estimator, latency, moves, time_limit
        Arguments of the controller; `moves` are the lengths of the blocks of held inputs, by
        name where each input has its own.
    options
        The arguments that only this class has.
    monitor
        The monitor, where it has one.
    """

    name: str
    model: LinearPredictor | BilinearPredictor | None
    cost: Cost | None = None
    limits: Limits | None = None
    horizon: int = 0
    estimator: Value | None = None
    latency: int = 0
    moves: tuple[int, ...] | Mapping[str, tuple[int, ...]] = ()
    time_limit: float | None = None
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    monitor: StepMonitor | None = None


@dataclass(frozen=True, eq=False)
class Program(Value):
    """The data that a step of a controller needs: C code is generated from it alone.

    Attributes
    ----------
    controller
        The class of the controller.
    """

    controller: str

    def __call__(self, reference: object = None) -> Any:
        """Raise the DataError that says what took the place of a call."""
        raise DataError(
            "controller.program is data, and no function: read its fields; km.export says why there is no C"
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class StepProgram(Program):
    """What all controllers with C code have in common: z = ψ(ζ), limits of the inputs, a given input target.

    Attributes
    ----------
    model
        The model of the controller: sizes, names, dt, and A, B, C, E where it is linear.
    inputs, rates
        The limits to which an input is clipped; `rates` is None where nothing limits its changes.
    given
        (k, nu) rows of a given u_target, the last one held; None where the target is found.
    reference
        (rows, nr) the reference rows for which the Program was made.
    lifting
        ζ → z.
    sizes
        (nz,) root mean squares of z in the data, ones where they are not known.
    gain
        (n, nz) how z moves the planned inputs: with `sizes` it tells what single precision costs.
    settings
        All settings of DAQP.
    estimator
        How z and d follow from y.
    notes
        Sentences on how the C code differs from the controller.
    """

    model: LinearPredictor | BilinearPredictor | StepMap
    inputs: Interval
    rates: Interval | None
    given: Float[np.ndarray, "given_rows nu"] | None
    reference: Float[np.ndarray, "rows nr"]
    settings: Mapping[str, Any]
    notes: tuple[str, ...] = ()

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Return `lifting`, `sizes`, `gain` or `estimator`: fields of some programs, computed in others."""

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return self.model.dt

    @property
    def nr(self) -> int:
        """Number of entries of a reference row."""
        return self.reference.shape[1]


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearProgram(StepProgram):
    """A controller on z⁺ = A z + B u + E w: how a reference becomes an equilibrium inside the limits.

    Attributes
    ----------
    targets
        Equilibria z = z₀ + Z α, u = u₀ + W α, and α of a reference.
    """

    COMPUTED: ClassVar[tuple[str, ...]] = ("lifting", "sizes", "gain", "target_solvers")
    """What C needs besides the fields."""
    IN_PYTHON: ClassVar[frozenset[str]] = frozenset()
    """Fields that C has no use for."""

    model: LinearPredictor
    targets: Targets

    @cached_property
    def lifting(self) -> Graph:
        """ζ → z; DataError where that cannot be written as a graph."""
        model = self.model
        return trace_lifting(model.lifting.symbolic, len(model.lifting.bound_states), model.embedding, model.nu)

    @property
    def sizes(self) -> Float[np.ndarray, " nz"]:
        """Root mean squares of z in the data, ones where they are not known."""
        scale = self.model.scale
        return np.ones(self.model.nz) if scale is None else np.linalg.norm(scale, axis=0)

    @property
    def target_solvers(self) -> tuple[DAQPSetup, ...]:
        """The QP that moves α inside all limits, and the one for the limits of the inputs alone."""
        counts = (len(self.targets.rows), self.targets.hard) if self.targets.Z.shape[1] else ()
        return tuple(self.targets.solver(count).setup for count in counts)


def describe_controller(controller: Any) -> str:
    """Return the class of a controller, its model, horizon, cost and limits in words."""
    known = cast("dict[str, Any]", vars(controller))
    model: Any = next((known[name] for name in ("predictor", "model", "eigenfunction") if name in known), None)
    parts = [] if model is None else [_describe_model(model)]
    if known.get("dt") is not None:
        steps = known.get("horizon")
        ahead = "" if steps is None else f", horizon {steps} = {steps * known['dt']:.4g} s"
        parts.append(f"dt {known['dt']:.4g} s{ahead}")
    names = getattr(model, "states", ()), getattr(model, "inputs", ())
    parts.append(_describe_limits(known.get("limits"), *names))
    solver = getattr(controller, "solver", None)
    parts += [f"solver {solver}"] if isinstance(solver, str) else []
    return f"{type(controller).__name__}({'; '.join(filter(None, parts))})"


def _describe_model(model: Any) -> str:
    count = getattr(model, "nz", None)
    states = ", ".join(map(strip_unit, getattr(model, "states", ())))
    size = type(model).__name__ if count is None else f"{count} observable{'' if count == 1 else 's'}"
    return f"{size} of {states}" if states else size


def _describe_limits(limits: Any, states: Sequence[str], inputs: Sequence[str]) -> str:
    if limits is None:
        return ""
    widest, parts = limits.base, list[str]()
    for letter, names in (("u", inputs), ("x", states)):
        ends = [getattr(widest, f"{letter}_{end}") for end in ("min", "max")]
        count = len(names) or max(np.size(end) for end in ends)
        free = zip(ends, (-np.inf, np.inf), strict=True)
        low, high = (np.broadcast_to(default if end is None else end, count) for end, default in free)
        for i in np.flatnonzero(np.isfinite(low) | np.isfinite(high)).tolist():
            name = strip_unit(names[i]) if names else f"{letter}{i}"
            parts.append(f"{low[i]:.4g} ≤ {name} ≤ {high[i]:.4g}")
    more = {
        "limited rates": limits.du_max is not None or limits.du_min is not None,
        "limited outputs": limits.of is not None,
        "rows in time": limits.in_time,
    }
    return ", ".join([*parts, *(name for name, given in more.items() if given)])


class Published:
    """A controller that is saved as data, and whose step may be published as a `Program`.

    A subclass says in `as_data` how it is saved, in `from_data` how it is made again if it takes more than a model, a
    cost, limits and options, and in `build_program` what a step needs.
    """

    def as_data(self) -> SavedController:
        """Return what the controller was made of.

        Raises
        ------
        DataError
            A part of it is code.
        """
        raise NotImplementedError

    @classmethod
    def from_data(cls: type[Restored], saved: SavedController) -> Restored:
        """Return the controller that is made of these data."""
        build: Any = cls
        return build(saved.model, saved.cost, saved.limits, **saved.options)

    def __repr__(self) -> str:
        """Return the class, its model, horizon, cost and limits in words."""
        return describe_controller(self)

    solve = Hint("call the controller: move = mpc(y, reference), and move.u is the input")
    step = Hint("call the controller: move = mpc(y, reference), and move.u is the input")
    predict = Hint("mpc.plan() is the forecast of the last call; model.rollout(x0, U) is that of a model")
    run = Hint("run = km.simulate(plant, mpc, x0=…, reference=…, steps=…)")
    simulate = Hint("run = km.simulate(plant, mpc, x0=…, reference=…, steps=…)")

    def save(self, path: str | Path) -> None:
        """Write the controller as data (.npz: arrays and one JSON text); `km.load_controller` reads it.

        Raises
        ------
        DataError
            A part of it is code: a StepMap, or a user's own estimator.
        LogError
            The path cannot be written.
        """
        save_value(self.as_data(), path)

    @property
    def program(self) -> Program:
        """The data of a step.

        Raises
        ------
        DataError
            The controller has no such data.
        """
        return self.build_program(None)

    def build_program(self, reference: ArrayLike | None) -> Program:
        """Return the data of a step from which C code is generated.

        Parameters
        ----------
        reference
            Rows (k, nr) of the reference that will come, by default one of zeros: a BilinearMPC finds their targets.

        Raises
        ------
        DataError
            No C code can be generated; the message says why.
        """
        del reference
        raise no_export(self)


def no_export(
    controller: object,
    why: str = "koopmpc has no C code for its law",
    instead: str = "a KoopmanMPC, a BilinearMPC, a LinearMPC or an LQR",
) -> DataError:
    """Return the error that says why no C code can be generated for a controller."""
    name = type(controller).__name__
    return DataError(f"a {name} cannot be exported: {why}; export {instead}")


def refuse_time_limit(time_limit: float | None, bound: str) -> None:
    """Raise where a controller has a time_limit; `bound` are the arguments that bound its iterations instead.

    Raises
    ------
    DataError
        It has one.
    """
    if time_limit is not None:
        raise DataError(
            "the controller has a time_limit, and C has no clock; make it without one and bound the iterations: "
            + bound
        )


def reference_table(reference: ArrayLike | None, nr: int) -> Float[np.ndarray, "rows nr"]:
    """Return the rows (k, nr) of a reference, by default one of zeros."""
    if reference is None:
        return np.zeros((1, nr))
    rows = np.atleast_2d(checks.array(reference, "reference"))
    return checks.array(rows, "reference", (None, nr)) if rows.size else np.zeros((0, nr))


def trace_graph(function: ca.Function, what: str) -> Graph:
    """Return the graph of a function with one result.

    Raises
    ------
    DataError
        It holds what cannot be written in C; the message says what it is and what would do.
    """
    try:
        return Graph.trace(function)
    except DataError as error:
        raise DataError(f"{what} cannot be written in C: {error}") from error


@raise_swallowed()
def trace_lifting(lift: Callable[[ca.SX], ca.SX], nzeta: int, embedding: Delay | None, nu: int) -> Graph:
    """Return ζ → z as a graph.

    Raises
    ------
    DataError
        It holds an operation that cannot be written in C; the past holds other inputs than the model has; the model has
        a hidden state, or sensors that saturate.
    """
    if isinstance(embedding, HiddenState):
        raise DataError(
            "the model has a hidden state with nonlinear dynamics, and C code keeps past rows only; export a model of "
            "km.identify.subspace(data) or km.identify.narx(data)"
        )
    if embedding is not None and embedding.rails is not None:
        raise DataError("the model has sensors that saturate, which C code does not know; fit it without rails")
    if embedding is not None and embedding.inputs and embedding.bound and len(embedding.bound[1]) != nu:
        raise DataError("the embedding holds other inputs than the predictor; fit both on the same data to export it")
    zeta = ca.SX.sym("zeta", nzeta)
    return trace_graph(ca.Function("lifting", [zeta], [ca.densify(lift(zeta))], {"cse": True}), "the lifting")
