"""Variable projection: the trainable numbers p of a lifting, and the error of the best model on ψ(x; p)."""

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import freeze
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import Lifting
from koopmpc.plants.graph import Graph

_CHUNK = 4096  # rows that are lifted at once
_DECODED = 1e-12  # ridge of the fit of C, for states that the lifting does not hold
_LOST = 1e3  # value of the objective, a logarithm, if a forecast overflows


class _Field(NamedTuple):
    """A tunable field of a lifting or of a lifting in it: its value, its unit, and whether it must stay above zero."""

    value: Float[np.ndarray, "..."]
    unit: float
    positive: bool


class TunableLifting:
    """ψ(x; p): a bound lifting as a function of its tunable numbers p; p = 0 is the lifting itself.

    A field that must stay above zero is its value times exp(p). Any other is its value plus p times a unit: the width
    of the family if it has one, else the spread of the field's rows. So p does not depend on the units of the states.

    Raises
    ------
    DataError
        The lifting has no tunable field.
    """

    @raise_swallowed()
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
        z = _copy_with(lifting, iter(self._evaluate_fields(p)), symbols=True).formula(x)
        options = {"cse": True}
        self._value = Graph.trace(ca.Function("value", [x, p], [z], options))
        self._pullback = Graph.trace(ca.Function("pullback", [x, p, w], [ca.jtimes(z, p, w, True)], options))

    @property
    def positive(self) -> "np.ndarray":
        """Mask of the entries of p that are logarithms."""
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
            row_gradients = np.empty((self.n, x.shape[1]))
            self._pullback.run(_inputs(x, p, w), row_gradients, self._pullback.scratch(x.shape[1]))
            total += row_gradients.sum(axis=1)
        return total

    def at(self, p: Float[np.ndarray, " n"]) -> Lifting:
        """Return the lifting with these numbers."""
        return _copy_with(self.lifting, iter(self._evaluate_fields(p)), symbols=False)

    def _evaluate_fields(self, p: Any) -> Iterator[Any]:
        """Yield the value of each field at p, an array or symbols."""
        start = 0
        for value, unit, positive in self._fields:
            change = p[start : start + value.size]
            start += value.size
            if isinstance(change, ca.SX):
                change = ca.reshape(change, *value.shape[::-1]).T if value.ndim == 2 else change
                yield ca.SX(value) * ca.exp(change) if positive else ca.SX(value) + unit * change
            else:
                change = change.reshape(value.shape)
                yield value * np.exp(change) if positive else value + unit * change


def _inputs(*arguments: np.ndarray) -> Any:
    """Return the arguments of a graph: the rows of matrices and the entries of vectors, one after the other."""
    return [row if argument.ndim == 2 else float(row) for argument in arguments for row in argument]


def _tunable(lifting: Lifting) -> Iterator[_Field]:
    """Yield the tunable fields of the lifting, then those of the liftings in it."""
    values = {name: np.asarray(getattr(lifting, name), dtype=float) for name in lifting.tunable}
    positive = [name for name, kind in lifting.tunable.items() if kind == "positive"]
    widths = [float(np.exp(np.mean(np.log(values[name])))) for name in positive]
    for name, value in values.items():
        spread = float(np.std(value - np.mean(value, axis=0))) if value.ndim else 0.0
        yield _Field(value, widths[0] if widths else spread or 1.0, name in positive)
    for inner in lifting.inner_liftings().values():
        for part in inner if isinstance(inner, tuple) else (inner,):
            yield from _tunable(part)


def _copy_with(lifting: Lifting, values: Iterator[Any], *, symbols: bool) -> Lifting:
    """Return the lifting with the next of `values` in each tunable field, in the order of `_tunable`."""
    changes: dict[str, Any] = {name: next(values) for name in lifting.tunable}
    for name, value in lifting.inner_liftings().items():
        if isinstance(value, tuple):
            changes[name] = tuple(_copy_with(part, values, symbols=symbols) for part in value)
        else:
            changes[name] = _copy_with(value, values, symbols=symbols)
    if not symbols:
        changes = {name: float(v) if np.ndim(v) == 0 and name in lifting.tunable else v for name, v in changes.items()}
        return replace(lifting, **changes)
    _ = lifting.names  # compute the names now: the copy below keeps them, and symbols have no names
    twin = copy(lifting)
    freeze(twin, **changes)
    return twin


@dataclass(frozen=True)
class Windows:
    """Pieces of N steps: points X, states first; all inputs V; the weights 1 / (N nx Σ x²) of squared errors."""

    X: Float[np.ndarray, "M N1 np"]
    V: Float[np.ndarray, "M N nv"]
    weight: Float[np.ndarray, "N nx"]

    @classmethod
    def of(cls, points: Episodes, N: int, nx: int) -> "Windows":
        """Return the arrays of episodes of N steps each."""
        X = np.stack([e.X for e in points])
        size = np.sum(X[:, 1:, :nx] ** 2, axis=0)
        weight = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0) / (N * nx)
        return cls(X, np.stack([np.hstack([e.U, e.W]) for e in points]), weight)


class _LeastSquares:
    """K = argmin ‖T − P K‖² + ridge ‖D K‖², and its derivatives.

    D holds the norms of P's columns; if P has a `constant` column, those of their deviations from the mean, as in
    `edmd`.
    """

    def __init__(
        self, P: Float[np.ndarray, "m n"], T: Float[np.ndarray, "m k"], ridge: float, constant: bool = False
    ) -> None:
        self.P, self.T, self.ridge = P, T, ridge
        self.moving = P - P.mean(axis=0) if constant else P
        G = P.T @ P
        self.norms = np.sqrt(np.where(G.diagonal() > 0, G.diagonal(), 1.0))
        spread = np.sum(self.moving**2, axis=0) / self.norms**2
        self.factor = cho_factor(G / np.outer(self.norms, self.norms) + ridge * np.diag(spread))
        self.K = self._solve(P.T @ T)

    def _solve(self, right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        return cast("Any", cho_solve(self.factor, right / self.norms[:, None])) / self.norms[:, None]

    def pullback(self, dK: Float[np.ndarray, "n k"]) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m k"]]:
        """Return the derivatives by P and T of a function whose derivative by K is dK."""
        right = self._solve(dK)
        dG = -right @ self.K.T
        by_norms = 2 * self.ridge * dG.diagonal()
        return self.T @ right.T + self.P @ (dG + dG.T) + self.moving * by_norms, self.P @ right


class VariableProjection:
    """J(p) = log of the relative forecast error over the horizon, with A, B and C by least squares for each p."""

    def __init__(self, tuning: TunableLifting, windows: Windows, ridge: float) -> None:
        self.tuning, self.windows, self.ridge = tuning, windows, ridge
        names, states = tuning.lifting.names, tuning.lifting.bound_states[: windows.weight.shape[1]]
        self.state_places = [(i, names.index(state)) for i, state in enumerate(states) if state in names]
        self.missing = [i for i, state in enumerate(states) if state not in names]

    def __call__(self, p: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        """Return J and its gradient."""
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                return self._value_and_gradient(p)
            except (LinAlgError, ValueError):  # the observables or the forecasts overflow
                return _LOST, np.zeros(len(p))

    def evaluate_on(self, p: Float[np.ndarray, " n"], other: Windows) -> float:
        """Return J on other windows, with the A, B and C that were fitted to `windows`."""
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                Z = self._lift(p, self.windows)
                fit, decode = self._fit(Z)
                error = _forecast_error(self._lift(p, other), fit.K, self._decoder(decode), other)[0]
            except (LinAlgError, ValueError):
                return _LOST
        return 0.5 * float(np.log(max(error, 1e-300))) if np.isfinite(error) else _LOST

    def _value_and_gradient(self, p: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        data, nz = self.windows, self.tuning.lifting.nz
        Z = self._lift(p, data)
        fit, decode = self._fit(Z)
        error, back = _forecast_error(Z, fit.K, self._decoder(decode), data)
        if not np.isfinite(error) or error == 0:
            return (_LOST if error else -_LOST), np.zeros(len(p))
        dZ0, dK, dC = back()
        dP, dT = fit.pullback(dK)
        dZ = np.zeros_like(Z)
        dZ[:, 0] += dZ0
        dZ[:, :-1] += dP[:, :nz].reshape(dZ[:, :-1].shape)
        dZ[:, 1:] += dT.reshape(dZ[:, 1:].shape)
        if decode is not None:
            dZ[:, :-1] += decode.pullback(dC[:, self.missing])[0].reshape(dZ[:, :-1].shape)
        flat = data.X.reshape(-1, data.X.shape[2])
        gradient = self.tuning.pullback(flat, p, dZ.reshape(len(flat), nz))
        return 0.5 * float(np.log(error)), gradient / (2 * error)

    def _lift(self, p: Float[np.ndarray, " n"], data: Windows) -> Float[np.ndarray, "M N1 nz"]:
        M, N1, n = data.X.shape
        return self.tuning(data.X.reshape(-1, n), p).reshape(M, N1, -1)

    def _fit(self, Z: Float[np.ndarray, "M N1 nz"]) -> "tuple[_LeastSquares, _LeastSquares | None]":
        """Return the fit of [A B]ᵀ, and the fit of C for the states that the lifting lacks, or None."""
        nz, X = Z.shape[2], self.windows.X
        now, ahead = Z[:, :-1].reshape(-1, nz), Z[:, 1:].reshape(-1, nz)
        V = self.windows.V.reshape(len(now), -1)
        fixed = self.tuning.lifting.constant_index is not None
        fit = _LeastSquares(np.hstack([now, V]), ahead, self.ridge, fixed)
        if not self.missing:
            return fit, None
        return fit, _LeastSquares(now, X[:, :-1, self.missing].reshape(len(now), -1), _DECODED)

    def _decoder(self, decode: "_LeastSquares | None") -> Float[np.ndarray, "nz nx"]:
        """Return Cᵀ: rows of the identity for the states that the lifting holds, least squares for the others."""
        C = np.zeros((self.tuning.lifting.nz, len(self.state_places) + len(self.missing)))
        for state, place in self.state_places:
            C[place, state] = 1.0
        if decode is not None:
            C[:, self.missing] = decode.K
        return C


_Back = Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _forecast_error(
    Z: Float[np.ndarray, "M N1 nz"], K: Float[np.ndarray, "n nz"], C: Float[np.ndarray, "nz nx"], data: Windows
) -> tuple[float, _Back]:
    """Return the mean relative squared error over the horizon, and a function for its derivatives by z_0, K and C."""
    nz, N, nx = Z.shape[2], data.V.shape[1], C.shape[1]
    A, B = K[:nz], K[nz:]
    path = [Z[:, 0]]
    for h in range(N):
        path.append(path[-1] @ A + data.V[:, h] @ B)
    gaps = [path[h + 1] @ C - data.X[:, h + 1, :nx] for h in range(N)]
    error = float(sum(np.sum(gap**2, axis=0) @ weight for gap, weight in zip(gaps, data.weight, strict=True)))

    def back() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        dz, dK, dC = np.zeros_like(path[0]), np.zeros_like(K), np.zeros_like(C)
        for h in reversed(range(N)):
            slope = 2 * gaps[h] * data.weight[h]
            dC += path[h + 1].T @ slope
            dz += slope @ C.T
            dK[:nz] += path[h].T @ dz
            dK[nz:] += data.V[:, h].T @ dz
            dz = dz @ A.T
        return dz, dK, dC

    return error, back
