"""Prior knowledge of A and B: known entries and rows, zeros, bounds, weighted sums, symmetry and dissipation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Value, freeze
from koopmpc.lifting.base import strip_unit


@dataclass(frozen=True, eq=False)
class Combination(Value):
    """low ≤ Σ Fᵢⱼ Aᵢⱼ + Σ Gᵢⱼ Bᵢⱼ ≤ high, an equation if low = high.

    Parameters
    ----------
    low, high
        Limits of the sum; −inf or inf for no limit.
    A, B
        The weights F (nz, nz) and G (nz, nu); zero by default.

    Raises
    ------
    ShapeError, DataError
        There are no weights, the weights are not matrices, or low is above high.
    """

    low: float
    high: float
    A: ArrayLike | None = field(default=None, kw_only=True)
    B: ArrayLike | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.A is None and self.B is None:
            raise DataError("a Combination has no weights; pass A, B or both")
        ends = checks.array([self.low, self.high], "low, high", (2,), infinite=True)
        checks.refuse_crossed(ends[:1], ends[1:], "Combination")
        freeze(self, low=float(ends[0]), high=float(ends[1]))
        _check_matrices(self, "Combination.A", "Combination.B")


@dataclass(frozen=True, eq=False)
class Dissipation(Value):
    """Dissipation with V(z) = ½ zᵀP z: V(A z + B u) ≤ decay² V(z) + uᵀ(C z + D u) for every z and u.

    With decay = 1 this is passivity from u to y = C z + D u in discrete time. Without C it is V(A z) ≤ decay² V(z): a
    contraction for decay < 1, and a stable A if P ≻ 0. `stable_edmd` finds a P by itself.

    Parameters
    ----------
    P
        (nz, nz) ⪰ 0 or its diagonal: zero where an observable stores nothing.
    decay
        Above 0.
    C
        (nu, nz) of y = C z + D u, which has one output for each input.
    D
        (nu, nu); zero by default. A sampled system whose B is not zero needs D + Dᵀ ≻ 0 to be passive.

    Raises
    ------
    ShapeError, DataError
        P, C or D is not a matrix, decay is not above zero, or D comes without C.
    DefinitenessError
        P is not symmetric, or is indefinite.

    References
    ----------
    Byrnes & Lin, "Losslessness, feedback equivalence, and the global stabilization of discrete-time nonlinear
    systems", IEEE Trans. Automat. Contr. 39, 1994.
    """

    P: ArrayLike
    decay: float = field(default=1.0, kw_only=True)
    C: ArrayLike | None = field(default=None, kw_only=True)
    D: ArrayLike | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.C is None and self.D is not None:
            raise DataError("Dissipation has D but no C; pass the output C that D belongs to")
        stored = checks.array(self.P, "Dissipation.P")
        freeze(self, P=checks.weight(stored, "Dissipation.P"), decay=checks.positive(self.decay, "decay"))
        _check_matrices(self, "Dissipation.C", "Dissipation.D")


def _check_matrices(part: object, *names: str, **options: bool) -> None:
    """Store the fields of these names as matrices, if they are given."""
    for name in names:
        field_name = name.rpartition(".")[2]
        value = getattr(part, field_name)
        if value is not None:
            freeze(part, **{field_name: checks.array(value, name, (None, None), **options)})


@dataclass(frozen=True, eq=False, kw_only=True)
class Prior(Value):
    """Prior knowledge of A and B in z⁺ = A z + B u; `constrained_edmd` fits the free entries.

    Parameters
    ----------
    A, B
        Known entries, (nz, nz) and (nz, nu); NaN for a free entry. With measured disturbances B means [B E] in all
        parameters.
    rows
        Known rows by name: ``{"x [m]": {"x [m]": 1.0, "v [m/s]": 0.1}}`` says x⁺ = x + 0.1 v. Entries that a row does
        not name are zero. Names may lack their unit.
    mask_A, mask_B
        True where an entry may differ from zero.
    lower_A, upper_A, lower_B, upper_B
        Bounds: arrays, or one number for all entries; ±inf for no bound. A known sign is a bound at 0.
    symmetric
        A = Aᵀ.
    combinations
        Weighted sums of entries between limits.
    dissipation
        A `Dissipation`: passivity or contraction.

    Raises
    ------
    ShapeError, DataError
        The arguments are not such arrays, or contradict each other.
    """

    A: ArrayLike | None = None
    B: ArrayLike | None = None
    rows: Mapping[str, Mapping[str, float]] | None = None
    mask_A: ArrayLike | None = None
    mask_B: ArrayLike | None = None
    lower_A: ArrayLike = -np.inf
    upper_A: ArrayLike = np.inf
    lower_B: ArrayLike = -np.inf
    upper_B: ArrayLike = np.inf
    symmetric: bool = False
    combinations: Sequence[Combination] = ()
    dissipation: Dissipation | None = None

    def __post_init__(self) -> None:
        rows = self.rows or {}
        checks.kind(rows, "rows", Mapping, 'pass {"x [m]": {"v [m/s]": 0.1}}')
        for name, row in rows.items():
            checks.kind(row, f"rows[{name!r}]", Mapping, 'pass {"v [m/s]": 0.1}')
        checks.kind(self.symmetric, "symmetric", (bool, np.bool_), "pass True or False")
        checks.kind(self.combinations, "combinations", (tuple, list), "pass a list of Combination")
        for each in self.combinations:
            checks.kind(each, "an entry of combinations", Combination, "pass a list of Combination")
        known = {
            name: {other: float(checks.array(v, f"rows[{name!r}]", ())) for other, v in row.items()}
            for name, row in rows.items()
        }
        _check_matrices(self, "Prior.A", "Prior.B", finite=False)
        _check_matrices(self, "mask_A", "mask_B")
        bounds = {
            name: checks.array(getattr(self, name), name, infinite=True)
            for name in ("lower_A", "upper_A", "lower_B", "upper_B")
        }
        freeze(self, rows=known, symmetric=bool(self.symmetric), combinations=tuple(self.combinations), **bounds)

    @property
    def couples_rows(self) -> bool:
        """True if the prior couples rows of [A B] by symmetry, combinations or dissipation."""
        return self.symmetric or bool(self.combinations) or self.dissipation is not None


@dataclass(frozen=True, eq=False)
class Entries:
    """Known entries of [A B], NaN for a free one, and the bounds of all entries."""

    known: Float[np.ndarray, "nz n"]
    low: Float[np.ndarray, "nz n"]
    high: Float[np.ndarray, "nz n"]


def build_entries(prior: Prior, observables: Sequence[str], inputs: Sequence[str]) -> Entries:
    """Return the known value and the bounds of each entry of [A B], for these observables and inputs."""
    nz, nu = len(observables), len(inputs)
    known = np.full((nz, nz + nu), np.nan)
    low, high = np.full_like(known, -np.inf), np.full_like(known, np.inf)
    for name, columns in (("A", slice(0, nz)), ("B", slice(nz, nz + nu))):
        shape = known[:, columns].shape
        for end, into in (("lower", low), ("upper", high)):
            into[:, columns] = _check_shape(getattr(prior, f"{end}_{name}"), shape, f"{end}_{name}", scalar=True)
        mask = _check_shape(getattr(prior, f"mask_{name}"), shape, f"mask_{name}")
        if mask is not None:
            known[:, columns][mask == 0] = 0.0
        values = _check_shape(getattr(prior, name), shape, f"Prior.{name}")
        if values is not None:
            _write_known(known[:, columns], values, f"Prior.{name}")
    names = [*observables, *inputs]
    for name, row in (prior.rows or {}).items():
        values = np.zeros((1, nz + nu))
        for other, value in row.items():
            values[0, _find_name(other, names)] = value
        i = _find_name(name, observables)
        _write_known(known[i : i + 1], values, f"rows[{name!r}]")
    bad = np.argwhere((known < low) | (known > high) | (low > high))
    if len(bad):
        i, j = map(int, bad[0])
        raise DataError(
            f"the priors contradict each other at {observables[i]!r} from {names[j]!r}: known {known[i, j]:g}, "
            f"bounds {low[i, j]:g} … {high[i, j]:g}; drop one of them"
        )
    for combination in prior.combinations:
        _check_shape(combination.A, (nz, nz), "Combination.A")
        _check_shape(combination.B, (nz, nu), "Combination.B")
    if prior.dissipation is not None:
        _check_shape(prior.dissipation.P, (nz, nz), "Dissipation.P")
        _check_shape(prior.dissipation.C, (nu, nz), "Dissipation.C")
        _check_shape(prior.dissipation.D, (nu, nu), "Dissipation.D")
    return Entries(known, low, high)


def _check_shape(
    value: ArrayLike | None, shape: tuple[int, ...], name: str, *, scalar: bool = False
) -> np.ndarray | None:
    """Return the array, or None for an absent one; raise if it has another shape."""
    found = None if value is None else np.asarray(value)
    if found is not None and found.shape != shape and not (scalar and found.ndim == 0):
        raise ShapeError(f"{name} has shape {found.shape}, expected {shape}: observables by observables or inputs")
    return found


def _write_known(into: Float[np.ndarray, "r n"], values: Float[np.ndarray, "r n"], name: str) -> None:
    """Write the known values; raise if an entry already has another known value."""
    clash = np.argwhere(np.isfinite(values) & np.isfinite(into) & (values != into))
    if len(clash):
        i, j = map(int, clash[0])
        raise DataError(
            f"{name} says {values[i, j]:g} at ({i}, {j}), where another prior says {into[i, j]:g}; drop one of them"
        )
    if np.isinf(values).any():
        raise DataError(f"{name} holds infinite entries; use NaN where an entry is free")
    np.copyto(into, values, where=np.isfinite(values))


def _find_name(name: str, names: Sequence[str]) -> int:
    places = [i for i, other in enumerate(names) if name in (other, strip_unit(other))]
    if len(places) == 1:
        return places[0]
    raise DataError(f"rows names {name!r}; it can name {', '.join(names)}")
