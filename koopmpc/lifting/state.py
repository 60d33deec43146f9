"""State (degree 1), Constant (degree 0), Monomials (degrees from 2 on), and a user's own: Expressions, or Numeric."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.checks import HUGE
from koopmpc.errors import DataError, ObservableError
from koopmpc.lifting.base import CONSTANT, Chosen, Lifting, Traced, frozen, indices, short
from koopmpc.plants.graph import Graph
from koopmpc.values import Value, freeze


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

    states: Chosen | None = None

    def __post_init__(self) -> None:
        freeze(self, states=frozen(self.states))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the chosen states."""
        return tuple(states[i] for i in indices(self.states, states, "State"))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the chosen states."""
        return x if self.whole else x[self.chosen]

    def lift_into(self, X: Float[np.ndarray, "M nx"], Z: Float[np.ndarray, "M nz"]) -> None:
        """Write the chosen states of the rows of X, without the detour over columns."""
        Z[:] = X if self.whole else X[:, self.chosen]

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        Z[:] = (x if self.whole else x[self.chosen]).T

    @property
    def whole(self) -> bool:
        """True where all states are chosen, in their order."""
        return self.states is None

    @cached_property
    def chosen(self) -> list[int]:
        """Indices of the chosen states, once bound."""
        return indices(self.states, self.bound_states, "State")


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

    Degree 1 is `State`, degree 0 is `Constant`; add them where they are wanted.

    Parameters
    ----------
    degree
        The highest total degree, 2 or more.

    Raises
    ------
    DataError
        degree is below 2.

    Examples
    --------
    >>> import koopmpc as km
    >>> lifting = km.State() + km.Monomials(2)
    >>> lifting.bind(("x", "v")).names
    ('x', 'v', 'x^2', 'x*v', 'v^2')
    """

    degree: int

    def __post_init__(self) -> None:
        freeze(self, degree=checks.count(self.degree, "degree", 2))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"theta^2*omega"``."""
        names = [short(state) for state in states]
        powers = (Counter(factors) for factors in _factors(len(states), self.degree))
        return tuple("*".join(names[i] + (f"^{p}" if p > 1 else "") for i, p in each.items()) for each in powers)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return each monomial as one of a degree less times a state."""
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
        return _factors(len(self.bound_states), self.degree)


def _factors(nx: int, degree: int) -> list[tuple[int, ...]]:
    """Return the monomials of degree 2 … `degree` as ascending lists of state indices."""
    return [c for d in range(2, degree + 1) for c in combinations_with_replacement(range(nx), d)]


@dataclass(frozen=True, eq=False, init=False)
class Expressions(Lifting):
    """ψ(x) = fn(x), traced once when it is bound.

    Parameters
    ----------
    fn
        Takes the column x and returns a list of expressions: ``lambda x: [x[1] * ca.sin(x[0])]``.
    names
        The name of each expression, by which limits and costs find it.

    Raises
    ------
    DataError
        When it is bound: fn does not return one expression for each name. When it is saved unbound.

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

    def bind(self, states: Sequence[str]) -> Traced:
        """Return the traced list of operations, which needs `fn` no more."""
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
        """Refuse: a file holds the traced operations, never `fn`."""
        raise DataError("Expressions holds a Python function; call .bind(states), which traces it, and save that")

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names given."""
        return self.labels

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the expressions of `fn` as a column."""
        return ca.SX(ca.vertcat(*self.fn(x)))


RowFunction = Callable[[Float[np.ndarray, "M nx"]], Float[np.ndarray, "M nz"]]


@dataclass(frozen=True, eq=False)
class Numeric(Lifting):
    """ψ(x) = fn(x), a function of numbers: rows (M, nx) to rows (M, nz).

    `LQR` and `KoopmanMPC` need no more. What linearises the lifting, such as `BilinearMPC` or an equilibrium that is
    not the origin, and every file needs a formula: write ψ as `Expressions`.

    Parameters
    ----------
    fn
        Takes (M, nx) states and returns (M, nz) observables.
    labels
        The name of each observable.
    """

    fn: RowFunction
    labels: tuple[str, ...]

    def __post_init__(self) -> None:
        freeze(self, labels=tuple(self.labels))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names given."""
        return self.labels

    def formula(self, x: ca.SX) -> ca.SX:
        """Raise: numbers have no formula."""
        raise ObservableError(
            "this lifting is a function of numbers, and a formula is needed here; write it with km.Expressions or the "
            "families of koopmpc, and pass it as lifting="
        )

    def measured(self) -> ca.Function:
        """Return ψ of one measured state, as a CasADi function that calls Python."""
        return _Called(self)

    def as_saved(self) -> Value:
        """Refuse: a file holds no function."""
        raise DataError("the lifting is a Python function, which no file holds; write it with km.Expressions")

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        found = np.asarray(self.fn(np.ascontiguousarray(x.T)), dtype=np.float64)
        if found.shape != Z.shape:
            raise DataError(f"the lifting returns shape {found.shape} for {Z.shape[0]} states, expected {Z.shape}")
        Z[:] = found


class _Called(ca.Callback):
    """ψ of one state, NaN where the state is NaN or beyond 1e30."""

    def __init__(self, lifting: Numeric) -> None:
        super().__init__()
        self._lifting, self._nx, self._nz = lifting, len(lifting.bound_states), lifting.nz
        self.construct("psi", {})

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return that of a column of states."""
        return ca.Sparsity.dense(self._nx, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Return that of a column of observables."""
        return ca.Sparsity.dense(self._nz, 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        """Return [ψ(x)]."""
        x = np.array(arg[0]).reshape(1, self._nx)
        z = self._lifting(x)[0] if np.abs(x).sum() < HUGE else np.full(self._nz, np.nan)
        return [ca.DM(z)]
