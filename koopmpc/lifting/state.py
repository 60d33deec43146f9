"""State, Constant and Monomials, and a user's own functions: Expressions."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value, freeze
from koopmpc.lifting.base import CONSTANT, Lifting, StateChoice, Traced, find_states, freeze_choice, strip_unit
from koopmpc.plants.graph import Graph


@dataclass(frozen=True, eq=False)
class State(Lifting):
    """ψ(x) = x, or the chosen xᵢ; the observables have the states' full names.

    Parameters
    ----------
    states
        The chosen states, by index or by name, with or without the unit; all of them by default.

    Raises
    ------
    DataError
        When it is bound: there is no such state.

    Examples
    --------
    >>> import koopmpc as km
    >>> lifting = km.State() + km.Fourier(1, states="theta") + km.Constant()
    >>> lifting.bind(("theta [rad]", "omega [rad/s]")).names
    ('theta [rad]', 'omega [rad/s]', 'sin(theta)', 'cos(theta)', '1')
    """

    states: StateChoice | None = None

    def __post_init__(self) -> None:
        freeze(self, states=freeze_choice(self.states))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the chosen states."""
        return tuple(states[i] for i in find_states(self.states, states, "State"))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the chosen states."""
        return x if self.selects_all else x[self.state_indices]

    def lift_into(self, X: Float[np.ndarray, "M nx"], Z: Float[np.ndarray, "M nz"]) -> None:
        """Write the chosen states of the rows of X; copying rows is faster than `_fill`, which takes columns."""
        Z[:] = X if self.selects_all else X[:, self.state_indices]

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        Z[:] = (x if self.selects_all else x[self.state_indices]).T

    @property
    def selects_all(self) -> bool:
        """True if all states are chosen, in their order."""
        return self.states is None

    @cached_property
    def state_indices(self) -> list[int]:
        """Indices of the chosen states, once bound."""
        return find_states(self.states, self.bound_states, "State")


@dataclass(frozen=True, eq=False)
class Constant(Lifting):
    """ψ(x) = 1; the observable is named ``"1"``."""

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the name ``"1"``."""
        return (CONSTANT,)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the number 1 as a symbol."""
        return ca.SX(1)

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        Z[:] = 1.0


@dataclass(frozen=True, eq=False)
class Monomials(Lifting):
    """ψ(x) = all x₁^a₁ … xₙ^aₙ of total degree a₁ + … + aₙ from 2 to `degree`, in graded order.

    Add `State` for degree 1 and `Constant` for degree 0.

    Parameters
    ----------
    degree
        The highest total degree, 2 or more.
    states
        Name or index of a state, or several, that are multiplied; all by default. Names count with or without their
        unit.

    Raises
    ------
    DataError
        degree is below 2; a state is unknown.

    Examples
    --------
    >>> import koopmpc as km
    >>> lifting = km.State() + km.Monomials(2)
    >>> lifting.bind(("x", "v")).names
    ('x', 'v', 'x^2', 'x*v', 'v^2')
    >>> km.Monomials(3, states="x").bind(("x", "v")).names
    ('x^2', 'x^3')
    """

    degree: int
    states: StateChoice | None = None

    def __post_init__(self) -> None:
        freeze(self, degree=checks.count(self.degree, "degree", 2), states=freeze_choice(self.states))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"theta^2*omega"``."""
        names = [strip_unit(state) for state in states]
        chosen = find_states(self.states, states, "Monomials")
        monomials = (Counter(factors) for factors in _list_monomials(chosen, self.degree))
        return tuple("*".join(names[i] + (f"^{p}" if p > 1 else "") for i, p in powers.items()) for powers in monomials)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return each monomial as the product of a state and a monomial of the next lower degree."""
        known: dict[tuple[int, ...], ca.SX] = {(i,): x[i] for i in range(x.shape[0])}
        for factors in self._all:
            known[factors] = known[factors[:-1]] * x[factors[-1]]
        return ca.vertcat(*(known[factors] for factors in self._all))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        known: dict[tuple[int, ...], np.ndarray] = {(i,): column for i, column in enumerate(x)}
        for j, factors in enumerate(self._all):
            product = known[factors[:-1]] * x[factors[-1]]
            if len(factors) < self.degree:
                known[factors] = product
            Z[:, j] = product

    @cached_property
    def _all(self) -> list[tuple[int, ...]]:
        return _list_monomials(find_states(self.states, self.bound_states, "Monomials"), self.degree)


def _list_monomials(states: Sequence[int], degree: int) -> list[tuple[int, ...]]:
    """Return the monomials of degree 2 … `degree` as ascending lists of state indices."""
    return [c for d in range(2, degree + 1) for c in combinations_with_replacement(states, d)]


@dataclass(frozen=True, eq=False, init=False)
class Expressions(Lifting):
    """ψ(x) = fn(x), traced once when it is bound.

    Parameters
    ----------
    fn
        Takes the column x and returns a list of expressions: ``lambda x: [x[1] * ca.sin(x[0])]``.
    names
        The name of each expression; limits and costs find it by this name.

    Raises
    ------
    DataError
        When it is bound: fn does not return one expression for each name. When it is saved: it is not bound.

    Examples
    --------
    >>> import koopmpc as km
    >>> import casadi as ca
    >>> drag = km.Expressions(lambda x: [x[1] * ca.fabs(x[1])], ["v|v|"])
    >>> (km.State() + drag).bind(("x", "v"))([1.0, -2.0])
    array([ 1., -2., -4.])
    """

    fn: Callable[[ca.SX], Sequence[ca.SX]]
    labels: tuple[str, ...]

    def __init__(self, fn: Callable[[ca.SX], Sequence[ca.SX]], names: Sequence[str]) -> None:
        freeze(self, fn=fn, labels=checks.texts((names,) if isinstance(names, str) else names, "names"), bound=None)

    @raise_swallowed()
    def bind(self, states: Sequence[str]) -> Traced:
        """Return the traced list of operations, which does not need `fn`."""
        x = ca.SX.sym("x", len(states))
        z = self.formula(x)
        if z.shape != (len(self.labels), 1):
            raise DataError(
                f"Expressions: fn returns shape {z.shape} and names has {len(self.labels)}; "
                "return one expression for each name"
            )
        graph = Graph.trace(ca.Function("expressions", [x], [z]))
        traced = Traced(graph, self.observables(tuple(states)), bound=tuple(states))
        _ = traced.names
        return traced

    def as_saved(self) -> Value:
        """Raise a DataError: a file holds the traced operations, never `fn`."""
        raise DataError("Expressions holds a Python function; call .bind(states), which traces it, and save that")

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names that were passed."""
        return self.labels

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the expressions of `fn` as a column."""
        return ca.SX(ca.vertcat(*self.fn(x)))
