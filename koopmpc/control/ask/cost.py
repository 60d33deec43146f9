"""The quadratic Cost that every controller and every metric shares, and its checks against a plant and a controller."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, TypeAlias, cast, runtime_checkable

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value
from koopmpc.control.ask import bounds
from koopmpc.control.ask.bounds import Bound
from koopmpc.control.ask.checks import COST_CHECKS, refuse_contradictions
from koopmpc.control.ask.limits import Limits
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.state import State
from koopmpc.plants.graph import Graph

StageCost: TypeAlias = Callable[[ca.SX, ca.SX], Any] | Graph
_OF_OUTPUTS = ("Q", "Q_rows", "output_price")
_BY_NAME = (*_OF_OUTPUTS, "R", "R_rows", "R_delta", "price")


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
        What a reference does after the rows that a step is given. "rest": the last row stays, as with all linear
        controllers. "motion" is the default of BilinearMPC and NonlinearMPC without Q_N, tail and given u_target. Where
        the last rows still move, the end follows the linear recurrence of these rows, such as a sine or a ramp; without
        one it weighs x_N from the last row; where no linear loop can follow, it has no tail.

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
        for name, check in COST_CHECKS.items():
            value = getattr(self, name)
            if value is not None or name in ("of", "u_target"):
                object.__setattr__(self, name, check(value, name))
        refuse_contradictions(self)

    @property
    def moves_on(self) -> bool:
        """Whether the end of a plan follows a reference that moves at its last row."""
        return self.beyond != "rest" and self.Q_N is None and self.tail is None

    def resolve(self, states: Sequence[str], inputs: Sequence[str]) -> "Cost":
        """Return the cost with arrays in place of weights by name, and a graph in place of the function `stage`.

        Raises
        ------
        DataError
            A name is unknown or fits two, or R does not name every input; `stage` cannot be written as a graph.
        """
        named = [name for name in _BY_NAME if isinstance(getattr(self, name), Mapping)]
        outputs = self.of.bind(tuple(states)).names if any(name in _OF_OUTPUTS for name in named) else ()
        ordered: dict[str, Any] = {}
        for name in named:
            names, by_name = outputs if name in _OF_OUTPUTS else inputs, getattr(self, name)
            if name in ("Q", "R", "R_delta", "output_price"):
                ordered[name] = checks.order_by_name(by_name, name, names, None if name == "R" else 0.0)
            else:
                ordered[name] = bounds.order_bound(by_name, name, names, 0.0)
        if callable(self.stage):
            ordered["stage"] = trace_stage(self.stage, len(states), len(inputs))
        return replace(self, **ordered) if ordered else self

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


@raise_swallowed()
def trace_stage(stage: StageCost, nx: int, nu: int) -> Graph:
    """Return the graph of ℓ(x, u), a number, of nx states and nu inputs."""
    if isinstance(stage, Graph):
        if (stage.n, stage.m) != (nx + nu, 1):
            raise ShapeError(
                f"stage is of {stage.n} states and inputs together, and the plant has {nx} and {nu}; pass the function"
                " of this plant"
            )
        return stage
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    try:
        value = ca.SX(stage(x, u))
    except (RuntimeError, TypeError, ValueError, IndexError, NotImplementedError, AttributeError) as error:
        raise DataError(
            f"stage(x, u) raised {type(error).__name__}: {error}; write it with CasADi's functions of x ({nx} states)"
            f" and u ({nu} inputs), for example lambda x, u: x[0] ** 2 + 0.3 * u[0]"
        ) from error
    if value.shape != (1, 1):
        raise ShapeError(f"stage(x, u) has shape {value.shape}, expected one number")
    own = ca.vertcat(x, u)
    free = [str(symbol) for symbol in ca.symvar(value) if not ca.depends_on(symbol, own)]
    if free:
        raise DataError(f"stage(x, u) holds the symbol {free[0]}, which is neither of its arguments; pass a number")
    return Graph.trace(ca.Function("stage", [own], [ca.densify(value)]))


def evaluate_stage(
    stage: StageCost, X: Float[np.ndarray, "T nx"], U: Float[np.ndarray, "T nu"]
) -> Float[np.ndarray, " T"]:
    """Return ℓ(x_k, u_k) row by row."""
    return trace_stage(stage, X.shape[1], U.shape[1]).evaluate(np.hstack([X, U]))[:, 0]


def refuse_steps(cost: Cost, limits: Limits) -> None:
    """Raise where limits have rows in time or inputs a price, for a law or a search that knows neither."""
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
    """Raise where the cost has a stage of its own, or weights in time that who asks does not know."""
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


def check_cost_and_limits(
    cost: object, limits: object, states: Sequence[str], inputs: Sequence[str]
) -> tuple[Cost, Limits]:
    """Return the cost and the limits of a plant with these names, no limits for None."""
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
    """Return the cost without rows that are all the diagonal of their weight, so that plans are alike to the bit."""
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
