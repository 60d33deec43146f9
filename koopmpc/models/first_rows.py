"""The state in which a record begins, from its first rows by least squares."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episode
from koopmpc.models.hidden_state import HiddenState
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.conversion import is_hidden
from koopmpc.models.shared.levenberg_marquardt import find_starts

_ENCODED = 0.1  # spread of an entry of a hidden state that past rows give
_PUSH = 0.1  # spread of an unknown past input, at least, as a share of one that moves an output by its size
_FAR = 1e6  # a forecast of so many sizes has left the model


def estimate_start(
    model: LinearPredictor | BilinearPredictor, X: ArrayLike, U: ArrayLike
) -> Float[np.ndarray, " npoint"]:
    """Return the point p_K behind K + 1 first rows of a record, from the p_0 that explains them best.

    min over p_0 of Σ_{k=0}^{K} ‖(x̂_k − x_k) / σ‖² + ‖(p_0 − p̄) / s‖², p_{k+1} = F(p_k, u_k), where x̂ is the first part
    of p. σ is the residual of the fit, s the sizes of the data, of inputs a tenth of what moves an output so far at
    least, and p̄ the point of a plant that has rested in x_0 under u_0. So fewer rows than the model's past suffice. Of
    more rows the first ones give p̄, and s is σ, or 0.1 for entries of a hidden state; the others take noise out of it.
    Errors of the model between the rows count as noise of readings, so pass few rows of a model that errs. Gauss-Newton
    with exact derivatives finds p_0. Entries of X that are NaN are left out, and so are readings at a rail with x̂
    beyond.

    A forecast begins at the result: `model.step_map().rollout(p_K, U)`, where F is the re-lifted map, as in
    BilinearMPC. A linear model with a hidden state z = T ζ is lifted once: z is found, ζ is the nearest past with this
    z, and a forecast is `model.rollout(p_K, U)`.

    Parameters
    ----------
    model
        Its states, and a past or a hidden state that the rows leave open.
    X
        (K + 1, nx) first rows, as measured.
    U
        (K, nu) inputs of the rows before the last one.

    Raises
    ------
    DataError
        No row is whole; the model has measured disturbances; its forecasts of these rows overflow.
    ShapeError
        X or U have other columns, or U has not one row less than X.

    References
    ----------
    Ljung, "System Identification: Theory for the User", 2nd edition, 1999, section 10.5 (initial conditions).

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> u, y, hidden = np.random.default_rng(0).uniform(-1, 1, 400), np.zeros(401), 0.0
    >>> for k in range(400):
    ...     y[k + 1] = 0.7 * y[k] + 0.5 * hidden
    ...     hidden = 0.9 * hidden + u[k]
    >>> data = km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 0.1, ["y"], ["u"])
    >>> model = km.identify.subspace(data, 2, delays=4)
    >>> start = km.identify.estimate_start(model, y[100:104, None], u[100:103, None])  # four rows, a past of five
    >>> free = model.rollout(start, u[103:150, None])[:, 0]
    >>> bool(np.abs(free - y[103:151]).max() < 1e-5)
    True
    """
    checks.kind(model, "model", (LinearPredictor, BilinearPredictor), "pass what a fit returns")
    if model.nw:
        raise DataError("the model has measured disturbances, of which its past holds none; fit it without them")
    rows = checks.array(X, "X", (None, model.nx), finite=False)
    moves = checks.array(U, "U", (max(len(rows) - 1, 0), model.nu))
    whole = np.flatnonzero(np.isfinite(rows).all(axis=1))
    if not len(whole):
        raise DataError("no row of X is whole, so nothing tells where the record begins; pass one that is")
    usual, spread, reach, noise, rows, moves = _describe_start(model, rows, moves, rows[whole[0]])
    course: _LinearCourse | _PointCourse
    if isinstance(model, LinearPredictor) and is_hidden(model):
        course = _LinearCourse(model, usual, spread, reach)
    else:
        course = _PointCourse(model, usual, spread, reach)

    @np.errstate(over="ignore", invalid="ignore")
    def explain(w: Float[np.ndarray, "1 n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the residuals of the start v̄ + L w, their derivative, and the state behind the rows."""
        v, D = course.mean + course.factor @ w[0], course.factor
        gaps, slopes = [w[0]], [np.eye(len(w[0]))]
        for k, row in enumerate(rows):
            shown, told = course.C @ v + course.c, np.isfinite(row)
            if model.embedding is not None:
                told &= ~model.embedding.is_beyond(row, shown)
            gaps.append(((shown - row) / noise)[told])
            slopes.append((course.C @ D / noise[:, None])[told])
            if k < len(moves):
                v, D = course.advance(v, moves[k]), course.slope(v, moves[k]) @ D
                if not (np.abs(v) < _FAR * course.reach).all() or not np.isfinite(D @ D.T).all():
                    return np.full(1, np.inf), np.zeros((1, len(w[0]))), v
        return np.concatenate(gaps), np.vstack(slopes), v

    def evaluate(w: Float[np.ndarray, "1 n"]) -> Float[np.ndarray, "1"]:
        return np.array([np.sum(explain(w)[0] ** 2)])

    def step(w: Float[np.ndarray, "1 n"]) -> Float[np.ndarray, "1 n"]:
        gap, slope, _ = explain(w)  # slopeᵀ slope would square the condition number
        return np.asarray(np.linalg.lstsq(slope, -gap, rcond=None)[0])[None]

    start = np.zeros((1, course.factor.shape[1]))
    if not np.isfinite(evaluate(start)).all():
        raise DataError(f"the model's forecast of these {len(rows)} rows overflows; pass fewer first rows")
    return course.point(explain(find_starts(evaluate, step, start))[2], rows, moves)


def _describe_start(
    model: LinearPredictor | BilinearPredictor,
    rows: Float[np.ndarray, "k1 nx"],
    moves: Float[np.ndarray, "k nu"],
    first: Float[np.ndarray, " nx"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return p̄, s, the sizes of p's entries, σ, and the rows and inputs behind the past, of which p̄ is made."""
    before = moves[0] if len(moves) else np.zeros(model.nu)
    size = np.ones(model.nx) if model.scale is None else np.linalg.norm(model.scale @ model.C.T, axis=0)
    size = np.where(size > 0, size, 1.0)
    noise = 0.01 * size if model.report is None else np.maximum(model.report.residual, 1e-6 * size)
    if model.embedding is None:
        return first, size, size, noise, rows, moves
    past, usual = model.embedding.steps, model.embedding.repeat(first, before)
    pushes = np.maximum(np.abs(moves).max(axis=0, initial=0.0), _PUSH * _size_inputs(model, usual, before, size))
    spread = reach = np.abs(model.embedding.spread(size, pushes))
    if past < len(rows) and np.isfinite(rows[: past + 1]).all():
        usual = model.start(rows[past], Episode(X=rows[: past + 1], U=moves[:past]))
        spread = model.embedding.spread(noise, np.zeros(model.nu))
        if isinstance(model.embedding, HiddenState):
            spread[model.nx :] = _ENCODED
        rows, moves = rows[past:], moves[past:]
    return usual, spread, reach, noise, rows, moves


def _size_inputs(
    model: LinearPredictor | BilinearPredictor,
    usual: Float[np.ndarray, " npoint"],
    before: Float[np.ndarray, " nu"],
    size: Float[np.ndarray, " nx"],
) -> Float[np.ndarray, " nu"]:
    """Return for each input how much of it, held for as long as the model's past, moves some output by its size."""
    here = model.step_map().linearize(usual, before)
    held, most = np.zeros_like(here.B), np.zeros(model.nu)
    for _ in range(1 if model.embedding is None else model.embedding.steps + 1):
        held = here.A @ held + here.B
        most = np.maximum(most, np.abs(held[: model.nx] / size[:, None]).max(axis=0, initial=0.0))
    return np.divide(1.0, most, out=np.ones(model.nu), where=most > 0)


class _PointCourse:
    """The re-lifted map of a model, whose state is the point itself."""

    def __init__(
        self,
        model: LinearPredictor | BilinearPredictor,
        usual: Float[np.ndarray, " npoint"],
        spread: Float[np.ndarray, " npoint"],
        reach: Float[np.ndarray, " npoint"],
    ) -> None:
        self._plant, n = model.step_map(), len(usual)
        self.mean, self.factor, self.reach = usual, np.diag(spread), np.maximum(reach, 1.0)
        self.C: Float[np.ndarray, "nx n"] = np.eye(model.nx, n)
        self.c: Float[np.ndarray, " nx"] = np.zeros(model.nx)

    def advance(self, v: Float[np.ndarray, " n"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " n"]:
        """Return the next state."""
        return self._plant(v, u)

    def slope(self, v: Float[np.ndarray, " n"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, "n n"]:
        """Return its derivative by the state."""
        return self._plant.linearize(v, u).A

    def point(
        self, v: Float[np.ndarray, " n"], rows: Float[np.ndarray, "k1 nx"], moves: Float[np.ndarray, "k nu"]
    ) -> Float[np.ndarray, " npoint"]:
        """Return the point of a state."""
        del rows, moves
        return v


class _LinearCourse:
    """z⁺ = A z + B u + b of a linear model with a hidden state z = T ζ, lifted once as KoopmanMPC does."""

    def __init__(
        self,
        model: LinearPredictor,
        usual: Float[np.ndarray, " nzeta"],
        spread: Float[np.ndarray, " nzeta"],
        reach: Float[np.ndarray, " nzeta"],
    ) -> None:
        n = model.nz - 1
        assert model.embedding is not None, "z is a function of the past"
        self._embedding, self._usual = model.embedding, usual
        self._A, self._B, self._b = model.A[:n, :n], model.B[:n], model.A[:n, n]
        zero = model.lifting(np.zeros((1, len(usual))))[0, :n]
        self._T: Float[np.ndarray, "n nzeta"] = (model.lifting(np.eye(len(usual)))[:, :n] - zero).T
        self._weighed = self._T * spread
        self.mean = self._T @ usual + zero
        U, S, _ = np.linalg.svd(self._weighed, full_matrices=False)
        self.factor = U * S
        self.C, self.c = model.C[:, :n], model.C[:, n]
        self.reach: Float[np.ndarray, " n"] = np.maximum(np.linalg.norm(self._T * reach, axis=1), 1.0)
        self._zero, self._spread = zero, spread

    def advance(self, v: Float[np.ndarray, " n"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " n"]:
        """Return the next state."""
        return self._A @ v + self._B @ u + self._b

    def slope(self, v: Float[np.ndarray, " n"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, "n n"]:
        """Return its derivative by the state."""
        del v, u
        return self._A

    def point(
        self, v: Float[np.ndarray, " n"], rows: Float[np.ndarray, "k1 nx"], moves: Float[np.ndarray, "k nu"]
    ) -> Float[np.ndarray, " nzeta"]:
        """Return the point with T ζ = z, and x̂ in front, that is nearest to the measured rows."""
        zeta = self._usual
        for u, row in zip(moves, rows[1:], strict=True):
            shown = zeta[: len(row)]
            zeta = self._embedding.shift(zeta, u, np.where(np.isfinite(row), row, shown))
        shown, nx = self.C @ v + self.c, len(self.C)
        gap = np.concatenate([v - self._T @ zeta - self._zero, (shown - zeta[:nx]) / self._spread[:nx]])
        both = np.vstack([self._weighed, np.eye(nx, len(zeta))])
        return zeta + self._spread * np.linalg.lstsq(both, gap, rcond=None)[0]
