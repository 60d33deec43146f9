"""What a Prior says of each entry of [A B], on the observables and inputs of a fit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.prior import Prior
from koopmpc.lifting.base import short


@dataclass(frozen=True, eq=False)
class Entries:
    """Known entries of [A B], NaN where free, and bounds."""

    known: Float[np.ndarray, "nz n"]
    low: Float[np.ndarray, "nz n"]
    high: Float[np.ndarray, "nz n"]

    @property
    def bounded(self) -> Bool[np.ndarray, " nz"]:
        """Rows with a bound on a free entry."""
        limited = np.isfinite(self.low) | np.isfinite(self.high)
        return np.asarray((limited & np.isnan(self.known)).any(axis=1))


def entries_of(prior: Prior, observables: Sequence[str], inputs: Sequence[str]) -> Entries:
    """Return what is known of each entry of [A B] on these observables and inputs.

    Raises
    ------
    ShapeError
        A part is made for another number of observables or inputs.
    DataError
        Two parts contradict each other, or a name is unknown.
    """
    nz, nu = len(observables), len(inputs)
    known = np.full((nz, nz + nu), np.nan)
    low, high = np.full_like(known, -np.inf), np.full_like(known, np.inf)
    parts = (
        ("A", slice(0, nz), prior.A, prior.mask_A, prior.lower_A, prior.upper_A),
        ("B", slice(nz, nz + nu), prior.B, prior.mask_B, prior.lower_B, prior.upper_B),
    )
    for name, columns, values, mask, lower, upper in parts:
        shape = known[:, columns].shape
        for bound, into, what in ((lower, low, f"lower_{name}"), (upper, high, f"upper_{name}")):
            into[:, columns] = bound if bound.ndim == 0 else _sized(bound, shape, what)
        if mask is not None:
            known[:, columns][~_sized(mask, shape, f"mask_{name}")] = 0.0
        if values is not None:
            _put(known[:, columns], _sized(values, shape, f"Prior.{name}"), f"Prior.{name}")
    names = [*observables, *inputs]
    for name, row in prior.rows.items():
        values = np.zeros((1, nz + nu))
        for other, value in row.items():
            values[0, _place(other, names)] = value
        i = _place(name, observables)
        _put(known[i : i + 1], values, f"rows[{name!r}]")
    bad = np.argwhere((known < low) | (known > high) | (low > high))
    if len(bad):
        i, j = map(int, bad[0])
        raise DataError(
            f"the priors contradict each other at {observables[i]!r} from {names[j]!r}: known {known[i, j]:g}, "
            f"bounds {low[i, j]:g} … {high[i, j]:g}; drop one of them"
        )
    for combination in prior.combinations:
        for weights, shape, what in (
            (combination.A, (nz, nz), "Combination.A"),
            (combination.B, (nz, nu), "Combination.B"),
        ):
            if weights is not None:
                _sized(weights, shape, what)
    if prior.storage is not None:
        _sized(prior.storage.P, (nz, nz), "Storage.P")
        for matrix, shape, what in (
            (prior.storage.C, (nu, nz), "Storage.C"),
            (prior.storage.D, (nu, nu), "Storage.D"),
        ):
            if matrix is not None:
                _sized(matrix, shape, what)
    return Entries(known, low, high)


def _sized(value: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    if value.shape != shape:
        raise ShapeError(
            f"{name} has shape {value.shape}, expected {shape}: observables by observables or inputs"
        )
    return value


def _put(into: Float[np.ndarray, "r n"], values: Float[np.ndarray, "r n"], name: str) -> None:
    """Write what is known; raise where something else is known already."""
    clash = np.argwhere(np.isfinite(values) & np.isfinite(into) & (values != into))
    if len(clash):
        i, j = map(int, clash[0])
        raise DataError(
            f"{name} says {values[i, j]:g} at ({i}, {j}), where another prior says {into[i, j]:g}; drop one of them"
        )
    if np.isinf(values).any():
        raise DataError(f"{name} holds infinite entries; use NaN where an entry is free")
    np.copyto(into, values, where=np.isfinite(values))


def _place(name: str, names: Sequence[str]) -> int:
    found = [i for i, other in enumerate(names) if name in (other, short(other))]
    if len(found) == 1:
        return found[0]
    raise DataError(f"rows names {name!r}; it can name {', '.join(names)}")
