"""Invariance proximity: the worst relative one-step error over all functions in the span of a dictionary."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.identify.moments.moments import Moments, both_sides, orthonormal
from koopmpc.identify.solve import norms
from koopmpc.values import Value


@dataclass(frozen=True, eq=False)
class Invariance(Value):
    """How far span ψ is from being mapped into itself, by the data.

    Attributes
    ----------
    proximity
        sup over f in span ψ of min_g ‖f(x⁺) − g‖ / ‖f(x⁺)‖, g in the span of ψ(x) (and of u, and of u⊗ψ(x) for a
        bilinear model): the sine of the largest principal angle, 0 … 1. 0: the dictionary is invariant. 1: it
        holds a function of whose next value nothing is known.
    worst
        (nz,) that function, f = ψ · worst, of root-mean-square 1.
    errors
        (nz,) the same error for each observable itself; 0 for one that is 0 throughout.
    names
        Of the observables.
    """

    proximity: float
    worst: Float[np.ndarray, " nz"]
    errors: Float[np.ndarray, " nz"]
    names: tuple[str, ...]

    @property
    def index(self) -> float:
        """Consistency index ρ = λ_max(I − M_f M_b) = proximity², M_f and M_b the EDMD forward and backward in time."""
        return self.proximity**2


def invariance(total: Moments) -> Invariance:
    """Return the invariance proximity of the dictionary of these moments, one that no choice of basis changes.

    With inputs the dictionary predicts with their help: what u explains is no lack of invariance. Directions of
    span ψ that are rounding on the data (relative size eps · M; its square root on Gram sums) are left out.
    Measurement noise counts, for noise is not predictable: a nearly dependent dictionary holds a function that is
    mostly noise, and its proximity is near 1 even where `errors` are small.

    Parameters
    ----------
    total
        ``moments(episodes, lifting)``; ``route="qr"`` resolves 0 to rounding, Gram sums to about 1e-8 times the
        condition number.

    References
    ----------
    Haseli & Cortés, "Temporal forward-backward consistency, not residual error, measures the prediction accuracy
    of extended dynamic mode decomposition", IEEE Control Syst. Lett. 7, 2023; the same, "Invariance proximity:
    closed-form error bounds for finite-dimensional Koopman-based models", 2023.
    """
    P, T, cut = both_sides(total)
    known = orthonormal(P, cut)
    size = norms(T)
    scale = np.where(size > 0, size, 1.0)
    unexplained = T / scale - known @ (known.T @ (T / scale))
    U, s, Vt = np.linalg.svd(T / scale, full_matrices=False)
    held = s > cut * s.max(initial=0.0)
    span = U[:, held]
    _, angles, directions = np.linalg.svd(span - known @ (known.T @ span), full_matrices=False)
    nz = total.nz
    if not held.any():
        return Invariance(0.0, np.zeros(nz), np.zeros(nz), total.lifting.names)
    worst = (Vt[held].T / s[held]) @ directions[0] / scale * np.sqrt(total.samples)
    return Invariance(float(min(angles[0], 1.0)), worst, np.minimum(norms(unexplained), 1.0), total.lifting.names)
