"""The maximal positively invariant polytope {z: H Aᵏ z ≤ h for all k ≥ 0} of z⁺ = A z (Gilbert and Tan, 1991)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import CertificateError, DataError
from koopmpc.base.values import Value
from koopmpc.control.ask.terminal import TerminalSet, find_support

_TOLERANCE = 1e-9  # a row is redundant if it exceeds its bound by at most this share of it


@dataclass(frozen=True, eq=False)
class InvariantPolytope(Value):
    """{z: H z ≤ h}: a state in it stays in it, and keeps the limits for ever.

    Attributes
    ----------
    H, h
        (p, n), (p,) without redundant rows; h > 0.
    steps
        The limits of so many steps imply those of all later ones.
    """

    H: Float[np.ndarray, "p n"]
    h: Float[np.ndarray, " p"]
    steps: int

    def terminal_set(self) -> TerminalSet:
        """Return the set of the lifted coordinates of a model, as `Limits(terminal=…)` takes it."""
        return TerminalSet(np.zeros(self.H.shape[1]), H=self.H, h=self.h)

    def contains(self, Z: ArrayLike) -> np.ndarray:
        """Return whether a state (n,), or each row of states (M, n), lies in the polytope."""
        return np.asarray((np.asarray(Z, dtype=np.float64) @ self.H.T <= self.h * (1 + _TOLERANCE)).all(axis=-1))


def find_invariant_set(
    A: ArrayLike, H: ArrayLike, h: ArrayLike, *, error: ArrayLike | None = None, most_steps: int = 200
) -> InvariantPolytope:
    """Return the largest set of states from which z⁺ = A z + r keeps H z ≤ h for ever, for every |r| ≤ error.

    With a feedback u = −K z on a lifted linear model, A is A − B K, and limits of inputs are rows −K and K of H. After
    k steps the errors have moved row H_i by Σ_{j<k} |H_i Aʲ| error at most, by which its limit is tightened. Redundant
    rows are found by linear programs.

    Parameters
    ----------
    A
        (n, n) with all eigenvalues inside the unit circle.
    H, h
        (p, n), (p,) the limits; h > 0, so that the origin lies strictly inside.
    error
        (n,) or a number: the largest |r| of each coordinate in a step; by default 0, and the set is the model's own.
    most_steps
        Give up if later steps still add limits after so many.

    Raises
    ------
    DataError
        A is not stable, or the limits exclude the origin.
    CertificateError
        The polytope does not end within `most_steps`, or the errors leave nothing of the limits.

    References
    ----------
    Gilbert & Tan, "Linear systems with state and control constraints: the theory and application of maximal output
    admissible sets", IEEE Trans. Automat. Contr. 36, 1991. Kolmanovsky & Gilbert, "Theory and computation of
    disturbance invariant sets for discrete-time linear systems", Math. Probl. Eng. 4, 1998.

    Examples
    --------
    >>> import koopmpc as km
    >>> found = km.guarantees.find_invariant_set([[0.5, 1.0], [0.0, 0.5]], [[1, 0], [-1, 0]], [1, 1])
    >>> found.steps, found.contains([[0.9, 0.0], [0.9, 0.9]]).tolist()
    (2, [True, False])
    """
    transition = checks.bounded(A, "A", (None, None))
    transition = checks.array(transition, "A", (len(transition), len(transition)))
    rows = checks.bounded(H, "H", (None, len(transition)))
    bounds = checks.vector(h, "h", len(rows))
    limit = checks.count(most_steps, "most_steps")
    if (bounds <= 0).any():
        i = int(np.argmin(bounds))
        raise DataError(f"h[{i}] is {bounds[i]:g}, so the limits exclude the set point at 0; move it inside them")
    radius = float(np.abs(np.linalg.eigvals(transition)).max())
    if radius >= 1:
        raise DataError(f"A has the spectral radius {radius:.6g}, so no loop of it rests; stabilise it first")
    reach = np.zeros(len(transition)) if error is None else checks.vector(error, "error", len(transition))
    if (reach < 0).any():
        raise DataError(f"error is {reach.tolist()}; its entries are sizes, 0 or above")
    live = np.linalg.norm(rows, axis=1) > 0
    kept = rows[live] / bounds[live, None]
    row, room = kept.copy(), np.ones(len(kept))
    for step in range(limit):
        room = room - np.abs(row) @ reach
        row = row @ transition
        if (room <= 0).any():
            raise CertificateError(
                f"the errors of {step + 1} steps use up a limit whole; take a model with a smaller error, or wider"
                " limits"
            )
        new = row / room[:, None]
        added = np.array([find_support(kept, each, ball=False) > 1 + _TOLERANCE for each in new], dtype=np.bool_)
        if not added.any():
            kept = _drop_redundant(kept)
            return InvariantPolytope(kept, np.ones(len(kept)), step)
        kept = np.vstack([kept, new[added]])
    raise CertificateError(
        f"the polytope does not end: limits of step {limit} still cut it. The loop is slow (spectral radius"
        f" {radius:.6g}); raise most_steps, or limit more of the states"
    )


def _drop_redundant(H: Float[np.ndarray, "p n"]) -> Float[np.ndarray, "kept n"]:
    """Return the rows of {H z ≤ 1} that the others do not imply."""
    alive = np.ones(len(H), dtype=np.bool_)
    for i in range(len(H)):
        alive[i] = False
        others = H[alive]
        alive[i] = not len(others) or find_support(others, H[i], ball=False) > 1 + _TOLERANCE
    return H[alive]
