"""`certify`: a feedback with a proof of stability, from a bilinear or linear lifted model and pairs of data."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import CertificateError, DataError, refuse_moved
from koopmpc.control.ask.limits import Limits
from koopmpc.data.episodes import Episodes
from koopmpc.guarantees.certificate import Certificate
from koopmpc.guarantees.deviation import DeviationModel, deviate, is_stabilisable, reduce_to_states
from koopmpc.guarantees.error_bounds import (
    ErrorBound,
    ErrorPairs,
    bound_by_covering,
    bound_by_lipschitz,
    bound_by_scenario,
    shape_of,
    sizes_of,
    split_pairs,
)
from koopmpc.guarantees.refusal import Refused, explain_refusal
from koopmpc.guarantees.search import DECAY, Corners, Found, find_room, prove
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor

_SCALES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.12, 0.06)  # shares of the box that are tried
_LEAST_PAIRS = 30  # a box with fewer pairs is not tried


@dataclass(frozen=True, eq=False)
class CertifyOptions:
    """What is known, and what is seldom asked: `km.certify(…, options=km.guarantees.CertifyOptions(estimated=True))`.

    Attributes
    ----------
    estimated
        Whether the set point is not exactly an equilibrium. Then the error has a constant part c_0, u is found by
        least squares on the model, and what is proved is a ball that is reached.
    region
        (low, high), a box in place of that of the sampled states; inside it but for a bound that is given.
    error
        (c_x, c_u) where they are known: then S, D and d are identities, and the proof rests on them.
    lipschitz
        L with ‖D⁻¹(r − r′)‖ ≤ L (‖(x − x′)/d_x‖ + ‖(u − u′)/d‖) in the box, where it is known; d_x are the sizes D of
        the states. Then c_x = c_u = L. If `estimated`, the constants come from the pairs and L by a covering of the
        box: a proof, given L, of a ball that is smaller the denser the data are.
    noise
        (nx,) or a number: largest error of each measured state. The certificate is then a ball.
    decay
        ρ: V falls by this factor at least in every step. By default it is 0.9999, and searched where c_0 > 0.
    confidence
        Of a scenario bound, which is used without `error` and `lipschitz`.
    rng
        Which half of the episodes sets the box and the sizes, and which of the others make the bound or check it.
    """

    estimated: bool = False
    region: Corners | None = None
    error: tuple[float, float] | None = None
    lipschitz: float | None = None
    noise: ArrayLike | None = None
    decay: float | None = None
    confidence: float = 0.95
    rng: np.random.Generator | int = 0

    def __post_init__(self) -> None:
        checks.kind(self.estimated, "estimated", (bool, np.bool_), "pass True or False")
        if self.error is not None and self.lipschitz is not None:
            raise DataError("error and lipschitz are both given; pass one of them")
        if self.error is not None and self.estimated:
            raise DataError(
                "estimated=True measures the error on data; leave error out, or pass lipschitz in its place"
            )
        if self.error is not None and (checks.array(self.error, "error", (2,)) < 0).any():
            raise DataError(f"error is {self.error}; its constants must be 0 or above")
        if self.lipschitz is not None:
            checks.positive(self.lipschitz, "lipschitz")
        if not checks.positive(self.confidence, "confidence") < 1:
            raise DataError(f"confidence is {self.confidence}; it must be above 0 and below 1")
        if self.noise is not None and (checks.array(self.noise, "noise") < 0).any():
            raise DataError(f"noise is {self.noise}; an error of measurement is 0 or above")
        if self.decay is not None and not checks.positive(self.decay, "decay") < 1:
            raise DataError(f"decay is {self.decay:g}, and V has to fall; pass a number below 1")
        if self.lipschitz is not None and self.estimated and np.any(self.noise):
            raise DataError("a covering needs exact pairs; leave noise out, or leave lipschitz out")

    @property
    def constants(self) -> tuple[float, ...]:
        """The constants of the error that are given: two, one or none."""
        if self.error is not None:
            return float(self.error[0]), float(self.error[1])
        return () if self.lipschitz is None else (float(self.lipschitz),)


def certify(
    model: BilinearPredictor | LinearPredictor,
    data: Episodes,
    limits: Limits | None = None,
    *,
    x: ArrayLike = 0.0,
    u: ArrayLike = 0.0,
    options: CertifyOptions | None = None,
    **moved: Any,
) -> Certificate:
    """Return a feedback u = κ(x) and a region {V ≤ 1} that it keeps, and in which V falls at every step.

    V(x) = φᵀP⁻¹φ with φ = ψ(x) − ψ(x_s). The proof needs a bound of the model's error r on a box of states and inputs:

        ‖S^−½ r‖ ≤ c_x ‖D⁻¹φ‖ + c_u ‖v/d‖ + c_0;    v = u − u_s.

    D and d are sizes, and S is the shape of the error. One semidefinite program gives κ and P; a search over shares of
    the box, and over the ellipsoid in which products v ⊗ φ are bounded, gives the largest region that is found. It is
    inside the limits and inside the sampled box. The inputs stay inside their limits and inside the sampled ones.

    Parameters
    ----------
    model
        A lifted model whose lifting holds the states.
    data
        Episodes that the model was not fitted to, drawn independently. Episodes of one step are best.
    limits
        Limits of inputs, states and of observables of the lifting; limits of changes are refused.
    x, u
        The set point (x_s, u_s). It is an equilibrium of the plant unless the options say that it is estimated.
    options
        What is known of the error, noise, the decay: see `km.guarantees.CertifyOptions`.

    Returns
    -------
    Certificate
        Its `page()` states the theorem and each assumption; `controller()` is the feedback.

    Raises
    ------
    CertificateError
        None was found: which assumption is in the way, and what to try.
    DataError
        The limits exclude the set point, the box does not hold it, decay is not between 0 and 1, noise is below 0, or
        the model is of a kind that has no certificate.

    References
    ----------
    Strässer, Schaller, Worthmann, Berberich, Allgöwer, "SafEDMD", arXiv 2402.03145; "Koopman-based control of nonlinear
    systems with closed-loop guarantees", arXiv 2411.10359.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("slow_manifold").dynamics, dt=0.1)
    >>> draw = dict(excitation=km.Noise(-1, 1), steps=1)
    >>> box = km.Uniform([-1, -1], [1, 1])
    >>> lifting = km.State() + km.Monomials(2, states=[0])
    >>> model = km.bilinear_edmd(km.collect(plant, box, episodes=200, **draw), lifting)
    >>> certificate = km.certify(model, km.collect(plant, box, episodes=300, rng=1, **draw))
    >>> certificate.ball, bool(certificate.value([0.0, 0.0]) == 0.0)
    (0.0, True)
    """
    refuse_moved(moved, CertifyOptions, "km.guarantees.CertifyOptions")
    deviation = deviate(model, x, u)
    asked = CertifyOptions() if options is None else options
    checks.kind(asked, "options", CertifyOptions, "pass km.guarantees.CertifyOptions(…)")
    noise = np.zeros(model.nx) if asked.noise is None else checks.vector(asked.noise, "noise", model.nx)
    seed = int(checks.generator(asked.rng).integers(2**32))
    if asked.estimated:
        deviation = deviate(model, x, _estimate_input(deviation))
    whole, few = _Search(deviation, data, limits, asked, noise, seed), None
    # with more observables than this only the states are tried
    provable = len(deviation.kept) <= 16 and is_stabilisable(deviation, asked.decay or DECAY)
    best = whole.run() if provable else None
    if not asked.constants and len(deviation.kept) > model.nx:
        few = _Search(reduce_to_states(deviation), data, limits, asked, noise, seed)
        other = few.run()
        if other is not None and (best is None or other.size > best.size):
            best, deviation = other, few.model
    if best is None:
        raise CertificateError(explain_refusal((few or whole).describe_failure()))
    # the confidence is that of whichever bound was chosen
    bound = best.bound if asked.constants else replace(best.bound, confidence=float(asked.confidence))
    return Certificate(
        deviation=deviation,
        P=best.P,
        K=best.K,
        K_w=best.K_w,
        decay=best.decay,
        ball=best.ball,
        error=bound,
        low=deviation.x + best.scale * (whole.low - deviation.x),
        high=deviation.x + best.scale * (whole.high - deviation.x),
        v_max=whole.room.inputs,
        margin=best.margin,
        estimated=asked.estimated,
        noise=noise,
        dt=model.dt,
        states=tuple(model.states),
        inputs=tuple(model.inputs),
        sampled=(whole.pairs.X.min(axis=0), whole.pairs.X.max(axis=0)),
        limits=limits,
    )


class _Search:
    """The search over shares of the box, for one set of observables."""

    def __init__(
        self,
        model: DeviationModel,
        data: Episodes,
        limits: Limits | None,
        asked: CertifyOptions,
        noise: Float[np.ndarray, " nx"],
        seed: int,
    ) -> None:
        self.model, self.asked, self.seed = model, asked, seed
        self.pairs = _read_pairs(model, data)
        sampled = len(asked.constants) != 2
        self.sizing = self.pairs
        if not asked.constants:  # a scenario bound takes box, sizes and shape as given: they are of other episodes
            self.sizing, self.bounding = split_pairs(self.pairs, np.random.default_rng(seed), share=0.5)
        self.room, self.low, self.high = find_room(
            model, self.sizing, limits, asked.region, sampled=sampled, scenario=not asked.constants
        )
        inside = self.sizing.within(self.low, self.high)
        if not asked.constants and len(inside.phi) < _LEAST_PAIRS:
            raise DataError(
                f"{len(inside.phi)} pairs of the data lie in the box, {_LEAST_PAIRS} are needed; collect more there"
            )
        self.phi_size, self.v_size = sizes_of(inside.phi), sizes_of(inside.v)
        self.slope = None
        if noise.any():
            self.slope = _noise_in_lifting(model, self.low, self.high, noise, np.random.default_rng(seed))

    def find_bound(self, scale: float) -> ErrorBound | None:
        """Return the bound on this share of the box, None where there are too few pairs."""
        model, asked, given = self.model, self.asked, self.asked.constants
        if len(given) == 2:
            n, m = len(model.kept), len(model.u)
            return ErrorBound("given", given[0], given[1], 0.0, np.eye(n), np.full(n, 1.0), np.full(m, 1.0))
        low, high = model.x + scale * (self.low - model.x), model.x + scale * (self.high - model.x)
        sizing = self.sizing.within(low, high)
        if len(sizing.phi) < _LEAST_PAIRS:
            return None
        if given and asked.estimated:
            return bound_by_covering(
                given[0],
                sizing,
                self.phi_size,
                self.v_size,
                x_size=model.C @ self.phi_size,
                low=np.concatenate([low, model.u - self.room.inputs]),
                high=np.concatenate([high, model.u + self.room.inputs]),
                center=np.concatenate([model.x, model.u]),
            )
        if given:
            return bound_by_lipschitz(given[0], sizing, self.phi_size, self.v_size)
        calibration, held_out = split_pairs(self.bounding.within(low, high), np.random.default_rng(self.seed))
        return bound_by_scenario(
            calibration,
            shape_of(sizing, self.phi_size),
            self.phi_size,
            self.v_size,
            sizing=sizing,
            constant=asked.estimated or self.slope is not None,
            confidence=1 - (1 - asked.confidence) / (2 * len(_SCALES)),  # one of so many bounds is chosen
            held_out=held_out,
        )

    def prove(self, bound: ErrorBound, scale: float) -> Found | None:
        """Return the proof for a bound on this share of the box, None where there is none."""
        eta = self.find_noise(bound)
        return prove(self.model, bound, self.room.scale_by(scale), scale, decay=self.asked.decay, noise=eta)

    def find_noise(self, bound: ErrorBound) -> float:
        """Return the largest ‖D⁻¹(ψ(x + n) − ψ(x))‖ of the measurement."""
        return 0.0 if self.slope is None else float(np.linalg.norm(self.slope / bound.phi_size))

    def describe_failure(self) -> Refused:
        """Return all that the reason of a refusal is sought in."""
        tried = {scale: self.find_bound(scale) for scale in _SCALES}
        bounds = {scale: bound for scale, bound in tried.items() if bound is not None}
        noise = self.find_noise(next(iter(bounds.values()))) if bounds else 0.0
        pairs = None if self.asked.constants else self.bounding
        return Refused(self.model, self.room, bounds, self.asked.decay, noise, pairs, len(bounds) < len(tried))

    def run(self) -> Found | None:
        """Return the proof with the largest region over the shares of the box."""
        best: Found | None = None
        worse = 0
        for scale in _SCALES:
            # stop after this many smaller boxes in sequence gave smaller regions
            bound = self.find_bound(scale) if worse < 2 else None
            found = None if bound is None else self.prove(bound, scale)
            if found is not None and (best is None or found.size > best.size):
                best, worse = found, 0
            elif best is not None:
                worse += 1
        return best


def _estimate_input(model: DeviationModel) -> Float[np.ndarray, " m"]:
    """Return u_s for which the model's own defect at x_s is least."""
    return model.u - np.linalg.lstsq(model.B, model.defect, rcond=None)[0]


def _read_pairs(model: DeviationModel, data: Episodes) -> ErrorPairs:
    """Return all pairs of the data as deviations, with the model's errors."""
    checks.kind(data, "data", Episodes, "collect some that the model was not fitted to")
    nx, nu = len(model.x), len(model.u)
    if data.episodes and (data.episodes[0].X.shape[1] != nx or data.episodes[0].U.shape[1] != nu):
        raise DataError(
            f"the data have {data.episodes[0].X.shape[1]} states and {data.episodes[0].U.shape[1]} inputs, the model"
            f" {nx} and {nu}; pass data of the same plant"
        )
    X = np.vstack([episode.X[:-1] for episode in data.episodes])
    X_next = np.vstack([episode.X[1:] for episode in data.episodes])
    U = np.vstack([episode.U for episode in data.episodes])
    names = np.repeat(np.arange(len(data.episodes), dtype=np.float64), [len(episode.U) for episode in data.episodes])
    phi, v = model.lift(X), U - model.u
    return ErrorPairs(phi, v, model.lift(X_next) - model.advance(phi, v), X, U, names)


def _noise_in_lifting(
    model: DeviationModel,
    low: Float[np.ndarray, " nx"],
    high: Float[np.ndarray, " nx"],
    noise: Float[np.ndarray, " nx"],
    rng: np.random.Generator,
) -> Float[np.ndarray, " n"]:
    """Return the largest |ψ(x + n) − ψ(x)| of each observable that was seen for |n| ≤ noise in the box."""
    X = rng.uniform(low, high, (4000, len(low)))  # states at which the slope of the lifting is measured for noise
    moved = X + noise * rng.choice([-1.0, 1.0], X.shape)
    return 1.1 * np.abs(model.lift(moved) - model.lift(X)).max(axis=0)
