"""Tracking: what a cost tracks and limits bound of one model, all in its sizes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeAlias, TypeVar

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import block_diag

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.control.ask.bounds import SOFTENED, SizedLimits, spread_prices
from koopmpc.control.ask.cost import Cost, check_cost_and_limits, refuse_stage, refuse_steps
from koopmpc.control.ask.levels import InputLevels
from koopmpc.control.ask.limits import LINEAR, QUADRATIC, Interval, Limits, Movable, Softness, half_width, magnitude
from koopmpc.control.ask.terminal import HasTerminalSet, TerminalSet, read_terminal_set, require_size
from koopmpc.lifting.base import Lifting, find_observables
from koopmpc.lifting.state import State
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor

_CONSTANT = 1e-12  # share of the mean square below which a variance is rounding
Read = TypeVar("Read", np.ndarray, ca.Function)


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
        nu, known, limits = len(R), dict(ranges or {}), limits.base
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
    moves `outputs` inwards, see `Limits`. Without a weight of input changes R_delta is None; without a limit of
    them `rates` is None; `with_rates` says whether there is either. `hard_rates` are those of `SizedLimits`.
    `given` are the rows of a u_target that is given as numbers, None for one by name. `Q_root` and `R_root` are S
    with SᵀS = Q and R. `sizes` are those of states, inputs, limits and cost. Where limits have rows, all these are
    of their widest values, and `movable` says which inputs, rates and outputs [x; of(x)] have a limit, or may get
    one. `levels` are those of the inputs. `shift` is what a price adds to u_r, `pull` what an output price adds to
    the reference; `weighed` says that weights move in time.
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
    levels: InputLevels | None
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


def size_limits(limits: Limits, nx: int, ny: int, nu: int, sizes: Float[np.ndarray, " n"], scale: float) -> SizedLimits:
    """Return all limits of a model, `sizes` those of [x; of(x)], `scale` that of the cost; ny is 0 without `of`."""
    rows, rates, softness = limits.find_rows(nx, ny, sizes, scale), limits.rates(nu), limits.rate_softness(nu)
    hard = np.isinf(softness.linear)
    hard_rates = None
    if rates is not None and hard.any():
        hard_rates = Interval(np.where(hard, rates.low, -np.inf), np.where(hard, rates.high, np.inf))
    return SizedLimits(limits.inputs(nu), rates, hard_rates, softness, rows)


def soften_end(limits: Limits, count: int, scale: float = 1.0) -> Softness:
    """Return how soft the `count` rows of the terminal set are, of which 1 is the size of the set."""
    if isinstance(limits.terminal_slack, str):
        linear, quadratic = np.full(count, LINEAR * scale), np.full(count, QUADRATIC * scale)
    else:
        linear, quadratic = spread_prices(
            limits.terminal_slack, "terminal_slack", count, "one a row of the terminal set"
        )
    return Softness(linear, quadratic, np.full(count, SOFTENED))


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
    """
    if nu == 0:
        raise DataError("the model has no inputs, so there is nothing to control; fit it on episodes with U")
    nx = len(states)
    if cost.weighs_in_time:
        cost.weight_rows(nr, nu, 0, 1)  # checks their sizes
    (Q, R), R_delta, rows = cost.matrices(nr, nu), cost.rate(nu), cost.given_inputs(nu)
    shift, pull = cost.find_shift(nu), cost.find_pull(nr)
    sizes, base = Sizes.of(cost.of.bind(states), Q, R, limits, states, ranges), limits.base
    sized = size_limits(base, nx, len(sizes.rows) - nx, nu, sizes.rows, sizes.scale)
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
        levels=base.input_levels(nu),
        shift=shift,
        pull=pull,
        weighed=cost.weighs_in_time,
    )


def select_rows(predictor: LinearPredictor, of: Lifting) -> Float[np.ndarray, "nr nz"]:
    """Return the matrix that reads the observables `of` from z: the predictor's own C for states."""
    wanted = of.bind(predictor.states)
    if isinstance(wanted, State):
        return predictor.C[wanted.state_indices]
    return np.eye(predictor.nz)[find_observables(predictor.lifting, wanted)]


class EndRows(NamedTuple):
    """F ξ_N − F c on ξ_N = z_N, or [z_N; u_{N−1}]: below 1 row by row, or below 1 in norm where it is a `ball`.

    `places` (n, nz) reads the coordinates of the set `of` from z, of which the entry `constant` is 1.
    """

    F: Float[np.ndarray, "p nx"]
    offset: Float[np.ndarray, " p"]
    ball: bool
    of: TerminalSet
    places: Float[np.ndarray, "n nz"]
    constant: int | None


def read_end(given: TerminalSet | HasTerminalSet, predictor: LinearPredictor) -> EndRows:
    """Return the rows of a terminal set on the lifted state of a predictor."""
    wanted, names, nz, nu = read_terminal_set(given), predictor.states, predictor.nz, predictor.nu
    if wanted.of is None:
        E = np.eye(nz)
    else:
        bound = wanted.of.bind(names)
        whole = np.eye(nz)
        E = (
            predictor.C[bound.state_indices]
            if isinstance(bound, State)
            else whole[find_observables(predictor.lifting, bound)]
        )
    places = E if wanted.kept is None else E[list(wanted.kept)]
    E = block_diag(places, np.eye(nu)) if wanted.with_input else places
    F, center = wanted.rows, np.asarray(wanted.center)
    require_size(len(center), len(E))
    return EndRows(F @ E, -F @ center, wanted.is_ellipsoid, wanted, places, predictor.lifting.constant_index)
