"""The numbers of a lifting that may be trained, as one vector: centres, widths, frequencies."""

from collections.abc import Iterator
from copy import copy
from dataclasses import fields, replace
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.errors import DataError
from koopmpc.lifting.base import Lifting
from koopmpc.plants.graph import Graph
from koopmpc.values import freeze

_CHUNK = 4096  # rows at a time


class _Field(NamedTuple):
    """A field of one of the liftings in a lifting: its value now, its unit, and whether it stays above zero."""

    value: Float[np.ndarray, "..."]
    unit: float
    positive: bool


class Tuning:
    """ψ(x; p): a bound lifting as a function of its tunable numbers p; p = 0 is the lifting as it is.

    A field that stays above zero is its value times exp(p). Any other is its value plus p times a unit: the width of
    the family where it has one, else the spread of the field's rows. So p does not depend on the units of the states.

    Parameters
    ----------
    lifting
        Bound to its states.

    Raises
    ------
    DataError
        The lifting has nothing that could be tuned.
    """

    def __init__(self, lifting: Lifting) -> None:
        self.lifting = lifting
        nx, nz = len(lifting.bound_states), lifting.nz
        self._fields = list(_tunable(lifting))
        self.n = sum(field.value.size for field in self._fields)
        if not self.n:
            raise DataError(
                "the lifting has no centres, widths or frequencies to train; pass one with Gaussian, ThinPlate or "
                "RandomFourier in it, or a family of your own that names its `tunable` fields"
            )
        x, p, w = ca.SX.sym("x", nx), ca.SX.sym("p", self.n), ca.SX.sym("w", nz)
        z = _copied(lifting, iter(self._placed(p)), symbols=True).formula(x)
        options = {"cse": True}
        self._value = Graph.trace(ca.Function("value", [x, p], [z], options))
        self._pullback = Graph.trace(ca.Function("pullback", [x, p, w], [ca.jtimes(z, p, w, True)], options))

    @property
    def positive(self) -> "np.ndarray":
        """Which entries of p are logarithms."""
        return np.concatenate([np.full(field.value.size, field.positive) for field in self._fields])

    def __call__(self, X: Float[np.ndarray, "M nx"], p: Float[np.ndarray, " n"]) -> Float[np.ndarray, "M nz"]:
        """Return ψ(x; p) row by row."""
        Z = np.empty((len(X), self.lifting.nz))
        for first in range(0, len(X), _CHUNK):
            x = np.ascontiguousarray(X[first : first + _CHUNK].T)
            self._value.run(_inputs(x, p), Z[first : first + _CHUNK].T, self._value.scratch(x.shape[1]))
        return Z

    def pullback(
        self, X: Float[np.ndarray, "M nx"], p: Float[np.ndarray, " n"], W: Float[np.ndarray, "M nz"]
    ) -> Float[np.ndarray, " n"]:
        """Return Σ over rows of (∂ψ/∂p)ᵀ w."""
        total = np.zeros(self.n)
        for first in range(0, len(X), _CHUNK):
            x, w = (np.ascontiguousarray(rows[first : first + _CHUNK].T) for rows in (X, W))
            each = np.empty((self.n, x.shape[1]))
            self._pullback.run(_inputs(x, p, w), each, self._pullback.scratch(x.shape[1]))
            total += each.sum(axis=1)
        return total

    def at(self, p: Float[np.ndarray, " n"]) -> Lifting:
        """Return the lifting with these numbers."""
        return _copied(self.lifting, iter(self._placed(p)), symbols=False)

    def _placed(self, p: Any) -> Iterator[Any]:
        """Yield the value of each field at p, an array or symbols."""
        start = 0
        for value, unit, positive in self._fields:
            own = p[start : start + value.size]
            start += value.size
            if isinstance(own, ca.SX):
                own = ca.reshape(own, *value.shape[::-1]).T if value.ndim == 2 else own
                yield ca.SX(value) * ca.exp(own) if positive else ca.SX(value) + unit * own
            else:
                own = own.reshape(value.shape)
                yield value * np.exp(own) if positive else value + unit * own


def _inputs(*arguments: np.ndarray) -> Any:
    """Return the rows of matrices and the entries of vectors, one after the other, as a graph reads them."""
    return [row if argument.ndim == 2 else float(row) for argument in arguments for row in argument]


def _inside(lifting: Lifting) -> Iterator[tuple[str, Lifting | tuple[Lifting, ...]]]:
    """Yield the fields that hold liftings: one, or a tuple of them."""
    for field in fields(lifting):
        value: Any = getattr(lifting, field.name)
        if isinstance(value, Lifting):
            yield field.name, value
        elif isinstance(value, tuple) and all(isinstance(part, Lifting) for part in cast("tuple[Any, ...]", value)):
            yield field.name, cast("tuple[Lifting, ...]", value)


def _tunable(lifting: Lifting) -> Iterator[_Field]:
    """Yield the tunable fields of the lifting, then those of the liftings in it."""
    values = {name: np.asarray(getattr(lifting, name), dtype=float) for name in lifting.tunable}
    positive: list[Any] = [values[name] for name, kind in lifting.tunable.items() if kind == "positive"]
    widths = [float(np.exp(np.mean(np.log(np.asarray(value, dtype=float))))) for value in positive]
    for name, kind in lifting.tunable.items():
        value: Any = values[name]
        spread = float(np.std(value - np.mean(value, axis=0))) if np.ndim(value) else 0.0
        yield _Field(value, widths[0] if widths else spread or 1.0, kind == "positive")
    for _, inner in _inside(lifting):
        for part in inner if isinstance(inner, tuple) else (inner,):
            yield from _tunable(part)


def _copied(lifting: Lifting, values: Iterator[Any], *, symbols: bool) -> Lifting:
    """Return the lifting with the next of `values` in each tunable field, in the order of `_tunable`."""
    changes: dict[str, Any] = {name: next(values) for name in lifting.tunable}
    for name, value in _inside(lifting):
        if isinstance(value, tuple):
            changes[name] = tuple(_copied(part, values, symbols=symbols) for part in value)
        else:
            changes[name] = _copied(value, values, symbols=symbols)
    if not symbols:
        changes = {name: float(v) if np.ndim(v) == 0 and name in lifting.tunable else v for name, v in changes.items()}
        return replace(lifting, **changes)
    _ = lifting.names  # a copy keeps the names of the original, which symbols have none of
    twin = copy(lifting)
    freeze(twin, **changes)
    return twin
