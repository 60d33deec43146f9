"""The quadratic Cost that every controller and every metric shares, and what of a model it and the Limits read."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Literal, NamedTuple, Protocol, TypeAlias, TypeVar, cast, runtime_checkable

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value
from koopmpc.control.ask import bounds
from koopmpc.control.ask.bounds import Bound
from koopmpc.control.ask.limits import Interval, Limits, Movable, Softness, half_width, magnitude
from koopmpc.control.ask.stage_cost import StageCost, trace_stage
from koopmpc.lifting.base import Lifting, find_observables
from koopmpc.lifting.state import State
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.plants.graph import Graph

_CONSTANT = 1e-12  # share of the mean square below which a variance is rounding
Read = TypeVar("Read", np.ndarray, ca.Function)


@runtime_checkable
class WeighsEnd(Protocol):
    """What knows a terminal weight for a cost, such as a certificate."""

    def weigh_end(self, cost: "Cost") -> Float[np.ndarray, "n n"]:
        """Return the weight."""
        ...


@dataclass(frozen=True, eq=False)
class Cost(Value):
    """Σ_{k=1}^{N−1} ‖of(x_k) − r_k‖²_Q + Σ_{k=0}^{N−1} (‖u_k − u_r‖²_R + pᵀu_k + ‖u_k − u_{k−1}‖²_{R_delta}) + V(z_N).

    A custom `stage` adds Σ_{k=0}^{N−1} ℓ(x_k, u_k), an `output_price` Σ_{k=1}^{N−1} qᵀ of(x_k).

    V is by default the cost-to-go of the same tracking problem over a tail of steps after the horizon, without limits
    and with an input of its own at each step: x_N and every later state are weighed by Q, inputs by R around u_r and
    their changes by R_delta. The last reference row, its input target, the last measured disturbance and the estimated
    one are held. No target state is needed, so a reference may move and need not be an equilibrium.

    Parameters
    ----------
    Q
        Weight of the tracked outputs, ⪰ 0; a scalar or a vector is a diagonal. Or by name, ``{"theta": 10}``, with or
        without the unit; an omitted name has weight 0. The names are looked up when a controller is built.
    R
        Weight of the inputs, ⪰ 0; a scalar or a vector is a diagonal; by name it names every input. R + BᵀPB must be
        positive definite.
    Q_N
        Terminal weight in place of the tail, of x_N − r_N if (nx, nx), of z_N − z_r if (nz, nz), where z_r is the
        equilibrium that comes nearest to r_N. BilinearMPC and NonlinearMPC weigh of(x_N) − r_N, (nr, nr): for lifted
        coordinates let the cost track the lifting. Or a Certificate: its V times the number that makes it fall by at
        least the stage cost.
    of
        The tracked outputs as observables of the state; the references have as many columns. A controller on a
        lifted predictor finds them in its own lifting by name: any lifted coordinates may be tracked.
    u_target
        u_r. "equilibrium": the input that holds the reference, or comes nearest to it inside the limits, found for each
        reference row; "zero"; an input (nu,); or rows (k, nu) that go with the rows of a reference: row k counts at
        the k-th step after the controller's reset, the last one from then on.
    R_delta
        Weight of the changes of the inputs from step to step, ⪰ 0; a scalar or a vector is a diagonal.
    price
        p, what a unit of each input costs in a step: (nu,), or rows (k, nu) such as those of a tariff, which go with
        the steps as those of u_target do. By name, ``{"heater": 0.3}``, or a value a step; an omitted input is free.
        R must be positive definite. `KoopmanMPC`, `LinearMPC`, `BilinearMPC` and `NonlinearMPC` know it; the end of the
        last two does not.
    tail
        Steps of the tail; 0 is Q_N = Q. By default it lasts until the gain and the feedforward rest; on a model that
        was fitted to data until the gain rests as far as the model is accurate, that is, until a further step changes
        the gain by a smaller share than the model misses of its states in one step: a longer tail would only add the
        errors of such a model. Of that length, its halves, N and none the shortest is taken whose loop on the model
        itself, with inputs half a step late, costs within 0.5 % of the least. BilinearMPC and NonlinearMPC have no
        tail by default: without Q_N and tail their end costs the Riccati solution at the equilibrium nearest to r_N.
    stage
        ℓ(x, u), a number, as a function of CasADi's symbols: ``lambda x, u: x[1] * u[0]``. For BilinearMPC, which
        convexifies it, and NonlinearMPC; V is of Q and R alone. `metrics` counts it from x_0 and u_0 on.
    Q_rows, R_rows
        Weights in time, (T, nr) and (T, nu), or by name a value a step: row k is the diagonal that weighs x_k, or u_k,
        of a run in place of that of Q or R; the last row is held. Q and R, both diagonal then, stay the weights of V,
        of set points and of sizes. For all predictive controllers; `KoopmanMPC` and `LinearMPC` make a plan anew for
        each preview of weights that they have not met, and keep the last 64 of these plans.
    output_price
        q, what a unit of each tracked output costs in a step, (nr,) or by name; an omitted output is free. A priced
        output needs a weight in Q. The tail of linear controllers counts q too, and so does ``tail=0`` at x_N; other
        ends do not. For the controllers that know `price`.
    beyond
        What a reference does after the rows that a step is given. "rest": the last row stays. "motion", the default of
        BilinearMPC and NonlinearMPC without Q_N, tail and given u_target: it goes on by the linear recurrence that all
        these rows obey, as sines, ramps and their sums do, and the end of the plan aims there; rows that obey none
        rest. Other controllers rest.

    Raises
    ------
    DefinitenessError
        A weight is indefinite or not symmetric.
    DataError
        Both Q_N and tail are given; tail is no whole number or negative; u_target is none of the above.

    Examples
    --------
    >>> import koopmpc as km
    >>> plain = km.Cost(Q=[10, 1], R=0.1)  # errors of the states, and the input beside the one that holds the reference
    >>> upright = km.Cost(Q=[10, 10, 1], R=0.1, of=km.Fourier(1, states="theta") + km.State("omega"))  # sin θ, cos θ, ω
    """

    Q: ArrayLike | checks.ByName
    R: ArrayLike | checks.ByName
    Q_N: "ArrayLike | WeighsEnd | None" = None
    of: Lifting = field(default_factory=State)
    u_target: Literal["equilibrium", "zero"] | ArrayLike = "equilibrium"
    R_delta: ArrayLike | checks.ByName | None = None
    tail: int | None = None
    price: "Bound" = None
    beyond: Literal["rest", "motion"] | None = None
    stage: "StageCost | None" = None
    Q_rows: "Bound" = None
    R_rows: "Bound" = None
    output_price: ArrayLike | checks.ByName | None = None

    def __post_init__(self) -> None:
        if isinstance(self.Q_N, WeighsEnd):
            object.__setattr__(self, "Q_N", self.Q_N.weigh_end(replace(self, Q_N=None)))
        checks.kind(self.of, "of", Lifting, 'for example km.State("theta"), or km.Fourier(1, states="theta")')
        for name in ("Q", "R", "Q_N", "R_delta"):
            value = getattr(self, name)
            if value is None and name in ("Q", "R"):
                raise DataError(f"{name} must be a weight, got None; pass 0 to leave it out")
            if isinstance(value, Mapping):
                if name == "Q_N":
                    raise DataError("Q_N is a table of names; pass a matrix (nx, nx) or (nz, nz)")
                stored = checks.check_named(value, name)
                for key, weight in stored.items():
                    checks.weight(np.array(weight), f"{name}[{key!r}]")
                object.__setattr__(self, name, stored)
            elif value is not None:
                stored = checks.array(value, name)
                checks.weight(stored, name)
                object.__setattr__(self, name, stored)
        if isinstance(self.u_target, str):
            if self.u_target not in ("equilibrium", "zero"):
                known = '"equilibrium", "zero", an input or rows of inputs'
                raise DataError(f"u_target is {self.u_target!r}; pass {known}")
        else:
            rows = np.atleast_1d(checks.array(self.u_target, "u_target"))
            if rows.ndim > 2 or not rows.size:
                raise ShapeError(f"u_target has shape {rows.shape}, expected (nu,) or rows (k, nu), one a step")
            object.__setattr__(self, "u_target", rows)
        if self.price is not None:
            for value in self.price.values() if isinstance(self.price, Mapping) else [self.price]:
                checks.array(value, "price")  # finite, and named by its row where it is not
            object.__setattr__(self, "price", bounds.check_bound(self.price, "price"))
        if self.output_price is not None:
            if isinstance(self.output_price, Mapping):
                stored = checks.check_named(self.output_price, "output_price")
            else:
                stored = np.atleast_1d(checks.array(self.output_price, "output_price"))
                if stored.ndim > 1:
                    raise ShapeError(f"output_price has shape {stored.shape}; pass a number for each tracked output")
            object.__setattr__(self, "output_price", stored)
        for name in ("Q_rows", "R_rows"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, self._check_rows(name))
        if not (callable(cast("object", self.stage)) or isinstance(self.stage, Graph | None)):
            raise DataError(f"stage is {self.stage!r}; pass a function of x and u, such as lambda x, u: x[0] * u[0]")
        if self.beyond not in ("rest", "motion", None):
            raise DataError(f'beyond is {self.beyond!r}; pass "rest" or "motion"')
        if self.beyond == "motion" and not (self.Q_N is None and self.tail is None):
            raise DataError('beyond="motion" moves the end that the default costs; leave Q_N and tail out')
        if self.tail is not None:
            object.__setattr__(self, "tail", int(checks.count(self.tail, "tail", 0)))
            if self.Q_N is not None:
                raise DataError(f"Q_N and tail = {self.tail} are given; Q_N takes the tail's place: pass one of them")

    @property
    def moves_on(self) -> bool:
        """Whether the end of a plan follows a reference that goes on as it moved."""
        return self.beyond != "rest" and self.Q_N is None and self.tail is None

    def _check_rows(self, name: str) -> Any:
        """Return rows of weights, checked."""
        given: Any = getattr(self, name)
        for value in bounds.list_bound(given):
            if (checks.array(value, name) < 0).any():
                raise DataError(f"{name} holds a number below 0; pass weights of 0 or above")
        rows: Any = bounds.check_bound(given, name)
        if not bounds.is_rows(rows):
            raise ShapeError(f"{name} is {rows!r}; pass rows (steps, n), or by name a value a step")
        if self.price is not None and name == "R_rows":
            raise DataError("a price is paid back by R, which R_rows moves in time; pass one of the two")
        if self.output_price is not None and name == "Q_rows":
            raise DataError("an output_price is paid back by Q, which Q_rows moves in time; pass one of the two")
        for weight in ("Q", "R"):  # the steps have diagonals of both
            base = getattr(self, weight)
            if not isinstance(base, Mapping) and np.ndim(base) == 2 and (base != np.diag(np.diagonal(base))).any():
                raise DataError(f"{name} are diagonals, and {weight} is a full matrix; pass a diagonal one")
        return rows

    def resolve(self, states: Sequence[str], inputs: Sequence[str]) -> "Cost":
        """Return the cost with arrays in place of weights by name, and a graph in place of the function `stage`.

        Raises
        ------
        DataError
            A name is unknown or fits two, or R does not name every input; `stage` cannot be written as a graph.
        """
        fields: dict[str, Any] = {
            name: value for name in ("Q", "R", "R_delta") if isinstance(value := getattr(self, name), Mapping)
        }
        priced: dict[str, Any] = {}
        if isinstance(self.price, Mapping):
            priced["price"] = bounds.order_bound(self.price, "price", inputs, 0.0)
        if isinstance(self.output_price, Mapping):
            names = self.of.bind(tuple(states)).names
            priced["output_price"] = checks.order_by_name(self.output_price, "output_price", names, 0.0)
        if isinstance(self.R_rows, Mapping):
            priced["R_rows"] = bounds.order_bound(self.R_rows, "R_rows", inputs, 0.0)
        if isinstance(self.Q_rows, Mapping):
            priced["Q_rows"] = bounds.order_bound(self.Q_rows, "Q_rows", self.of.bind(tuple(states)).names, 0.0)
        if callable(self.stage):
            priced["stage"] = trace_stage(self.stage, len(states), len(inputs))
        if not fields:
            return replace(self, **priced) if priced else self
        known = {"Q": self.of.bind(tuple(states)).names if "Q" in fields else ()}
        omitted = {"Q": 0.0, "R": None, "R_delta": 0.0}
        return replace(
            self,
            **{
                name: checks.order_by_name(value, name, known.get(name, inputs), omitted[name])
                for name, value in fields.items()
            },
            **priced,
        )

    def matrices(self, nr: int, nu: int) -> tuple[Float[np.ndarray, "nr nr"], Float[np.ndarray, "nu nu"]]:
        """Return Q (nr, nr) and R (nu, nu) for `nr` tracked outputs and `nu` inputs."""
        return checks.weight(self.Q, "Q", nr), checks.weight(self.R, "R", nu)

    def given_inputs(self, nu: int) -> Float[np.ndarray, "T nu"] | None:
        """Return the rows of a u_target that is given as numbers, None for one by name.

        Raises
        ------
        ShapeError
            The rows have another number of inputs.
        """
        if isinstance(self.u_target, str):
            return None
        rows = np.atleast_2d(np.asarray(self.u_target, dtype=np.float64))
        if rows.shape[1] != nu:
            raise ShapeError(
                f"u_target has shape {np.shape(self.u_target)}, expected ({nu},) or rows (k, {nu}), one value an input"
            )
        return rows

    def price_rows(self, nu: int, first: int, count: int) -> Float[np.ndarray, "count nu"]:
        """Return the prices of the inputs of `count` steps from `first` on; the last row is held."""
        return bounds.hold_rows(cast("ArrayLike | None", self.price), "price", nu, first, count, 0.0)

    @property
    def weighs_in_time(self) -> bool:
        """Whether Q or R have rows in time."""
        return self.Q_rows is not None or self.R_rows is not None

    def weight_rows(
        self, nr: int, nu: int, first: int, count: int
    ) -> tuple[Float[np.ndarray, "count nr"], Float[np.ndarray, "count nu"]]:
        """Return the diagonals that weigh x_k, and u_k, of `count` steps from `first` on; the last rows are held."""
        Q, R = self.matrices(nr, nu)
        tables: list[Float[np.ndarray, "count n"]] = []
        for name, weight in (("Q_rows", Q), ("R_rows", R)):
            rows = getattr(self, name)
            rows = weight.diagonal() if rows is None else rows
            tables.append(bounds.hold_rows(cast("ArrayLike", rows), name, len(weight), first, count, 0.0))
        return tables[0], tables[1]

    def find_pull(self, nr: int) -> Float[np.ndarray, " nr"] | None:
        """Return −½ Q⁻¹ q, by which an output price moves the rows that cost nothing; None without one.

        ‖y − r‖²_Q + qᵀy = ‖y − r + ½ Q⁻¹ q‖²_Q + const.

        Raises
        ------
        DataError
            Q does not weigh a priced output.
        ShapeError
            There is not one number for each tracked output.
        """
        if self.output_price is None:
            return None
        q = checks.array(cast("ArrayLike", self.output_price), "output_price", (nr,))
        Q = checks.weight(self.Q, "Q", nr)
        pull = -0.5 * np.linalg.pinv(Q, hermitian=True) @ q
        missed = np.abs(2.0 * Q @ pull + q)
        if (missed > 1e-9 * np.abs(q).max()).any():
            i = int(missed.argmax())
            raise DataError(
                f"tracked output {i} has the price {q[i]:g} and no weight in Q, so its plan may have no end; give it a"
                " Q above zero, or pass the price as a stage= to a BilinearMPC"
            )
        return pull

    def find_shift(self, nu: int) -> Float[np.ndarray, "T nu"] | None:
        """Return −½ R⁻¹ p, by which a price moves the inputs that cost nothing, a row a step; None without a price.

        ‖u − u_r‖²_R + pᵀu = ‖u − u_r + ½ R⁻¹ p‖²_R + const.

        Raises
        ------
        DataError
            R is not positive definite.
        """
        if self.price is None:
            return None
        price = np.asarray(self.price)
        steps = len(price) if price.ndim == 2 else 1
        R = checks.weight(self.R, "R", nu)
        if np.linalg.eigvalsh(R).min() <= 0:
            raise DataError("a price needs an R above zero for every input, by which it is paid back; raise R")
        return -0.5 * np.linalg.solve(R, self.price_rows(nu, 0, steps).T).T

    def rate(self, nu: int) -> Float[np.ndarray, "nu nu"] | None:
        """Return R_delta (nu, nu), None where the changes of the inputs cost nothing."""
        if self.R_delta is None:
            return None
        R_delta = checks.weight(self.R_delta, "R_delta", nu)
        return R_delta if R_delta.any() else None


class Sizes(NamedTuple):
    """The sizes of states, inputs and limited rows [x; of(x)], and the scale of the cost, by which units mean nothing.

    The size of a row is the first of these that is known: half the width between two finite limits; half the range of
    the model's data; the value whose cost by Q is the mean cost of the tracked rows of known size; |limit|; 1. States
    without a limit have a size by the same rule. That of an input is half the width of its limits, or else the value
    whose cost by R is the scale of the cost. This scale is the largest cost in a step of a tracked output or an input
    at its known size.
    """

    states: Float[np.ndarray, " nx"]
    inputs: Float[np.ndarray, " nu"]
    rows: Float[np.ndarray, " n"]
    scale: float

    @staticmethod
    def of(
        tracked: Lifting,
        Q: Float[np.ndarray, "nr nr"],
        R: Float[np.ndarray, "nu nu"],
        limits: Limits,
        states: Sequence[str],
        ranges: Mapping[str, float] | None,
    ) -> "Sizes":
        """Return the sizes under the weights of a cost and limits; `ranges` are half of those of the data, by name."""
        nu, known = len(R), dict(ranges or {})
        names = [*states, *(() if limits.of is None else limits.of.bind(states).names)]
        ends, inputs = limits.ends(len(states), len(names) - len(states)), limits.inputs(nu)
        known |= {name: float(half) for name, half in zip(names, half_width(ends), strict=True) if half > 0}
        weights = dict(zip(tracked.names, Q.diagonal(), strict=True))
        widths = half_width(inputs)
        prices = [weights[name] * known[name] ** 2 for name in tracked.names if known.get(name, 0.0) > 0]
        priced = [price for price in (*prices, *(R.diagonal() * widths**2)) if price > 0]
        far = {name: float(end) for name, end in zip(names, magnitude(ends), strict=True) if end > 0}
        if not priced:
            priced = [weights[name] * end**2 for name, end in far.items() if weights.get(name, 0.0) > 0]
        scale = max(priced or [*weights.values(), *R.diagonal()]) or 1.0
        mean = float(np.mean([price for price in prices if price > 0] or [scale]))
        alike = {name: np.sqrt(mean / weight) for name, weight in weights.items() if weight > 0}
        found = {**far, **alike, **known}
        rows = np.array([found.get(name, 1.0) for name in names])
        by_cost = np.sqrt(scale / np.where(R.diagonal() > 0, R.diagonal(), scale))
        return Sizes(rows[: len(states)], np.where(widths > 0, widths, by_cost), rows, float(scale))


def data_ranges(model: LinearPredictor | BilinearPredictor) -> dict[str, float]:
    """Return half the range of the data behind a model by the names of states and observables, if they are known.

    It is √3 standard deviations, those of uniform data, from the triangular factor of the lifted data. What is constant
    in the data has none.
    """
    if model.scale is None:
        return {}
    rows = np.vstack([np.eye(model.nz), model.C])
    seen, constant = model.scale @ rows.T, model.lifting.constant_index
    squares = np.einsum("ij,ij->j", seen, seen)
    mean = np.zeros(len(rows)) if constant is None else model.scale[:, constant] @ seen
    spread = squares - mean**2
    known = spread > _CONSTANT * squares
    half = np.sqrt(3 * np.where(known, spread, 0.0))
    names = [*model.lifting.names, *model.states]
    return {name: float(value) for name, value in zip(names, half, strict=True) if value > 0}


@dataclass(frozen=True)
class Tracking(Generic[Read]):
    """The weights and limits of a cost and its limits, on what `tracked` and `limited` read from the model's state.

    Both are matrices (nr, nz) and (ng, nz) on a lifted state, or functions of x. Rows without a limit are left out.
    `softness` says what it costs to leave `outputs`, row by row; a linear weight of inf makes a row hard. `margin`
    moves `outputs` inwards, see `Limits`. R_delta is None without a weight of input changes, `rates` without a limit;
    `with_rates` says whether there is either. `hard_rates` are those of `SizedLimits`. `given` are the rows of a
    u_target that is given as numbers, None for one by name. `Q_root` and `R_root` are S with SᵀS = Q and R. `sizes` are
    those of states, inputs, limits and cost. Where limits have rows, all these are of their widest values, and
    `movable` says which inputs, rates and outputs [x; of(x)] have a limit, or may get one. `shift` is what a price adds
    to u_r, `pull` what an output price adds to the reference; `weighed` says that weights move in time.
    """

    cost: Cost
    limits: Limits
    tracked: Read
    limited: Read
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    R_delta: Float[np.ndarray, "nu nu"] | None
    inputs: Interval
    rates: Interval | None
    hard_rates: Interval | None
    rate_softness: Softness
    outputs: Interval
    softness: Softness
    margin: Float[np.ndarray, "K ng"]
    with_rates: bool
    given: Float[np.ndarray, "T nu"] | None
    Q_root: Float[np.ndarray, "nr nr"]
    R_root: Float[np.ndarray, "nu nu"]
    sizes: Sizes
    movable: Movable
    shift: Float[np.ndarray, "prices nu"] | None
    pull: Float[np.ndarray, " nr"] | None
    weighed: bool


LiftedTracking: TypeAlias = Tracking[np.ndarray]
StateTracking: TypeAlias = Tracking[ca.Function]


def lifted_tracking(
    predictor: LinearPredictor, cost: Cost, limits: Limits | None, *, in_time: bool = False
) -> LiftedTracking:
    """Return what `cost` tracks and `limits` bound, as matrices on the lifted coordinates of `predictor`.

    `in_time` says that who asks knows limits and weights with rows, and prices of inputs.

    Raises
    ------
    DataError
        Limits or weights have rows in time, or the cost has a price, and who asks does not know them; or
        ``cost.beyond`` is "motion".
    ObservableError
        The cost or a limit is on an observable that the lifting lacks.
    ShapeError
        A weight or a limit has another size than what it weighs or limits.
    """
    cost, limits = check_cost_and_limits(cost, limits, predictor.states, predictor.inputs)
    if not in_time:
        refuse_steps(cost, limits)
    who = "a controller on a linear model" if in_time else "a law with one gain for all steps"
    refuse_stage(cost, who, in_time=in_time)
    if cost.beyond == "motion":
        raise DataError(
            'beyond="motion" needs a BilinearMPC or a NonlinearMPC; leave it out, or pass more reference rows'
        )
    C, G = select_rows(predictor, cost.of), predictor.C
    if limits.of is not None:
        G = np.vstack([G, select_rows(predictor, limits.of)])
    states, nu, ranges = predictor.states, predictor.nu, data_ranges(predictor)
    return _tracking(C, lambda kept: np.ascontiguousarray(G[kept]), cost, limits, len(C), states, nu, ranges)


@raise_swallowed()
def state_tracking(
    states: tuple[str, ...],
    inputs: tuple[str, ...],
    cost: Cost,
    limits: Limits | None,
    size: int | None = None,
    ranges: Mapping[str, float] | None = None,
    *,
    in_time: bool = False,
) -> StateTracking:
    """Return what `cost` tracks and `limits` bound, as functions of these states.

    The functions take `size` values, the states first; by default the states alone. `ranges` as for `Sizes`,
    `in_time` as for `lifted_tracking`.
    """
    cost, limits = check_cost_and_limits(cost, limits, states, inputs)
    if not in_time:
        refuse_steps(cost, limits)
    nx, nu = len(states), len(inputs)
    point = ca.SX.sym("x", nx if size is None else size)
    x, of = point[:nx], cost.of.bind(states)
    bound = None if limits.of is None else limits.of.bind(states)
    values = x if bound is None else ca.vertcat(x, bound.symbolic(x))
    return _tracking(
        ca.Function("tracked", [point], [ca.densify(of.symbolic(x))]),
        lambda kept: ca.Function("limited", [point], [ca.densify(values[np.flatnonzero(kept).tolist(), 0])]),
        cost,
        limits,
        of.nz,
        states,
        nu,
        ranges,
    )


def add_held(
    first: Float[np.ndarray, "K nu"] | None, second: Float[np.ndarray, "M nu"] | None
) -> Float[np.ndarray, "T nu"] | None:
    """Return the sum of two tables whose last rows are held; None where neither is there."""
    if first is None or second is None:
        return second if first is None else first
    steps = np.arange(max(len(first), len(second)))
    return first[np.minimum(steps, len(first) - 1)] + second[np.minimum(steps, len(second) - 1)]


def refuse_steps(cost: Cost, limits: Limits) -> None:
    """Raise where limits have rows in time or inputs a price, for a law or a search that knows neither.

    Raises
    ------
    DataError
        There is one of the two.
    """
    if limits.in_time:
        end = next(iter(limits.count_rows()))
        raise DataError(
            f"{end} has a row for each step, which this controller or search does not know; pass limits.at(step), or "
            "take a KoopmanMPC, a LinearMPC, a BilinearMPC or a NonlinearMPC"
        )
    if cost.price is not None or cost.output_price is not None:
        raise DataError(
            "the cost has a price, which this controller or search does not know; take a KoopmanMPC, a BilinearMPC or "
            "a NonlinearMPC, or leave the price out"
        )


def refuse_stage(cost: Cost, who: str, *, in_time: bool = False) -> None:
    """Raise where the cost has a stage of its own, or weights in time that who asks does not know.

    Raises
    ------
    DataError
        It has one of the two.
    """
    if cost.weighs_in_time and not in_time:
        raise DataError(
            f"the cost has rows of weights in time, which {who} does not know; take a KoopmanMPC, a LinearMPC, a "
            "BilinearMPC or a NonlinearMPC, or leave Q_rows and R_rows out"
        )
    if cost.stage is not None:
        raise DataError(
            f"the cost has a stage of its own, which {who} does not know; take a BilinearMPC or a NonlinearMPC, or "
            "leave stage out"
        )


def _tracking(
    tracked: Read,
    limited: Callable[[Bool[np.ndarray, " n"]], Read],
    cost: Cost,
    limits: Limits,
    nr: int,
    states: Sequence[str],
    nu: int,
    ranges: Mapping[str, float] | None,
) -> Tracking[Read]:
    """Return the weights and limits of nr tracked outputs of a model with these states and so many inputs.

    `limited` makes the map of those outputs that have a limit.

    Raises
    ------
    DataError
        A row of u_target is outside the limits of the inputs.
    """
    if nu == 0:
        raise DataError("the model has no inputs, so there is nothing to control; fit it on episodes with U")
    nx = len(states)
    if cost.weighs_in_time:
        cost.weight_rows(nr, nu, 0, 1)  # checks their sizes
    (Q, R), R_delta, rows = cost.matrices(nr, nu), cost.rate(nu), cost.given_inputs(nu)
    base = limits.base
    sizes = Sizes.of(cost.of.bind(states), Q, R, base, states, ranges)
    sized = base.find_sizes(nx, len(sizes.rows) - nx, nu, sizes.rows, sizes.scale)
    low, high = sized.inputs
    if rows is not None:
        reach = 1e-9 * np.maximum(np.abs(rows), np.abs(rows).max(axis=0))
        outside = np.argwhere((rows < low - reach) | (rows > high + reach))
        if len(outside):
            k, i = outside[0]
            raise DataError(
                f"u_target is {rows[k, i]:g} for input {i} in row {k}, outside its limits {low[i]:g} … {high[i]:g};"
                " pass inputs that the limits allow"
            )
    return Tracking(
        cost=cost,
        limits=limits,
        tracked=tracked,
        limited=limited(sized.rows.kept),
        Q=Q,
        R=R,
        R_delta=R_delta,
        inputs=sized.inputs,
        rates=sized.rates,
        hard_rates=sized.hard_rates,
        rate_softness=sized.rate_softness,
        outputs=sized.rows.box,
        softness=sized.rows.softness,
        margin=sized.rows.margin,
        with_rates=R_delta is not None or sized.rates is not None,
        given=rows,
        Q_root=checks.root(Q),
        R_root=checks.root(R),
        sizes=sizes,
        movable=base.movable(nx, len(sizes.rows) - nx, nu),
        shift=cost.find_shift(nu),
        pull=cost.find_pull(nr),
        weighed=cost.weighs_in_time,
    )


def select_rows(predictor: LinearPredictor, of: Lifting) -> Float[np.ndarray, "nr nz"]:
    """Return the matrix that reads the observables `of` from z: the predictor's own C for states."""
    wanted = of.bind(predictor.states)
    if isinstance(wanted, State):
        return predictor.C[wanted.state_indices]
    return np.eye(predictor.nz)[find_observables(predictor.lifting, wanted)]


def check_cost_and_limits(
    cost: object, limits: object, states: Sequence[str], inputs: Sequence[str]
) -> tuple[Cost, Limits]:
    """Return the cost and the limits of a plant with these names, no limits for None.

    Raises
    ------
    DataError
        One is something else, perhaps the other; or names a signal that the plant does not have.
    """
    if not isinstance(cost, Cost):
        raise DataError(f"cost is {checks.article(cost)}; pass a Cost, and the Limits after it")
    if limits is None:
        limits = Limits()
    elif not isinstance(limits, Limits):
        raise DataError(f"limits is {checks.article(limits)}; pass Limits, or None for none")
    if callable(cost.stage) or any(isinstance(v, Mapping) for v in (*vars(cost).values(), *vars(limits).values())):
        cost, limits = cost.resolve(states, inputs), limits.resolve(states, inputs)
    return _drop_constant_rows(cost, states, inputs), limits


def _drop_constant_rows(cost: Cost, states: Sequence[str], inputs: Sequence[str]) -> Cost:
    """Return the cost without rows that are all the diagonal of their weight, so that plans are alike to the bit.

    Raises
    ------
    ShapeError
        Such rows are not as long as what is tracked, or the inputs.
    """
    dropped: dict[str, None] = {}
    for name, given in (("Q_rows", cost.Q), ("R_rows", cost.R)):
        rows, weight = getattr(cost, name), np.asarray(given, dtype=np.float64)
        if rows is not None:
            diagonal = weight.diagonal() if weight.ndim == 2 else weight
            same = diagonal.size in (1, np.shape(rows)[-1]) and bool((np.asarray(rows) == diagonal).all())
            if same:
                size = len(inputs) if name == "R_rows" else len(cost.of.bind(tuple(states)).names)
                bounds.hold_rows(cast("ArrayLike", rows), name, size, 0, 1, 0.0)
                dropped[name] = None
    return replace(cost, **dropped) if dropped else cost
