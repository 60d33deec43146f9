"""Observables that the user writes in CasADi operations, and the traced form of any lifting."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from koopmpc.errors import DataError
from koopmpc.lifting.base import Lifting
from koopmpc.plants.graph import Graph
from koopmpc.values import Value, freeze


@dataclass(frozen=True, eq=False)
class Traced(Lifting):
    """ψ as a list of plain operations: a file holds a user's own function in this form."""

    graph: Graph
    labels: tuple[str, ...]

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names given when it was traced."""
        return self.labels

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the operations, done on symbols."""
        return self.graph.symbolic(x)

    @cached_property
    def _graph(self) -> Graph:
        return self.graph


@dataclass(frozen=True, eq=False, init=False)
class Expressions(Lifting):
    """ψ(x) = fn(x), traced once when it is bound.

    Parameters
    ----------
    fn
        Takes the column x and returns a list of expressions: ``lambda x: [x[1] * ca.sin(x[0])]``.
    names
        The name of each expression, by which limits and costs find it.

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
        freeze(self, fn=fn, labels=(names,) if isinstance(names, str) else tuple(names), bound=None)

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
