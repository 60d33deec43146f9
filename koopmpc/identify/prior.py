"""What an engineer knows of A and B before the data: entries, rows, zeros, bounds, sums, symmetry, stored energy."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.values import Value


@dataclass(frozen=True, eq=False, init=False)
class Combination(Value):
    """low ≤ Σ Fᵢⱼ Aᵢⱼ + Σ Gᵢⱼ Bᵢⱼ ≤ high, an equation where low = high.

    Parameters
    ----------
    low, high
        Numbers, or ∓inf.
    A, B
        The weights F (nz, nz) and G (nz, nu); zero by default.
    """

    low: float
    high: float
    A: Float[np.ndarray, "nz nz"] | None
    B: Float[np.ndarray, "nz nu"] | None

    def __init__(
        self, low: float, high: float, *, A: ArrayLike | None = None, B: ArrayLike | None = None
    ) -> None:
        if A is None and B is None:
            raise DataError("a Combination has no weights; pass A, B or both")
        ends = checks.array([low, high], "low, high", (2,), infinite=True)
        checks.crossed(ends[:1], ends[1:], "Combination")
        for name, value in {
            "low": float(ends[0]),
            "high": float(ends[1]),
            "A": None if A is None else checks.array(A, "Combination.A", (None, None)),
            "B": None if B is None else checks.array(B, "Combination.B", (None, None)),
        }.items():
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False, init=False)
class Storage(Value):
    """Dissipation with V(z) = ½ zᵀP z: V(A z + B u) ≤ decay² V(z) + uᵀ(C z + D u) for every z and u.

    With decay = 1 this is passivity from u to y = C z + D u in discrete time. Without C it is V(A z) ≤ decay² V(z)
    alone: a contraction, and so a stable A where P ≻ 0. P is given; `stable_edmd` finds one.

    Parameters
    ----------
    P
        (nz, nz) ⪰ 0 or its diagonal: zero where an observable stores nothing.
    decay
        Above 0.
    C
        (nu, nz) output that belongs to the inputs.
    D
        (nu, nu); zero by default. A sampled system whose B is not zero needs D + Dᵀ ≻ 0 to be passive.

    References
    ----------
    Byrnes & Lin, "Losslessness, feedback equivalence, and the global stabilization of discrete-time nonlinear
    systems", IEEE Trans. Automat. Contr. 39, 1994.
    """

    P: Float[np.ndarray, "nz nz"]
    decay: float
    C: Float[np.ndarray, "nu nz"] | None
    D: Float[np.ndarray, "nu nu"] | None

    def __init__(
        self, P: ArrayLike, *, decay: float = 1.0, C: ArrayLike | None = None, D: ArrayLike | None = None
    ) -> None:
        if C is None and D is not None:
            raise DataError("Storage has D but no C; pass the output C that D belongs to")
        for name, value in {
            "P": checks.weight(P, "Storage.P"),
            "decay": checks.positive(decay, "decay"),
            "C": None if C is None else checks.array(C, "Storage.C", (None, None)),
            "D": None if D is None else checks.array(D, "Storage.D", (None, None)),
        }.items():
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False, init=False)
class Prior(Value):
    """What is known of z⁺ = A z + B u; `constrained_edmd` finds the rest.

    Parameters
    ----------
    A, B
        Known entries, (nz, nz) and (nz, nu); NaN where an entry is free. With measured disturbances B stands for
        [B E], here and below.
    rows
        Known rows by name: ``{"x [m]": {"x [m]": 1.0, "v [m/s]": 0.1}}`` says x⁺ = x + 0.1 v. What a row does not
        name is zero in it. Names stand with or without the unit.
    mask_A, mask_B
        True where an entry may differ from zero.
    lower_A, upper_A, lower_B, upper_B
        Bounds, arrays or one number for all entries; ±inf where there is none. A sign is a bound at 0.
    symmetric
        A = Aᵀ.
    combinations
        Weighted sums of entries between limits.
    storage
        Passivity or contraction.

    Raises
    ------
    ShapeError, DataError
        The parts are no such arrays, or contradict each other.
    """

    A: Float[np.ndarray, "nz nz"] | None
    B: Float[np.ndarray, "nz nu"] | None
    rows: dict[str, dict[str, float]]
    mask_A: Bool[np.ndarray, "nz nz"] | None
    mask_B: Bool[np.ndarray, "nz nu"] | None
    lower_A: Float[np.ndarray, "..."]
    upper_A: Float[np.ndarray, "..."]
    lower_B: Float[np.ndarray, "..."]
    upper_B: Float[np.ndarray, "..."]
    symmetric: bool
    combinations: tuple[Combination, ...]
    storage: Storage | None

    def __init__(
        self,
        *,
        A: ArrayLike | None = None,
        B: ArrayLike | None = None,
        rows: Mapping[str, Mapping[str, float]] | None = None,
        mask_A: ArrayLike | None = None,
        mask_B: ArrayLike | None = None,
        lower_A: ArrayLike = -np.inf,
        upper_A: ArrayLike = np.inf,
        lower_B: ArrayLike = -np.inf,
        upper_B: ArrayLike = np.inf,
        symmetric: bool = False,
        combinations: Sequence[Combination] = (),
        storage: Storage | None = None,
    ) -> None:
        known = {
            name: {other: float(checks.array(v, f"rows[{name!r}]", ())) for other, v in row.items()}
            for name, row in (rows or {}).items()
        }
        for name, value in {
            "A": None if A is None else checks.array(A, "Prior.A", (None, None), finite=False),
            "B": None if B is None else checks.array(B, "Prior.B", (None, None), finite=False),
            "rows": known,
            "mask_A": None if mask_A is None else checks.array(mask_A, "mask_A", (None, None)) != 0,
            "mask_B": None if mask_B is None else checks.array(mask_B, "mask_B", (None, None)) != 0,
            "lower_A": checks.array(lower_A, "lower_A", infinite=True),
            "upper_A": checks.array(upper_A, "upper_A", infinite=True),
            "lower_B": checks.array(lower_B, "lower_B", infinite=True),
            "upper_B": checks.array(upper_B, "upper_B", infinite=True),
            "symmetric": bool(symmetric),
            "combinations": tuple(combinations),
            "storage": storage,
        }.items():
            object.__setattr__(self, name, value)

    @property
    def coupled(self) -> bool:
        """Whether rows of [A B] depend on each other."""
        return self.symmetric or bool(self.combinations) or self.storage is not None
