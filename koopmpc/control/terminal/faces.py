"""The QP of a step with a ball, solved on one set of active rows: a secular equation, then all conditions checked."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solve_triangular

from koopmpc.control.limits import Interval, Softness

_BOUNDED = 1e-9  # a singular value below this share of the largest moves nothing
_NEWTON = 60  # steps of the secular equation, at most
_CLOSE = 1e-8  # relative step of Newton's method after which the error, its square, is rounding
_MOST = 64  # faces that are kept
_INSIDE = 1e-9  # a row is met if it is broken by at most this share of 1 + its bound
_TINY = 1e-90  # a norm below it counts as none
_NOTHING = np.zeros(0)
_PULLS = 1e-9  # a multiplier has the right sign above minus this share of the largest


class Price(NamedTuple):
    """A ball may be left by ε ≥ 0 at linear ε + quadratic ε²; linear = inf is a hard ball."""

    linear: float
    quadratic: float


class FaceQP(NamedTuple):
    """½‖q‖² + price(‖y‖ − 1) → min, low ≤ A q ≤ high up to a soft row's price, y = y_0 + D q; w = back q."""

    A: Float[np.ndarray, "m n"]
    D: Float[np.ndarray, "p n"]
    back: Float[np.ndarray, "n n"]
    softness: Softness
    price: Price


class FaceAnswer(NamedTuple):
    """The least w on a face, multipliers of all rows, and y; `multiplier` is the ball's, `sides` the next face to try.

    The answer is the optimum of the whole QP where `sides` is None.
    """

    w: Float[np.ndarray, " n"]
    rows: Float[np.ndarray, " m"]
    y: Float[np.ndarray, " p"]
    multiplier: float
    sides: Int[np.ndarray, " m"] | None


class Face:
    """A set of active rows, each at its lower (−1) or upper end (1), or beyond it at its price (−2, 2).

    On it q = q_p + Z s: y = b + M s, and in the left singular vectors of M the optimum is ŷ_i = b̂_i / (1 + λ s_i²).
    λ solves ‖y‖ = 1, or λ ‖y‖ = price′(‖y‖ − 1). The rest is linear in [e; f; λ y]: the bounds e of the active rows,
    and the forces f of those beyond their ends.

    Raises
    ------
    numpy.linalg.LinAlgError
        The active rows depend on one another.
    """

    def __init__(self, qp: FaceQP, sides: Int[np.ndarray, " m"]) -> None:
        self.sides, self.price = sides, qp.price
        self.at, self.beyond = np.flatnonzero(np.abs(sides) == 1), np.flatnonzero(np.abs(sides) == 2)
        at, beyond, A, D, soft = self.at, self.beyond, qp.A, qp.D, qp.softness
        n, k, known = A.shape[1], len(self.at), len(self.at) + len(self.beyond)
        if k > n:
            raise np.linalg.LinAlgError("more active rows than variables")
        self.upper = sides[at] > 0
        self.signs, self.prices = np.sign(sides[at]).astype(np.float64), soft.linear[at]
        self.beyond_signs = np.sign(sides[beyond]).astype(np.float64)
        self.linear, self.curved = self.beyond_signs * soft.linear[beyond], 2 * soft.quadratic[beyond]
        back, E, pushed = qp.back, A[at], A[beyond]
        if len(beyond):  # ½‖q‖² + ½ Σ c (a q − bound)² = ½‖s‖² + … with q = T s
            root = np.linalg.cholesky(np.eye(n) + (pushed.T * self.curved) @ pushed)
            T = solve_triangular(root, np.eye(n), lower=True).T
            back, A, D, E, pushed = back @ T, A @ T, D @ T, E @ T, pushed @ T
        into = np.empty((n, known + len(D)))  # s = particular e − free f − Mᵀ λ y
        M, multipliers = D, np.empty((k, known + len(D)))
        if k:
            basis, R = np.linalg.qr(E.T)
            size = np.abs(np.diag(R))
            if size.min() < _BOUNDED * size.max():
                raise np.linalg.LinAlgError("active rows that depend on one another")
            inverse = np.linalg.inv(R)
            D_basis = D @ basis
            M = D - D_basis @ basis.T
            into[:, :k] = basis @ inverse.T
            multipliers[:, :k] = -inverse @ inverse.T
            multipliers[:, known:] = -inverse @ D_basis.T
            if len(beyond):
                along = pushed @ basis
                multipliers[:, k:known] = -inverse @ along.T
                pushed = pushed - along @ basis.T
        into[:, k:known], into[:, known:] = -pushed.T, -M.T
        self.left, s, _ = np.linalg.svd(M, full_matrices=n < len(D))
        self.squares = np.zeros(len(D))
        self.squares[: len(s)] = np.where(s > _BOUNDED * max(float(s[0]), 1e-300), s**2, 0.0)
        self.free = self.squares == 0
        self.to_ball = self.left.T @ (D @ into[:, :known])
        self.to_all = np.concatenate([back @ into, multipliers, A @ into])
        self.n = n

    def solve(self, y_0: Float[np.ndarray, " p"], bounds: Interval, guess: float) -> FaceAnswer:
        """Return the least w of the face within these bounds of A w, from a first guess of the ball's multiplier."""
        at, n, k, known, parts = self.at, self.n, len(self.at), None, self.left.T.dot(y_0)
        (low, high), ends = bounds, _NOTHING
        if k:
            known = np.where(self.upper, high[at], low[at])
        if len(self.beyond):
            ends = np.where(self.beyond_signs > 0, high[self.beyond], low[self.beyond])
            forces = self.linear - self.curved * ends
            known = forces if known is None else np.concatenate([known, forces])
        if known is not None:
            parts += self.to_ball.dot(known)
        lam = self._find_multiplier(parts, guess)
        y = self.left.dot(parts / (1 + lam * self.squares))
        whole = self.to_all.dot(lam * y if known is None else np.concatenate([known, lam * y]))
        w, pushes, values = whole[:n], whole[n : n + k], whole[n + k :]
        rows, over, under = np.zeros(len(low)), values - high, low - values
        room = _INSIDE * (1 + sqrt(w.dot(w)))
        met, strength, slack, least = True, self.signs * pushes, _NOTHING, 0.0
        if k:
            rows[at] = pushes
            least = -_PULLS * max(strength.max(), 0.0)
        if len(self.beyond):
            slack = self.beyond_signs * (values[self.beyond] - ends)
            rows[self.beyond] = self.linear + self.beyond_signs * self.curved * slack
            over[self.beyond] = under[self.beyond] = -np.inf
            met = bool((slack >= -room).all())
        if len(low):
            met = met and bool(over.max() <= room and under.max() <= room)
        if met and (not k or (strength.min() >= least and (strength <= self.prices).all())):
            return FaceAnswer(w, rows, y, lam, None)
        sides = self.sides.copy()
        sides[at[strength < least]] = 0
        sides[at[strength > self.prices]] *= 2
        sides[self.beyond[slack < -room]] //= 2
        over[at] = under[at] = -np.inf
        if len(low):
            outside = np.maximum(over, under)
            worst = int(outside.argmax())
            if outside[worst] > room:
                sides[worst] = 1 if over[worst] > under[worst] else -1
        return FaceAnswer(w, rows, y, lam, sides)

    def _find_multiplier(self, parts: Float[np.ndarray, " p"], guess: float) -> float:
        """Return λ ≥ 0 of the ball; where the face cannot meet a hard ball, one at which y is as near as it comes."""
        if parts.dot(parts) <= 1:
            return 0.0
        pairs = list(zip((parts * parts).tolist(), self.squares.tolist(), strict=True))
        linear, quadratic = self.price
        if linear < np.inf and _size(pairs, linear)[0] > 1:
            return _find_priced(pairs, linear, quadratic, sqrt(parts.dot(parts)))
        if self.free.any() and parts[self.free].dot(parts[self.free]) >= 1:
            return 1e12 / max(float(self.squares.max()), 1e-12)
        lam = guess
        for _ in range(_NEWTON):  # 1/‖y‖ is nearly linear in λ: Newton's method from the left never oversteps
            size, slope = _size(pairs, lam)
            if size <= _TINY:  # a guess from another step
                lam = 0.0
                continue
            step = (1 - 1 / size) / slope
            lam = max(lam + step, 0.0)
            if abs(step) <= _CLOSE * lam:
                break
        return lam


def _size(pairs: list[tuple[float, float]], lam: float) -> tuple[float, float]:
    """Return ‖y‖ at λ and the slope of 1/‖y‖."""
    total = slope = 0.0
    for part, square in pairs:
        shrink = 1 / (1 + lam * square)
        piece = part * shrink * shrink
        total += piece
        slope += piece * square * shrink
    size = max(total**0.5, _TINY)
    return size, slope / size**3


def _find_priced(pairs: list[tuple[float, float]], linear: float, quadratic: float, most: float) -> float:
    """Return λ with λ ‖y‖ = linear + 2 quadratic (‖y‖ − 1), which rises with λ: Newton's method between two ends."""
    low, high = 0.0, linear + 2 * quadratic * (most - 1)
    lam = high / most
    for _ in range(_NEWTON):
        size, slope = _size(pairs, lam)
        missed = lam * size - linear - 2 * quadratic * (size - 1)
        low, high = (lam, high) if missed < 0 else (low, lam)
        rise = size + (2 * quadratic - lam) * slope * size**2
        step = missed / rise if rise > 0 else np.inf
        new = lam - step
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - lam) <= _CLOSE * new:
            return new
        lam = new
    return lam


class Faces:
    """The faces of a QP with a ball: those that were met are kept."""

    def __init__(self, qp: FaceQP) -> None:
        self._qp = qp
        self._known: dict[bytes, Face | None] = {}

    def find_sides(self, rows: Float[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
        """Return the face that these multipliers push to."""
        size = np.abs(rows)
        sides = np.sign(rows).astype(np.int8)
        sides[size <= 1e-10 * float(size.max(initial=0.0))] = 0
        sides[size >= (1 - 1e-9) * self._qp.softness.linear] *= 2
        return sides

    def solve(
        self, sides: Int[np.ndarray, " m"], y_0: Float[np.ndarray, " p"], bounds: Interval, guess: float
    ) -> FaceAnswer | None:
        """Return the answer on a face; None where its rows depend on one another."""
        key = sides.tobytes()
        if key not in self._known:
            if len(self._known) >= _MOST:
                self._known.clear()
            try:
                self._known[key] = Face(self._qp, sides)
            except np.linalg.LinAlgError:
                self._known[key] = None
        face = self._known[key]
        return None if face is None else face.solve(y_0, bounds, guess)
