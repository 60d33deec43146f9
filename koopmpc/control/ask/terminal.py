"""`TerminalSet`: where a plan has to end, and whether it is inside limits that move."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Interval, Value
from koopmpc.lifting.base import Lifting

_ADVICE = "make one with km.guarantees.find_terminal_set, or pass a Certificate"


@dataclass(frozen=True, eq=False)
class TerminalFeedback(Value):
    """u = u_c + (I − K_w (I ⊗ δ))⁻¹ K δ with δ = ξ − c, under which a terminal set is not left.

    Attributes
    ----------
    u
        (nu,) the input u_c at the center.
    K
        (nu, n) gain.
    K_w
        (nu, nu n) of a feedback that is a quotient; None for a linear one.
    """

    u: ArrayLike
    K: ArrayLike
    K_w: ArrayLike | None = None

    def __post_init__(self) -> None:
        u, K = checks.array(self.u, "u", (None,)), checks.array(self.K, "K", (None, None))
        K = checks.array(K, "K", (len(u), K.shape[1]))
        object.__setattr__(self, "u", u)
        object.__setattr__(self, "K", K)
        if self.K_w is not None:
            object.__setattr__(self, "K_w", checks.array(self.K_w, "K_w", (len(u), K.size)))


@dataclass(frozen=True, eq=False)
class TerminalSet(Value):
    """{ξ: H (ξ − c) ≤ h}, or {ξ: (ξ − c)ᵀW(ξ − c) ≤ 1}, of observables ξ at the end of a plan.

    Attributes
    ----------
    center
        (n,) c.
    of
        The observables; None for all lifted coordinates of the controller's own model (of a map, its states).
    H, h
        (p, n), (p,) of a polytope, h > 0; None for an ellipsoid.
    W
        (n, n) positive definite, of an ellipsoid; None for a polytope.
    with_input
        Whether the last input u_{N−1} stands behind the observables in ξ.
    kept
        (k,) which of the observables ξ holds; None for all. A Constant cannot be one of them.
    feedback
        The feedback that keeps ξ in the set, and the limits; None where it is not known. BilinearMPC and NonlinearMPC
        with the set hard then keep the plan that they accepted until they find a better one.

    Raises
    ------
    DataError
        Neither or both of H and W are given; h is not above zero; W is not positive definite.
    ShapeError
        The feedback has another number of coordinates.

    Examples
    --------
    >>> import koopmpc as km
    >>> box = km.guarantees.TerminalSet([0.0], of=km.State([0]), H=[[1.0], [-1.0]], h=[0.1, 0.1])
    >>> box.contains([[0.05], [0.2]]).tolist()
    [True, False]
    """

    center: ArrayLike
    of: Lifting | None = None
    H: ArrayLike | None = None
    h: ArrayLike | None = None
    W: ArrayLike | None = None
    with_input: bool = False
    kept: tuple[int, ...] | None = None
    feedback: TerminalFeedback | None = None

    def __post_init__(self) -> None:
        center = checks.array(self.center, "center", (None,))
        n = len(center)
        object.__setattr__(self, "center", center)
        if self.of is not None:
            checks.kind(self.of, "of", Lifting, "for example km.State()")
        if self.feedback is not None:
            checks.kind(self.feedback, "feedback", TerminalFeedback, "km.guarantees.TerminalFeedback(u, K)")
            require_size(np.shape(self.feedback.K)[1], n, "feedback of the terminal set")
        if (self.H is None) == (self.W is None) or (self.H is None) != (self.h is None):
            raise DataError("a terminal set is a polytope, H and h, or an ellipsoid, W; pass one of the two")
        if self.W is not None:
            object.__setattr__(self, "W", checks.weight(self.W, "W", n, definite=True))
            return
        H = checks.array(self.H if self.H is not None else [], "H", (None, n))
        h = checks.vector(self.h if self.h is not None else [], "h", len(H))
        if (h <= 0).any() or not np.linalg.norm(H, axis=1).all():
            raise DataError("h must be above 0 and no row of H zero, so that the center lies inside; move the center")
        object.__setattr__(self, "H", H)
        object.__setattr__(self, "h", h)

    @property
    def is_ellipsoid(self) -> bool:
        """Whether the set is an ellipsoid."""
        return self.W is not None

    def measure(self, xi: ArrayLike) -> Float[np.ndarray, "..."]:
        """Return the gauge of points ξ (n,) or (M, n): the set is where it is at most 1, the center where it is 0."""
        points: np.ndarray = np.asarray(xi, dtype=np.float64)
        center: np.ndarray = np.asarray(self.center, dtype=np.float64)
        values: np.ndarray = (points - center) @ self.rows.T
        return np.asarray(np.linalg.norm(values, axis=-1) if self.is_ellipsoid else values.max(axis=-1))

    def contains(self, xi: ArrayLike) -> np.ndarray:
        """Return whether a point ξ (n,), or each row of points (M, n), lies in the set."""
        return np.asarray(self.measure(xi) <= 1 + 1e-9)

    @property
    def rows(self) -> Float[np.ndarray, "p n"]:
        """F: the set is F (ξ − c) ≤ 1 row by row for a polytope, ‖F (ξ − c)‖ ≤ 1 for an ellipsoid."""
        if self.W is not None:
            return np.linalg.cholesky(np.asarray(self.W)).T
        H = np.asarray(self.H, dtype=np.float64)
        return H / np.asarray(self.h, dtype=np.float64)[:, None]


@runtime_checkable
class HasTerminalSet(Protocol):
    """What knows a terminal set of its own, such as a certificate."""

    def terminal_set(self) -> TerminalSet:
        """Return the set."""
        ...


def read_terminal_set(given: object) -> TerminalSet:
    """Return the terminal set that a user passes."""
    found = given.terminal_set() if isinstance(given, HasTerminalSet) else given
    checks.kind(found, "terminal", TerminalSet, _ADVICE)
    assert isinstance(found, TerminalSet)
    return found


def terminal_function(wanted: TerminalSet, states: tuple[str, ...], nu: int) -> ca.Function:
    """Return (x, u_{N−1}) → values that are at most 1 where x lies in the set: F (ξ − c), or (ξ − c)ᵀW(ξ − c)."""
    x, u, away = _trace_deviation(wanted, states, nu)
    value = ca.mtimes(ca.DM(wanted.rows), away)
    return ca.Function("terminal", [x, u], [ca.densify(ca.sumsqr(value) if wanted.is_ellipsoid else value)])


def terminal_feedback(wanted: TerminalSet, states: tuple[str, ...], nu: int) -> ca.Function:
    """Return (x, u_{k−1}) → u of the feedback of a terminal set."""
    law = wanted.feedback
    assert law is not None, "only asked where the set has a feedback"
    x, u, away = _trace_deviation(wanted, states, nu)
    require_size(len(np.asarray(law.u)), nu, "feedback of the terminal set")
    v = ca.mtimes(ca.DM(np.asarray(law.K)), away)
    if law.K_w is not None:
        v = ca.solve(ca.SX.eye(nu) - ca.mtimes(ca.DM(np.asarray(law.K_w)), ca.kron(ca.SX.eye(nu), away)), v)
    return ca.Function("feedback", [x, u], [ca.densify(ca.DM(np.asarray(law.u)) + v)])


def _trace_deviation(wanted: TerminalSet, states: tuple[str, ...], nu: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return x, u_{k−1} and ξ − c."""
    x, u = ca.SX.sym("x", len(states)), ca.SX.sym("u", nu)
    xi = x if wanted.of is None else wanted.of.bind(states).symbolic(x)
    xi = xi if wanted.kept is None else xi[list(wanted.kept), 0]
    xi = ca.vertcat(xi, u) if wanted.with_input else xi
    center = np.asarray(wanted.center)
    require_size(len(center), xi.size1())
    return x, u, xi - ca.DM(center)


def require_size(had: int, wanted: int, what: str = "terminal set") -> None:
    """Raise where a set has another number of coordinates than a model."""
    if had != wanted:
        raise ShapeError(
            f"the {what} has {had} coordinates, the model {wanted}; make the set of this model, or name its"
            " observables with of="
        )


_TOLERANCE = 1e-7  # a limit is kept if it is exceeded by at most this share of 1 + its size
_HELD = 1e-9  # what an output has besides the coordinates of the set, as a share of it


class EndReach(NamedTuple):
    """The extremes on a terminal set: of limited outputs, of the inputs of its feedback, and of their changes.

    Without a known feedback `inputs` and `rates` have the value None.
    """

    outputs: Interval
    inputs: Interval | None
    rates: Interval | None


def find_support(rows: Float[np.ndarray, "p n"], direction: Float[np.ndarray, " n"], *, ball: bool) -> float:
    """Return max a·ξ over F ξ ≤ 1, by a linear program, or over ‖F ξ‖ ≤ 1; inf where nothing bounds it."""
    if ball:
        return float(np.linalg.norm(np.linalg.solve(rows.T, direction)))
    from scipy.optimize import linprog  # slow to import

    found = linprog(-direction, A_ub=rows, b_ub=np.ones(len(rows)), bounds=(None, None), method="highs")
    return float(-found.fun) if found.status == 0 and found.fun is not None else np.inf


def measure_reach(
    wanted: TerminalSet,
    places: Float[np.ndarray, "n nz"],
    outputs: Float[np.ndarray, "ny nz"],
    constant: int | None,
) -> EndReach:
    """Return the extremes on a set of ξ = E z, or [E z; u_{k−1}] where it holds the last input.

    Parameters
    ----------
    places
        E.
    outputs
        What is limited, as rows on z.
    constant
        The coordinate of z that is 1; None if there is none.
    """
    center: np.ndarray = np.asarray(wanted.center, dtype=np.float64)
    n, free = len(places), [i for i in range(places.shape[1]) if i != constant]
    E, G = places[:, free], outputs[:, free]
    A = np.linalg.lstsq(E.T, G.T, rcond=None)[0].T if n else np.zeros((len(G), 0))  # G = A E where ξ tells it
    known = np.abs(A @ E - G).max(axis=1, initial=0.0) <= _HELD * (1 + np.abs(G).max(axis=1, initial=0.0))
    value = A @ center[:n]
    if constant is not None:
        value = value + outputs[:, constant] - A @ places[:, constant]
    wide = np.hstack([A, np.zeros((len(A), len(center) - n))])
    shown = _find_extremes(wanted, wide, value)
    ends = (np.where(known, end, far) for end, far in zip(shown, (-np.inf, np.inf), strict=True))
    law = wanted.feedback
    if law is None or (law.K_w is not None and np.asarray(law.K_w).any()):
        return EndReach(Interval(*ends), None, None)
    u, K = np.asarray(law.u, dtype=np.float64), np.asarray(law.K, dtype=np.float64)
    rates = None
    if wanted.with_input:  # u_{k−1} is the center's input and the last coordinates of the deviation
        last = np.hstack([np.zeros((len(u), n)), np.eye(len(u))])
        rates = _find_extremes(wanted, K - last, u - center[n:])
    return EndReach(Interval(*ends), _find_extremes(wanted, K, u), rates)


def _find_extremes(wanted: TerminalSet, rows: Float[np.ndarray, "k n"], value: Float[np.ndarray, " k"]) -> Interval:
    """Return the extremes of value + rows (ξ − c) over the set."""
    F, ball = wanted.rows, wanted.is_ellipsoid
    far = [[find_support(F, sign * row, ball=ball) for row in rows] for sign in (-1.0, 1.0)]
    return Interval(value - np.array(far[0]), value + np.array(far[1]))


def require_inside(
    what: str, reach: Interval | None, rows: Interval, first: int, names: Sequence[str], *, moved: bool
) -> None:
    """Raise where a terminal set leaves its limits in a row, from `first` on; the last row is held.

    Where the reach is not known, the limits may not move.
    """
    if reach is None:
        if moved:
            raise DataError(
                f"limits of {what} move in time, and the terminal set does not tell the {what} of its feedback; pass a"
                " set of km.guarantees.find_terminal_set with the same cost and limits, or leave one out"
            )
        return
    first = min(first, len(rows.low) - 1)
    for end, bound, sign in ((reach.low, rows.low[first:], -1.0), (reach.high, rows.high[first:], 1.0)):
        known = np.isfinite(bound)
        limit = np.where(known, bound, 0.0)
        over = np.where(known, sign * (end - limit) - _TOLERANCE * (1 + np.abs(limit)), -np.inf)
        if (over > 0).any():
            k, i = (int(at) for at in np.argwhere(over == over.max())[0])
            raise DataError(
                f"the terminal set reaches {names[i]} = {end[i]:.7g} and the {what} limit of row {k + first} is"
                f" {bound[k, i]:.7g}, so plans that end in it may leave limits of later rows; make the set with the"
                " tightest limits of these rows, or leave one out"
            )
