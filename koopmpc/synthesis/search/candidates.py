"""Candidate: a model to try; the candidates for an unknown plant, and their fits."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Arrays, Value, from_data, to_data
from koopmpc.data.angles import find_angles
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.base import Lifting, Sum, check_lifting, strip_unit
from koopmpc.lifting.composed import Standardized
from koopmpc.lifting.fourier import Fourier, RandomFourier
from koopmpc.lifting.radial import Gaussian, ThinPlate
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.models.fits.bilinear import bilinear_edmd
from koopmpc.models.fits.edmd import Towards, edmd
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.hidden_fit import fit_hidden
from koopmpc.models.records.hidden_structure import HiddenStructure
from koopmpc.models.records.narx import source_episodes
from koopmpc.models.records.structure import Structure, fit_structure
from koopmpc.validate.scoring import AnyPredictor

MOST = 120  # observables of a lifting that is tried unasked
_REGRESSORS = 260  # [ψ(x) u u⊗ψ(x)] of a model that is tried unasked
_EACH = 10  # snapshot pairs for each regressor, at least
_POINTS = 2000  # of the data that distances are taken of
_APART = 1e-3  # centres that agree in multiples of this many spreads coincide; one of them is kept


@dataclass(frozen=True, eq=False)
class Candidate(Value):
    """A model to try: a lifting of the state, or of ζ where there is an embedding, and whether u multiplies ψ(x).

    Attributes
    ----------
    name
        For the leaderboard.
    lifting
        ψ.
    embedding
        The delays, where ψ acts on the state and its past.
    bilinear
        z⁺ = A z + B u + Σ uᵢ Nᵢ z instead of z⁺ = A z + B u.
    structure
        The terms of a sparse polynomial model, whose lifting and embedding these are, or the sizes of one with a hidden
        state; None for other candidates.
    relifted
        The fit is linear, and the model is lifted at each step all the same: a bilinear one with N = 0.
    """

    name: str
    lifting: Lifting
    embedding: Delay | None = None
    bilinear: bool = False
    structure: Structure | HiddenStructure | None = None
    relifted: bool = False

    def __reduce__(self) -> tuple[Any, ...]:  # as data, so that a lifting of the user's own crosses processes too
        arrays: Arrays = {}
        return from_data, (to_data(self, arrays), arrays)

    @property
    def delays(self) -> int:
        """Past steps in ζ."""
        return 0 if self.embedding is None else self.embedding.steps

    @property
    def has_hidden_state(self) -> bool:
        """Whether the model has a state that no past row holds."""
        return isinstance(self.structure, HiddenStructure)

    @property
    def kind(self) -> str:
        """Return "linear" or "bilinear"."""
        return "bilinear" if self.bilinear else "linear"

    @property
    def size(self) -> float:
        """A number that grows with the time that its fit and its loops take."""
        return self.lifting.nz * (2.0 if self.bilinear else 1.0)

    @property
    def towards(self) -> Towards:
        """What the ridge of its fit pulls to: a linear model without delays to the affine one, see `edmd`.

        With delays a state and its past are almost functions of each other, and a ridge is to weigh on them, too.
        """
        return "zero" if self.bilinear or self.embedding is not None else "affine"

    def bind(self, states: Sequence[str], inputs: Sequence[str]) -> "Candidate":
        """Return the sized copy for a plant with these names."""
        sized = None if self.embedding is None else self.embedding.match(states, inputs)
        bound = self.lifting.bind(states if sized is None else sized.names)
        return replace(self, lifting=bound, embedding=sized)


def fit_candidate(candidate: Candidate, data: Episodes | Source, ridge: float, read: ReadOptions) -> AnyPredictor:
    """Return the model of these data; the ridge of a bilinear one pulls it towards z⁺ = z."""
    psi, embedding = candidate.lifting, candidate.embedding
    if candidate.structure is not None:
        if isinstance(candidate.structure, HiddenStructure):
            return fit_hidden(candidate.structure, source_episodes(source_of(data)))
        return fit_structure(candidate.structure, data, **read)
    if candidate.bilinear:
        scheduled = source_of(data).nw > 0
        return bilinear_edmd(
            data, psi, embedding=embedding, ridge=ridge, difference=True, scheduled_inputs=scheduled, **read
        )
    model = edmd(data, psi, embedding=embedding, ridge=ridge, towards=candidate.towards, **read)
    return relift_model(model) if candidate.relifted else model


def relift_model(model: LinearPredictor) -> BilinearPredictor:
    """Return z⁺ = A z + B u as a bilinear model with N = 0, which controllers and forecasts lift at each step."""
    report = model.report
    if report is not None:
        sentence = "N = 0: it forecasts better if it is lifted at each step, as bilinear models are used"
        report = replace(report, changes=(*report.changes, sentence))
    N = np.zeros((model.nu, model.nz, model.nz))
    about = (model.C, model.lifting, model.dt, model.states, model.inputs, report)
    return BilinearPredictor(model.A, model.B, N, *about, embedding=model.embedding, scale=model.scale)


def check_delays(delays: Sequence[int]) -> list[int]:
    """Return the numbers of past steps to try, each once, the least first."""
    checks.kind(delays, "delays", (Sequence, np.ndarray), "pass the numbers of past steps in a list")
    past = sorted({checks.count(d, "delays", 0) for d in delays})
    if not past:
        raise DataError("delays is empty; pass 0 for a model without an embedding")
    return past


def expand_candidates(
    given: Sequence[Candidate | Lifting], episodes: Episodes, delays: Sequence[int], bilinear: bool
) -> list[Candidate]:
    """Return the candidates bound to the data; a plain lifting becomes one for each number of delays and each kind.

    A lifting that can be of the states alone, one with centres for example, is tried only without delays.
    """
    checks.kind(given, "candidates", Sequence, "pass liftings or Candidates in a list")
    found: list[Candidate] = []
    for i, one in enumerate(given):
        if isinstance(one, Candidate):
            found.append(one.bind(episodes.states, episodes.inputs))
            continue
        psi = check_lifting(one)
        parts = psi.parts if isinstance(psi, Sum) else (psi,)
        name = f"{i}: {' + '.join(type(part).__name__ for part in parts)}"
        for d in delays:
            try:
                bound = Candidate(name, one, Delay(d) if d else None).bind(episodes.states, episodes.inputs)
            except ShapeError:
                if d == 0:
                    raise
                continue
            kinds = (False, True) if bilinear else (False,)
            found += [Candidate(name, bound.lifting, bound.embedding, kind) for kind in kinds]
    if not found:
        raise DataError("there is no candidate; pass at least one lifting, and 0 among the delays")
    return found


def list_candidates(
    given: Sequence[Candidate | Lifting] | None,
    episodes: Episodes,
    delays: Sequence[int],
    bilinear: bool,
    rng: np.random.Generator,
) -> list[Candidate]:
    """Return the given candidates, or those for an unknown plant; bilinear ones only where there are inputs."""
    both = bool(bilinear) and episodes.nu > 0
    if given is None:
        return propose_candidates(episodes, delays, both, rng)
    return expand_candidates(given, episodes, delays, both)


def propose_candidates(
    episodes: Episodes, delays: Sequence[int], bilinear: bool, rng: np.random.Generator
) -> list[Candidate]:
    """Return the candidates for an unknown plant: linear, polynomial, trigonometric, radial and random ones.

    A candidate is left out if it has more than 120 observables, more than 260 regressors, or fewer than 10 snapshot
    pairs for each regressor; 2 (nx + nu) regressors are always allowed, and so is [x, 1]. With delays the nonlinear
    observables are those of the present state; the past enters linearly.
    """
    pairs = sum(len(episode) for episode in episodes)
    room = min(_REGRESSORS, max(pairs // _EACH, 2 * (episodes.nx + episodes.nu)))
    X = np.concatenate([episode.X[:-1] for episode in episodes])
    base, present = State() + Constant(), State(list(range(episodes.nx)))
    found: list[Candidate] = []
    for d in delays:
        embedding = Delay(d) if d else None
        families = [("x, 1", base), *_trigonometric(episodes.states, X)]
        families += _scale_liftings(episodes, X, rng) if d == 0 else [("monomials 2", base + present * present)]
        for name, lifting in families:
            one = Candidate(name, lifting, embedding).bind(episodes.states, episodes.inputs)
            nz, nu = one.lifting.nz, episodes.nu
            if nz > MOST or (nz + nu > room and name != "x, 1"):
                continue
            found.append(one)
            if bilinear and nz + nu * nz <= room:
                found.append(Candidate(name, one.lifting, one.embedding, bilinear=True))
    return found


def find_constant_states(episodes: Episodes) -> list[str]:
    """Return the names of the states and inputs that are constant throughout."""
    table = np.concatenate([np.hstack([episode.X[:-1], episode.U]) for episode in episodes])
    names = (*episodes.states, *episodes.inputs)
    return [name for name, low, high in zip(names, table.min(axis=0), table.max(axis=0), strict=True) if low == high]


def _trigonometric(states: Sequence[str], X: Float[np.ndarray, "M nx"]) -> Iterator[tuple[str, Lifting]]:
    """Yield sines and cosines of the angles, alone and times the other states; or else of the states without a unit."""
    found, base = find_angles(states, X), State() + Constant()
    if found:
        which, where = found, ", ".join(strip_unit(states[i]) for i in found)
    else:
        near = np.abs(X).min(axis=0) < 2 * np.pi  # numbers near 95 are hardly angles
        which = [i for i, name in enumerate(states) if "[" not in name and 0.2 < np.ptp(X[:, i]) < 50 and near[i]]
        where = "all"
    if not which:
        return
    rest = [i for i in range(len(states)) if i not in found]
    for k in (1, 2, 3):
        circle = Fourier(k, which)
        yield f"fourier {k} ({where})", base + circle
        if rest and k < 3:
            others = State(rest)
            yield f"fourier {k} ({where}) × state", base + circle + circle * others
            squares = others * others
            yield f"fourier {k} ({where}) × squares", base + circle + squares + circle * (others + squares)


def _scale_liftings(
    episodes: Episodes, X: Float[np.ndarray, "M nx"], rng: np.random.Generator
) -> Iterator[tuple[str, Lifting]]:
    """Yield polynomials, bells, splines and random features of the standardized states."""
    whole = Standardized.of(episodes, State())
    points = (X[rng.choice(len(X), min(len(X), _POINTS), replace=False)] - whole.mean) / whole.scale
    points = np.asarray(np.unique(points, axis=0), dtype=np.float64)
    rng.shuffle(points)
    points = points[np.sort(np.unique(np.round(points / _APART), axis=0, return_index=True)[1])]
    base = State() + Constant()

    def scale(lifting: Lifting) -> Lifting:
        return base + Standardized(lifting, whole.mean, whole.scale)

    for degree in (2, 3, 4, 5):
        if comb(episodes.nx + degree, degree) <= MOST:
            yield f"monomials {degree}", scale(Monomials(degree))
    half = len(points) // 2
    apart = np.sqrt(np.sum((points[:half] - points[half : 2 * half]) ** 2, axis=1))
    width = float(f"{np.median(apart):.2g}") if half else 1.0
    for count in (30, 80):
        centers = points[:count]
        yield f"gaussian {len(centers)}", scale(Gaussian(centers, width))
        yield f"thin plate {len(centers)}", scale(ThinPlate(centers))
    for count in (50, 100):
        yield f"random fourier {count}", scale(RandomFourier(count, width, rng))
