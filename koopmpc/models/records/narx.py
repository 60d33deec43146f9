"""narx: a polynomial of few terms in the past of outputs and inputs, as a predictor lifted afresh at each step."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import product
from typing import Protocol, TypeVar, Unpack, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.data.source import Source, source_of
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.forward import (
    Terms,
    count_terms,
    evaluate_terms,
    list_terms,
    select_forward,
    solve_nested,
)
from koopmpc.models.records.free_run import Models, Pieces, are_calm, embed_rows, run_freely
from koopmpc.models.records.structure import (
    EXACT,
    Structure,
    average_errors,
    check_rails,
    find_forecast_horizon,
    find_told_rows,
    fit_structure,
)

DELAYS = (0, 1, 2, 3, 4, 6, 8, 12)  # numbers of past rows that are tried
DEGREES = (1, 2, 3)  # total degrees of the polynomials that are tried
SIZES = (1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 22, 28, 36, 46, 60)  # numbers of terms for each state
FOLDS = 4  # stretches of the record that are left out in turn
MOST = 2600  # terms to choose from, of all states together: a structure with more is not tried
NUMBERS = 8_000_000  # entries of the table that terms are chosen on: of more rows evenly spread ones are taken
EACH = 4  # rows of data for each chosen term, at least
_DEAD = 1e-9  # a column with less than this standard deviation is constant
_LOST = 1e-12  # so is one with less than this share of its squares in the rows that are left
RAILED = 2  # pairs of delays and degree that are tried with the rails of the sensors too
_NEAR = np.array([[1e-9], [-1e-9]])  # spreads from a rail that rounding makes
_MEDIAN = 0.1  # log of the ratio by which the errors of half of the blocks may be larger


@runtime_checkable
class _Judged(Protocol):
    """What has errors on blocks of unseen rows."""

    @property
    def errors(self) -> Float[np.ndarray, " blocks"]: ...


Judged = TypeVar("Judged", bound=_Judged)
Ask = Callable[[str, int, int], object]  # name of a structure, done, of how many


def narx(
    episodes: Episodes | Source,
    *,
    delays: Sequence[int] | int = DELAYS,
    degrees: Sequence[int] | int = DEGREES,
    terms: int = SIZES[-1],
    rails: ArrayLike | None = None,
    **options: Unpack[ReadOptions],
) -> LinearPredictor | BilinearPredictor:
    """Fit x⁺ = Σ_t c_t v^{a_t}, v = [ζ_k, u_k], ζ_k = [x_k, u_{k−1}, x_{k−1}, …]: a polynomial NARX model of few terms.

    Terms are products of ζ's entries, and inputs times such products, in standard units; so neither units nor origins
    change the model. For each number of delays and each degree, forward orthogonal least squares orders the terms. The
    record is cut into four stretches. Without each of them the terms are chosen and fitted; on it the model is judged
    by short forecasts and by its free run, from the record's first rows and the inputs alone. The least error
    decides on delays, degree and number of terms, and of all within one standard error the fewest terms are taken. A
    model whose free run leaves three times the range of the data is taken only where every model's does, and one
    without an input only where the data have none. All rows then fit the coefficients.

    The result predicts with ψ(ζ) = [ζ, 1, the monomials in these terms], lifted afresh at each step: it is a
    `BilinearPredictor`, which `step_map`, `score(relift=True)` and `BilinearMPC` use so. Terms of degree 1 alone make
    an ARX model, a `LinearPredictor`, of which both uses are the same.

    Parameters
    ----------
    episodes
        Records of one plant, long ones: outputs as states. Of more than 12,000 rows the terms are chosen on evenly
        spread stretches.
    delays, degrees
        Numbers of past rows and total degrees to try. Structures of more than 2,600 terms are left out.
    terms
        Terms of a state's polynomial, at most.
    rails
        (2, nx) or (2,), the least and the largest reading of the sensors, ±inf for none. Forecasts then end there, and
        a reading at a rail is no target. For the two best numbers of delays and degrees, rows with such readings in
        their past are kept in one model, and left out of another; the error on unseen rows decides between both and
        the model without rails. Models without delays have no rails.
    **options
        ``weights``, ``workers``, ``scheduler`` and ``progress`` of the last fit, as in `km.moments.second_moments`.

    Raises
    ------
    DataError
        The records are too short for the delays, or hold measured disturbances; no structure is small enough; rails
        are not in order; with them, weights are no function of an episode.

    References
    ----------
    Chen, Billings & Luo, "Orthogonal least squares methods and their application to non-linear system
    identification", Int. J. Control 50, 1989; one standard error: Breiman et al., "Classification and Regression
    Trees", 1984.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> u, y = np.random.default_rng(0).uniform(-1, 1, 400), np.zeros(401)
    >>> for k in range(1, 400):
    ...     y[k + 1] = 0.6 * y[k] - 0.2 * y[k - 1] ** 2 + 0.5 * u[k] * y[k] + u[k - 1]
    >>> data = km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 0.1, ["y"], ["u"])
    >>> model = km.identify.narx(data, delays=[1, 2], degrees=2)
    >>> float(abs(model.step_map().rollout(model.embed(data)[0].X[0], u[1:, None])[:, 0] - y[1:]).max()) < 1e-6
    True
    """
    source = source_of(episodes)
    whole = source_episodes(source)
    limits = None if rails is None else check_rails(rails, whole.nx)
    found = search_structures(whole, check_list(delays, 0), check_list(degrees, 1), terms, rails=limits)
    return fit_structure(choose_structure(found), source, **options)


def source_episodes(source: Source) -> Episodes:
    """Return the episodes of a source that can be read again."""
    if not source.replayable:
        raise DataError("a stream is read once, and narx reads its data twice; pass Episodes, or km.data.Files(folder)")
    loaded = [part.load() for part in source.parts()]
    return episodes_of(loaded[0].with_episodes([episode for part in loaded for episode in part]))


def check_list(values: Sequence[int] | int, least: int) -> list[int]:
    """Return whole numbers, each once, in ascending order."""
    checks.kind(values, "a list of sizes", (int, np.integer, tuple, list, range), "pass a whole number, or several")
    given = [values] if isinstance(values, int | np.integer) else list(values)
    found = sorted({checks.count(value, "a size", least) for value in given})
    if not found:
        raise DataError("a list of sizes is empty; pass at least one number")
    return found


def choose_structure(found: Sequence[Structure]) -> Structure:
    """Return the structure of the fewest terms whose error is within one standard error of the least one."""
    return choose_simplest(found, lambda structure: (structure.size, structure.delays, structure.error))


def choose_simplest(found: Sequence[Judged], size: Callable[[Judged], tuple[float, ...]]) -> Judged:
    """Return the one of least size whose error is within one standard error of the least one."""
    least = min(found, key=lambda judged: average_errors(judged.errors)).errors
    return min((judged for judged in found if not is_worse(judged.errors, least)), key=size)


def is_worse(errors: Float[np.ndarray, " blocks"], than: Float[np.ndarray, " blocks"]) -> bool:
    """Return whether the errors are larger by more than one standard error of their mean log ratio over the blocks.

    They are larger too if their median ratio is above 1.1: one block that is lost makes the standard error large.
    """
    gap = np.log(np.maximum(errors, EXACT)) - np.log(np.maximum(than, EXACT))
    return bool(gap.mean() > gap.std(ddof=1) / np.sqrt(len(gap)) or np.median(gap) > _MEDIAN)


def search_structures(
    episodes: Episodes,
    delays: Sequence[int] = DELAYS,
    degrees: Sequence[int] = DEGREES,
    terms: int = SIZES[-1],
    horizon: int | None = None,
    ask: Ask | None = None,
    rails: Float[np.ndarray, "2 nx"] | None = None,
) -> list[Structure]:
    """Return structures of all delays, degrees and sizes with their errors; the calm ones if there are any."""
    if episodes.nw:
        raise DataError("the records hold measured disturbances, which narx does not know; pass them as inputs")
    pieces, horizon = Pieces.of(episodes), horizon or find_forecast_horizon(episodes)
    plans, first = _find_plans(pieces, delays, degrees)
    usable = [i for i, u in enumerate(pieces.U) if len(u) > first + FOLDS]
    pieces = Pieces(tuple(pieces.Y[i] for i in usable), tuple(pieces.U[i] for i in usable), pieces.mean, pieces.scale)
    found: list[Structure] = []
    for i, (d, g) in enumerate(plans):
        if ask is not None:
            ask(f"polynomials of degree {g} with {d} past rows", i, len(plans))
        found += list(_try_plan(pieces, d, g, first, terms, horizon))
    if rails is not None:
        ranked = dict.fromkeys((one.delays, one.degree) for one in sorted(found, key=lambda one: one.error))
        for (d, g), masked in product([pair for pair in ranked if pair[0]][:RAILED], (False, True)):
            with suppress(DataError):  # a stretch has no row without a rail
                found += list(_try_plan(pieces, d, g, first, terms, horizon, rails, masked))
    driven = [structure for structure in found if structure.is_driven] or found  # a controller needs the input
    return [structure for structure in driven if structure.calm] or driven


def _find_plans(pieces: Pieces, delays: Sequence[int], degrees: Sequence[int]) -> tuple[list[tuple[int, int]], int]:
    """Return the pairs of delays and degree that the pieces have room for, and the most delays."""
    nx, nu, longest = pieces.nx, pieces.nu, max(map(len, pieces.U))
    room = [d for d in delays if 4 * FOLDS * (d + 1) <= longest]
    if not room:
        raise DataError(
            f"the longest record has {longest} steps, and {min(delays)} delays need {4 * FOLDS * (min(delays) + 1)}; "
            "pass fewer delays, or a longer record"
        )
    plans = [(d, g) for d in room for g in degrees if nx * count_terms(nx + d * (nx + nu), nu, g) <= MOST]
    if not plans:
        raise DataError(
            f"every structure has more than {MOST} terms of all states together; pass fewer delays, or a lower degree"
        )
    return plans, max(room)


def _try_plan(
    pieces: Pieces,
    delays: int,
    degree: int,
    first: int,
    terms: int,
    horizon: int,
    rails: Float[np.ndarray, "2 nx"] | None = None,
    masked: bool = False,
) -> Iterator[Structure]:
    """Yield the structures of all sizes for these delays and this degree."""
    nx, nu = pieces.nx, pieces.nu
    ends = None if rails is None else (rails - pieces.mean[:nx]) / pieces.scale[:nx]
    candidates = list_terms(nx + delays * (nx + nu), nu, degree)
    spans = [[round(len(u) * i / FOLDS) for i in range(FOLDS + 1)] for u in pieces.U]
    sizes = np.array([size for size in SIZES if size <= min(terms, len(candidates))])
    errors: list[Float[np.ndarray, " s"]] = []
    fits = _Fits(pieces, candidates, delays, ends, masked)
    for fold in range(FOLDS):
        out = [(span[fold], span[fold + 1]) for span in spans]
        models = fits.fit(sizes, out)
        errors += _unseen_errors(models, pieces, [(max(a, first), b) for a, b in out], first, horizon)
    table = np.array(errors)
    models = fits.fit(sizes, [(0, 0)] * len(pieces.U))
    calm = are_calm(models, pieces, first)
    for i, size in enumerate(sizes):
        chosen = tuple(own[:size] for own in models.terms)
        yield Structure(delays, degree, chosen, pieces.mean, pieces.scale, table[:, i], bool(calm[i]), rails, masked)
        if all(len(own) <= size for own in models.terms):
            return


def _unseen_errors(
    models: Models, pieces: Pieces, out: Sequence[tuple[int, int]], first: int, horizon: int
) -> list[Float[np.ndarray, " s"]]:
    """Return the errors of models on both halves of the spans `out`: the geometric mean of two errors.

    One is that of the free run from the first rows of each piece, the other that of forecasts of `horizon` steps, which
    begin at measured rows. The free run of a chaotic or unstable plant says nothing; a short forecast says little of a
    slow one.
    """
    free = run_freely(models, pieces.Y, [u[:b] for u, (_, b) in zip(pieces.U, out, strict=True)], first)
    gaps = [free[a - first : b - first, i] - pieces.Y[i][a + 1 : b + 1, None] for i, (a, b) in enumerate(out)]
    found = [_mean_squares(half) for half in np.array_split(np.concatenate(gaps), 2)]
    starts = [(i, k) for i, (a, b) in enumerate(out) for k in range(a, b - horizon + 1, horizon)]
    if len(starts) < 2:
        return [np.sqrt(square) for square in found]
    d = models.delays
    Y = [pieces.Y[i][k - d : k + 1 + horizon] for i, k in starts]
    short = run_freely(models, Y, [pieces.U[i][k - d : k + horizon] for i, k in starts], d).swapaxes(0, 1)
    truth = np.stack([y[d + 1 :] for y in Y])[:, :, None]
    ahead = [_mean_squares(half) for half in np.array_split(short - truth, 2)]
    return [(one * other) ** 0.25 for one, other in zip(found, ahead, strict=True)]


def _mean_squares(gaps: Float[np.ndarray, "*rows s nx"]) -> Float[np.ndarray, " s"]:
    """Return the mean square of the errors of each model, not below rounding error."""
    return np.maximum(np.mean(gaps.reshape(-1, *gaps.shape[-2:]) ** 2, axis=(0, 2)), EXACT**2)


class _Fits:
    """Nested models of few of these candidates, from pieces without some of their rows.

    Products of all candidates and targets are added up once, and those of the rows that are left out are taken away.
    """

    def __init__(
        self,
        pieces: Pieces,
        candidates: Terms,
        delays: int,
        rails: Float[np.ndarray, "2 nx"] | None = None,
        masked: bool = False,
    ) -> None:
        rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
        for i, (y, u) in enumerate(zip(pieces.Y, pieces.U, strict=True)):
            if len(u) > delays:
                V, T = embed_rows(y, u, delays)
                told = np.ones(len(u), bool) if rails is None else find_told_rows(y, rails + _NEAR, delays, masked)
                at = np.flatnonzero(told[delays:])
                rows.append((V[at], T[at], np.full(len(at), i), at + delays))
        if not sum(len(T) for _, T, _, _ in rows):
            raise DataError(f"no stretch of the records is longer than {delays} delays; pass fewer, or a longer record")
        self._candidates, self._delays, self._rails = candidates, delays, rails
        self._V, self._T, self._piece, self._at = map(np.concatenate, zip(*rows, strict=True))
        self._thin = slice(None, None, max(-(-len(self._V) * len(candidates) // NUMBERS), 1))
        self._table = np.hstack([evaluate_terms(candidates, self._V[self._thin]), self._T[self._thin]])
        self._table -= self._table.mean(axis=0)
        self._products, self._sums = self._table.T @ self._table, self._table.sum(axis=0)

    def fit(self, sizes: Int[np.ndarray, " s"], out: Sequence[tuple[int, int]]) -> Models:
        """Return models of these sizes, from all rows whose past and target are outside of the spans `out`."""
        first, last = np.array(out).T[:, self._piece]
        hidden = (self._at >= first) & (self._at < last + self._delays) & (last > first)
        V, T = self._V[~hidden], self._T[~hidden]
        if not len(T):
            raise DataError("no row is left; pass fewer delays, or a longer record")
        unseen, n = self._table[hidden[self._thin]], len(self._candidates)
        count = len(self._table) - len(unseen)
        sums = self._sums - unseen.sum(axis=0)
        products = self._products - unseen.T @ unseen - np.outer(sums, sums) / max(count, 1)
        floor = np.maximum(_DEAD**2 * count, _LOST * self._products.diagonal()[:n])
        most = max(min(int(sizes[-1]), count // EACH), 1)
        found: list[Terms] = []
        solved: list[Float[np.ndarray, "s n1"]] = []
        for i, target in enumerate(T.T, n):
            own = self._candidates[select_forward(products[:n, :n], products[:n, i], products[i, i], floor, most)]
            found.append(own)
            solved.append(solve_nested(evaluate_terms(own, V), target, sizes))
        return Models(self._delays, tuple(found), tuple(solved), self._rails)
