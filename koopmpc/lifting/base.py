"""The base class of liftings z = ψ(x), their sums and products, and the traced form in which a file holds a user's.

A lifting is a frozen rule ("all monomials up to degree 3"). `bind` gives it the names of the states and so
its size; from then on it evaluates arrays (`lifting(X)`) and CasADi symbols (`lifting.symbolic(x)`), the
same function twice.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import accumulate
from operator import index
from typing import Any, ClassVar, cast

import casadi as ca
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError, ObservableError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value
from koopmpc.plants.graph import Graph
from koopmpc.plants.routines import Buffered

Indices = Int[np.ndarray, " n"]
CONSTANT = "1"  # the name of the observable that is always 1
_BLOCK = 1024  # evaluate about so many rows at once: their observables then stay in the cache


def strip_unit(state: str) -> str:
    """Return the name of a state without its unit: ``"theta [rad]"`` is ``"theta"``."""
    return state.split(" [")[0]


@dataclass(frozen=True, eq=False)
class Lifting(Value, ABC):
    """Observables z = ψ(x), x in R^nx, z in R^nz.

    A user's own family is a frozen dataclass with `observables` and `formula`; arrays and files then use the traced
    formula. A family that `km.train` may tune lists its tuned fields in `tunable`: "positive" for a field that must
    stay above zero, else "real". Its `formula` must then accept CasADi symbols in place of these fields.
    """

    tunable: ClassVar[Mapping[str, str]] = {}
    bound: tuple[str, ...] | None = field(default=None, kw_only=True)  # names of the states, once known

    @abstractmethod
    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the observables on states of these names; raise if the states do not fit."""

    @abstractmethod
    def formula(self, x: ca.SX) -> ca.SX:
        """Return ψ(x) as a column, in CasADi operations."""

    def bind(self, states: Sequence[str]) -> "Lifting":
        """Return a copy bound to states of these names; it knows its size.

        Raises
        ------
        DataError
            Two states or two observables have one name.
        ShapeError
            The lifting is made for another number of states.
        """
        inner = {
            name: tuple(part.bind(states) for part in value) if isinstance(value, tuple) else value.bind(states)
            for name, value in self.inner_liftings().items()
        }
        bound = replace(self, **inner, bound=tuple(states))
        _ = bound.names
        return bound

    def inner_liftings(self) -> "dict[str, Lifting | tuple[Lifting, ...]]":
        """Return the fields that hold a lifting or a tuple of liftings, by name."""
        values: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        return {
            name: value
            for name, value in values.items()
            if isinstance(value, Lifting) or (isinstance(value, tuple) and value and isinstance(value[0], Lifting))
        }

    @property
    def bound_states(self) -> tuple[str, ...]:
        """Names of the states that the lifting is bound to."""
        if self.bound is None:
            raise DataError(
                f"{type(self).__name__} does not know its states yet; call .bind(states) or pass it to edmd"
            )
        return self.bound

    @property
    def nz(self) -> int:
        """Number of observables."""
        return len(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the observables, each once."""
        return self._names

    @cached_property
    def constant_index(self) -> int | None:
        """Index of the observable ``"1"``, which is always 1; None if the lifting holds no `Constant`."""
        return self.names.index(CONSTANT) if CONSTANT in self.names else None

    def __call__(self, X: ArrayLike) -> Float[np.ndarray, "..."]:
        """Return Z = ψ(X), row by row.

        Parameters
        ----------
        X
            States, (M, nx) or (nx,).

        Returns
        -------
        Z
            Observables, (M, nz) or (nz,).
        """
        rows = checks.array(X, "x", finite=False)
        nx = len(self.bound_states)
        if rows.ndim not in (1, 2) or rows.shape[-1] != nx:
            raise ShapeError(self._misfit(rows.shape[-1] if rows.ndim in (1, 2) else rows.shape))
        table = rows.reshape(-1, nx)
        Z = np.empty((len(table), self.nz))
        self.lift_into(table, Z)
        return Z if rows.ndim == 2 else Z[0]

    def symbolic(self, x: ca.SX) -> ca.SX:
        """Return ψ(x), (nz, 1), for a symbolic column x, (nx, 1)."""
        if x.shape != (len(self.bound_states), 1):
            raise ShapeError(self._misfit(x.shape[0] if x.shape[1] == 1 else x.shape))
        z = self.formula(x)
        if z.shape != (self.nz, 1):
            raise ShapeError(
                f"{type(self).__name__}.formula returns shape {z.shape}, but names {self.nz} observables; "
                f"return a column of {self.nz}"
            )
        return z

    @raise_swallowed()
    def guarded_function(self) -> ca.Function:
        """Return ψ as a CasADi function of one state; its result is NaN if an entry of x is NaN or beyond 1e30."""
        x = ca.SX.sym("x", len(self.bound_states))
        guarded = ca.if_else(ca.sum1(ca.fabs(x)) < HUGE, 1.0, np.nan) * x
        return ca.Function("psi", [x], [ca.densify(self.symbolic(guarded))], {"cse": True})

    def __add__(self, other: "Lifting") -> "Lifting":
        """Return the observables of both liftings, one under the other; a name that both have occurs once."""
        other = check_lifting(other)
        parts = [part for side in (self, other) for part in (side.parts if isinstance(side, Sum) else (side,))]
        total, bound = Sum(tuple(parts)), self._common(other)
        return total if bound is None else total.bind(bound)

    def __mul__(self, other: "Lifting") -> "Lifting":
        """Return all products of this lifting's observables with the other's."""
        product = Product(self, check_lifting(other))
        bound = self._common(other)
        return product if bound is None else product.bind(bound)

    def as_saved(self) -> Value:
        """Return the lifting itself, or the traced formula of a class that is not koopmpc's own."""
        if self.is_registered():
            return self
        return Traced(self._graph, self.names, bound=self.bound_states)

    def lift_into(self, X: Float[np.ndarray, "M nx"], Z: Float[np.ndarray, "M nz"]) -> None:
        """Write ψ of the rows of X into the rows of Z, a block at a time; nothing is checked."""
        rows = -(-len(X) // max(round(len(X) / _BLOCK), 1))
        for first in range(0, len(X), max(rows, 1)):
            block = slice(first, first + rows)
            self._fill(np.ascontiguousarray(X[block].T), Z[block])

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        """Write ψ of the columns of x into the rows of Z."""
        self._graph.run(x, Z.T, self._graph.scratch(x.shape[1]))

    @cached_property
    @raise_swallowed()
    def _graph(self) -> Graph:
        x = ca.SX.sym("x", len(self.bound_states))
        return Graph.trace(ca.Function("lifting", [x], [self.symbolic(x)]))

    @cached_property
    def _names(self) -> tuple[str, ...]:
        for names, what in ((self.bound_states, "states"), (self.observables(self.bound_states), "observables")):
            repeated = [name for name, n in Counter(names).items() if n > 1]
            if repeated:
                raise DataError(f"{type(self).__name__}: two {what} are named {repeated[0]!r}; rename one")
        return self.observables(self.bound_states)

    def _common(self, other: "Lifting") -> tuple[str, ...] | None:
        """Return the states to which one of the two is bound, or None if neither is bound."""
        if None not in (self.bound, other.bound) and self.bound != other.bound:
            raise DataError(f"the liftings are bound to other states: {self.bound} and {other.bound}")
        return self.bound if other.bound is None else other.bound

    def _misfit(self, got: object) -> str:
        what = f"has {got} states" if isinstance(got, int) else f"has shape {got}"
        return f"x {what}, the lifting was bound to {len(self.bound_states)} ({', '.join(self.bound_states)})"


@dataclass(frozen=True, eq=False)
class Sum(Lifting):
    """ψ(x) = [ψ₁(x); ψ₂(x); …], written ``a + b``; an observable whose name an earlier part has is left out."""

    parts: tuple[Lifting, ...]

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of all parts, each once."""
        return tuple(dict.fromkeys(name for part in self.parts for name in part.names))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the new observables of each part, one under the other."""
        columns = [part.formula(x) for part in self.parts]
        return ca.vertcat(*(z[int(i)] for z, new in zip(columns, self._new, strict=True) for i in new))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        ends = accumulate(len(new) for new in self._new)
        for part, new, end in zip(self.parts, self._new, ends, strict=True):
            columns = Z[:, end - len(new) : end]
            if len(new) == part.nz:
                part._fill(x, columns)
            elif len(new):
                whole = np.empty((len(Z), part.nz))
                part._fill(x, whole)
                columns[:] = whole[:, new]

    @cached_property
    def _new(self) -> tuple[Indices, ...]:
        """For each part the indices of the observables that no earlier part names."""
        earlier: set[str] = set()
        new: list[Indices] = []
        for part in self.parts:
            new.append(np.array([i for i, name in enumerate(part.names) if name not in earlier], dtype=np.intp))
            earlier.update(part.names)
        return tuple(new)


@dataclass(frozen=True, eq=False)
class Product(Lifting):
    """ψ(x) = aᵢ(x) bⱼ(x) for every i and j; written ``a * b``.

    Equal products, such as x₁ x₂ and x₂ x₁, occur once. A name lists its factors in one order, states first and
    without units, so ``State() * State()`` has the names of ``Monomials(2)``.
    """

    first: Lifting
    second: Lifting

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"omega*sin(theta)"`` and ``"theta^2"``."""
        return tuple(self._pairs)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the products; the index of the second lifting runs fastest."""
        a, b = self.first.formula(x), self.second.formula(x)
        return ca.vertcat(*(a[int(i)] * b[int(j)] for i, j in self._pairs.values()))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        a, b = np.empty((len(Z), self.first.nz)), np.empty((len(Z), self.second.nz))
        self.first._fill(x, a)
        self.second._fill(x, b)
        left, right = np.array(list(self._pairs.values()), dtype=np.intp).T
        np.multiply(a[:, left], b[:, right], out=Z)

    @cached_property
    def _pairs(self) -> dict[str, tuple[int, int]]:
        """Indices of the two factors by the name of their product; of equal names the first pair counts."""
        plain = [strip_unit(state) for state in self.bound_states]
        names = plain if len(set(plain)) == len(plain) else list(self.bound_states)
        order = {state: (i, name) for i, (state, name) in enumerate(zip(self.bound_states, names, strict=True))}
        pairs: dict[str, tuple[int, int]] = {}
        for i, left in enumerate(self.first.names):
            for j, right in enumerate(self.second.names):
                pairs.setdefault(_name_product(left, right, order), (i, j))
        return pairs


def _name_product(left: str, right: str, states: dict[str, tuple[int, str]]) -> str:
    """Return the name of the product; `states` holds the position and the name without unit of each state."""
    if CONSTANT in (left, right):
        return right if left == CONSTANT else left
    pair = sorted((left, right), key=lambda name: (name not in states, states.get(name, (0, ""))[0], name))
    a, b = (states[name][1] if name in states else name for name in pair)
    if left == right:
        return f"({a})^2" if "*" in a or "^" in a else f"{a}^2"
    return f"{a}*{b}"


@dataclass(frozen=True, eq=False)
class Traced(Lifting):
    """ψ as a list of plain operations; a file holds a user's own function in this form."""

    graph: Graph
    labels: tuple[str, ...]

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names that it had when it was traced."""
        return self.labels

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the result of the operations on symbols."""
        return self.graph.symbolic(x)

    @cached_property
    def _graph(self) -> Graph:
        return self.graph


def bind_lifting(value: object, states: Sequence[str]) -> Lifting:
    """Return `check_lifting` bound to these states; one that is bound to them already is returned itself."""
    lifting = check_lifting(value)
    return lifting if lifting.bound == tuple(states) else lifting.bind(states)


def check_lifting(value: object) -> Lifting:
    """Return `value` if it is a Lifting."""
    if isinstance(value, Lifting):
        return value
    if isinstance(value, type) and issubclass(value, Lifting):
        raise DataError(f"the lifting is the class {value.__name__}; pass an instance: {value.__name__}(…)")
    raise DataError(f"{value!r} is not a lifting; pass one, or a sum: State() + Constant()")


def buffer_lifting(lifting: Lifting) -> Buffered:
    """Return ψ as a function of one state, at about a microsecond a call.

    If one state is NaN or beyond 1e30, all observables are NaN. A bad measurement then shows in every product with z;
    NaN, unlike inf, causes no warning in a product.
    """
    return Buffered(lifting.guarded_function())


def find_observables(lifting: Lifting, wanted: Lifting) -> Indices:
    """Return the indices in the bound `lifting` of the observables of the bound `wanted`, found by name."""
    place = {name: i for i, name in enumerate(lifting.names)}
    for name in wanted.names:
        if name not in place:
            raise ObservableError(
                f"the lifting lacks {name!r}; add it to the lifting: it holds {', '.join(lifting.names)}"
            )
    return np.array([place[name] for name in wanted.names], dtype=np.intp)


StateChoice = int | str | Sequence[int | str]


def find_state(state: int | str, states: Sequence[str], who: str) -> int:
    """Return the index of a state given by its index, or by its name with or without the unit."""
    if isinstance(state, str):
        matches = [i for i, name in enumerate(states) if state in (name, strip_unit(name))]
        if len(matches) == 1:
            return matches[0]
    elif isinstance(cast(object, state), int | np.integer) and -len(states) <= state < len(states):
        return state % len(states)
    raise DataError(f"{who} is asked for state {state!r}; the states are {', '.join(states)}, or 0 … {len(states) - 1}")


def find_states(chosen: StateChoice | None, states: Sequence[str], who: str) -> list[int]:
    """Return the indices of the chosen states; None chooses all states."""
    choices = freeze_choice(chosen)
    return list(range(len(states))) if choices is None else [find_state(state, states, who) for state in choices]


def freeze_choice(chosen: StateChoice | None) -> tuple[int | str, ...] | None:
    """Return a choice of states as an immutable tuple of indices and names, or None for all states."""
    if chosen is None:
        return None
    choices = [chosen] if isinstance(chosen, int | str | np.integer) else chosen
    try:
        return tuple(state if isinstance(state, str) else index(state) for state in choices)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"states is {chosen!r:.60}; pass names of states or their indices") from None
