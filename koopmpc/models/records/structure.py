"""The structure of a polynomial model, its terms in standard units, and the predictor with these terms."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Unpack

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.pace import find_pace
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Picked, Standardized
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.models.moments.moments import Moments
from koopmpc.models.moments.read import ReadOptions, Weights, second_moments
from koopmpc.models.moments.solve import BilinearParts, column_norms, scaled_rank, solve
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.forward import Terms, list_terms
from koopmpc.models.shared.regression import FitNotes, Regression, build_bilinear, build_predictor, build_regression

HORIZON = 20  # steps of the short forecasts, at least, which count as much as the free run
LONGEST = 200  # steps of these, at most
_SHARE = 4  # they reach over this share of the rows that the outputs remember
_FORECASTS = 16  # that many of them fit into a record, at least
EXACT = 1e-6  # smaller errors, in spreads, are alike: they are due to rounding
_SOFT = 1e-9  # ridge of the observables' own rows, which are almost dependent


def find_forecast_horizon(episodes: Episodes) -> int:
    """Return the steps of the short forecasts: a quarter of the rows that the outputs remember, from 20 to 200.

    20 steps of a drive at 1 kHz are 20 ms, in which no two models differ.
    """
    room = max(map(len, episodes)) // _FORECASTS
    return max(HORIZON, min(find_pace(episodes) // _SHARE, LONGEST, room))


@dataclass(frozen=True, eq=False)
class Structure(Value):
    """Terms of a polynomial model in standard units, for each state, and its errors on unseen rows."""

    # past rows in ζ, and the total degree that terms may have
    delays: int
    degree: int
    terms: tuple[Terms, ...]  # for each state the indices of its terms' factors in [1, ζ, u], padded with 0
    # (nx + nu,) of [x u]: a variable v stands for (v − mean) / scale
    mean: Float[np.ndarray, " nv"]
    scale: Float[np.ndarray, " nv"]
    # (blocks,) errors in spreads, of free runs and forecasts alike, on blocks of rows that neither the choice of the
    # terms nor their coefficients saw
    errors: Float[np.ndarray, " blocks"]
    # fitted to all rows it stays within three times the range of the data, in free run over each record twice
    calm: bool
    # (2, nx) the least and the largest reading of each sensor; None where none saturates. No row whose target is at a
    # rail is learned from
    rails: Float[np.ndarray, "2 nx"] | None = None
    masked: bool = False  # rows whose past holds a reading at a rail are left out too

    @property
    def size(self) -> int:
        """Number of terms of all states."""
        return sum(map(len, self.terms))

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.mean) - len(self.terms)

    @property
    def point_size(self) -> int:
        """Number of entries of ζ."""
        return len(self.terms) + self.delays * len(self.mean)

    @property
    def delay(self) -> Delay | None:
        """The embedding; None without past rows."""
        return Delay(self.delays, rails=self.rails) if self.delays else None

    @property
    def signals(self) -> Int[np.ndarray, " n"]:
        """For each entry of ζ the place of its signal in [x u]."""
        nx, every = len(self.terms), np.arange(len(self.mean))
        return np.concatenate([every[:nx], np.tile(np.roll(every, self.nu), self.delays)])

    @property
    def is_nonlinear(self) -> bool:
        """Whether a term is a product."""
        return any((np.count_nonzero(own, axis=1) > 1).any() for own in self.terms)

    @property
    def has_products(self) -> bool:
        """Whether a term is an input times entries of ζ."""
        n = self.point_size
        return any((np.count_nonzero(own, axis=1) > 1)[own.max(axis=1) > n].any() for own in self.terms if len(own))

    @property
    def lifting(self) -> Lifting:
        """ψ = [ζ, 1, the monomials of the terms in standard units]."""
        return self._build[0]

    @property
    def places(self) -> dict[tuple[int, ...], int]:
        """The place of each product of entries of ζ among the observables; of no factors that of the Constant."""
        return self._build[1]

    @cached_property
    def _build(self) -> tuple[Lifting, dict[tuple[int, ...], int]]:
        n = self.point_size
        where: dict[tuple[int, ...], int] = {(): n}
        where.update({(v,): v - 1 for v in range(1, n + 1)})
        used = {tuple(int(v) for v in term if 0 < v <= n) for own in self.terms for term in own}
        needed = {factors for factors in used if len(factors) > 1}
        lifting: Lifting = State() + Constant()
        if not needed:
            return lifting, where
        degree = max(map(len, needed))
        every = list(list_terms(n, 0, degree)[n:])  # in the order of Monomials
        which = [i for i, term in enumerate(every) if tuple(int(v) for v in term if v) in needed]
        for place, i in enumerate(which, n + 1):
            where[tuple(int(v) for v in every[i] if v)] = place
        monomials = Picked(Monomials(degree), tuple(which))
        return lifting + Standardized(monomials, self.mean[self.signals], self.scale[self.signals]), where

    @property
    def is_driven(self) -> bool:
        """Whether a term holds an input, of the present row or a past one."""
        n, past = self.point_size, np.flatnonzero(self.signals >= len(self.terms)) + 1
        inputs = {*past.tolist(), *range(n + 1, n + self.nu + 1)}
        return any(int(v) in inputs for own in self.terms for v in own.ravel())

    def describe(self) -> str:
        """Return a sentence on terms, delays and the error in free run."""
        past = f"{self.delays} past row{'s' * (self.delays != 1)}"
        if self.rails is not None:
            past += ", with the sensors' rails, " + (
                "without rows behind them" if self.masked else "none of them a target"
            )
        return (
            f"{self.size} terms of degree {self.degree} at most in {past}, by forward regression; on unseen rows, "
            f"in free run and in forecasts, it errs by {self.error:.3g} spreads"
        )

    @property
    def error(self) -> float:
        """Geometric mean of the errors of the blocks."""
        return average_errors(self.errors)


def average_errors(errors: Float[np.ndarray, " blocks"]) -> float:
    """Return the geometric mean of the errors of some blocks, in spreads."""
    return float(np.exp(np.log(np.maximum(errors, EXACT)).mean()))


def fit_structure(
    structure: Structure, episodes: Episodes | Source, **options: Unpack[ReadOptions]
) -> LinearPredictor | BilinearPredictor:
    """Return the predictor of a structure, its coefficients by least squares over all rows of the data."""
    source = source_of(episodes)
    mixes, delay = structure.has_products, structure.delay
    options["weights"] = weigh_rows(structure, options.get("weights"))
    total = second_moments(source, structure.lifting, bilinear=mixes, embedding=delay, **options)
    return solve_structure(structure, total)


def weigh_rows(structure: Structure, weights: Weights | None = None) -> Weights | None:
    """Return weights of rows: zero where a rail hides the target or, if so asked, some of the past."""
    if structure.rails is None:
        return weights
    if weights is not None and not callable(weights):
        raise DataError("with rails, weights must be a function of an episode; pass one")
    return partial(_weigh_episode, structure, weights)


def _weigh_episode(
    structure: Structure, weights: Callable[[Episode], ArrayLike] | None, episode: Episode
) -> Float[np.ndarray, " T"]:
    """Return the weights of an episode of points ζ."""
    assert structure.rails is not None, "else no row is left out"
    nx, signals = len(structure.terms), structure.signals
    own = np.flatnonzero(signals < nx)
    low, high = structure.rails[:, signals[own]]
    railed = (episode.X[:, own] <= low) | (episode.X[:, own] >= high)
    told = ~railed[1:, :nx].any(axis=1)
    if structure.masked:
        told &= ~railed[:-1].any(axis=1)
    given = np.ones(()) if weights is None else np.asarray(weights(episode), dtype=np.float64)
    return told * given if given.shape in {(), told.shape} else given  # moments refuse another shape


def find_told_rows(
    X: Float[np.ndarray, "T1 nx"], rails: Float[np.ndarray, "2 nx"], delays: int, masked: bool
) -> Bool[np.ndarray, " T"]:
    """Return the rows k whose target x_{k+1} no rail hides; if `masked`, those alone whose past has none either."""
    railed = ((rails[0] >= X) | (rails[1] <= X)).any(axis=1)
    told = ~railed[1:]
    if masked:
        for i in range(delays + 1):
            told[i:] &= ~railed[: len(told) - i]
    return told


def solve_structure(structure: Structure, total: Moments) -> LinearPredictor | BilinearPredictor:
    """Return the predictor of a structure on the moments of its lifting."""
    regression = build_regression(total, "narx")
    n, nx, nu = structure.point_size, len(structure.terms), structure.nu
    nz, rows = total.nz, regression.rows
    K = np.zeros((rows.P.shape[1], nz))
    K[n, n] = 1.0
    if nz > n + 1:  # the monomials' own rows
        plain = np.arange(nz + nu)
        K[: nz + nu, n + 1 :] = solve(rows.keep_regressors(plain), ridge=_SOFT).K[:, n + 1 : nz]
    if structure.delays:  # ζ⁺ = [x⁺, u, ζ without its oldest row]
        kept = n - nx - nu
        K[nz : nz + nu, nx : nx + nu] = np.eye(nu)
        K[:kept, nx + nu : n] = np.eye(kept)
    rank, condition = 0, 1.0
    for i, own in enumerate(structure.terms):
        span = np.zeros((len(K), len(own) + 1))
        span[n, 0] = 1.0
        for column, term in zip(span.T[1:], own, strict=True):
            _write_term(column, tuple(int(v) for v in term if v), structure, total.products, nz)
        regressors = rows.P @ span
        size = column_norms(regressors)
        size = np.where(size > 0, size, 1.0)
        K[:, i] = span @ (np.linalg.lstsq(regressors / size, rows.T[:, i], rcond=None)[0] / size)
        found = scaled_rank(rows, regressors)
        rank, condition = max(rank, found[0]), max(condition, found[1])
    return _build_model(regression, K, structure, total.products, (rank, condition))


def _write_term(
    column: Float[np.ndarray, " n"],
    factors: tuple[int, ...],
    structure: Structure,
    products: Int[np.ndarray, " np"],
    nz: int,
) -> None:
    """Write a term in standard units as a combination of [ψ(ζ), u, u ⊗ ψ(ζ)], which hold ζ and u in their own units."""
    n, nu, nx = structure.point_size, structure.nu, len(structure.terms)
    own = tuple(v for v in factors if v <= n)
    parts = {structure.places[own]: 1.0}
    if len(own) == 1:
        signal = structure.signals[own[0] - 1]
        parts = {own[0] - 1: 1 / structure.scale[signal], n: -structure.mean[signal] / structure.scale[signal]}
    if len(own) == len(factors):
        for place, weight in parts.items():
            column[place] += weight
        return
    i = factors[-1] - n - 1
    mean, scale = structure.mean[nx + i], structure.scale[nx + i]
    for place, weight in parts.items():
        column[place] -= weight * mean / scale
        if place == n:
            column[nz + i] += weight / scale
        else:
            column[nz + nu + i * len(products) + int(np.flatnonzero(products == place)[0])] += weight / scale


def _build_model(
    regression: Regression,
    K: Float[np.ndarray, "n nz"],
    structure: Structure,
    products: Int[np.ndarray, " np"],
    numbers: tuple[int, float],
) -> LinearPredictor | BilinearPredictor:
    """Return the predictor with [A B N]ᵀ = K, and its report."""
    nz, nu = regression.lifting.nz, len(regression.inputs)
    notes = FitNotes(
        rule="least squares on the terms that forward regression took",
        rank=numbers[0],
        condition=numbers[1],
        changes=(structure.describe(),),
    )
    if not structure.is_nonlinear:
        return build_predictor(regression, K, **notes)
    N = np.zeros((nu, nz, nz))
    if len(K) > nz + nu:
        N[:, :, products] = K[nz + nu :].reshape(nu, -1, nz).transpose(0, 2, 1)
    parts = BilinearParts(
        K[:nz].T, K[nz : nz + nu].T, N, np.zeros((nz, 0)), np.zeros((0, nz, nz)), np.zeros((0, nz, nu))
    )
    return build_bilinear(regression, K, parts, **notes)


def check_rails(rails: ArrayLike, ny: int) -> Float[np.ndarray, "2 ny"]:
    """Return the rails, one pair for each output."""
    given = checks.array(rails, "rails", infinite=True)
    if given.shape == (2,):
        given = np.repeat(given[:, None], ny, axis=1)
    found = checks.array(given, "rails", (2, ny), infinite=True)
    if not (found[0] < found[1]).all():
        raise DataError("rails must hold the least and the largest reading of each output, low below high")
    return found
