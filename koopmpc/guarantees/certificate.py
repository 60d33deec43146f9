"""A certificate: V, the feedback that lets it fall, where, and under which assumptions; its controller and its page."""

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import CertificateError, DataError
from koopmpc.base.text import format_markdown_table
from koopmpc.base.values import Value
from koopmpc.control.ask.checks import refuse_levels
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Interval, Limits
from koopmpc.control.ask.terminal import TerminalFeedback, TerminalSet
from koopmpc.control.kinds import ControllerKind, register_controller
from koopmpc.control.lqr import FeedbackLaw
from koopmpc.control.move import Move, alone
from koopmpc.control.program import Program, SavedController, no_export
from koopmpc.guarantees.deviation import DeviationModel
from koopmpc.guarantees.error_bounds import ErrorBound
from koopmpc.lifting.base import find_observables
from koopmpc.models.base import load_value, save_value
from koopmpc.plants.step_map import StepMap


@dataclass(frozen=True, eq=False)
class Certificate(Value):
    """A feedback κ and a function V with V(x⁺) ≤ ρ V(x) on {V ≤ 1}, if the error of the model keeps its bound there.

    Attributes
    ----------
    deviation
        The model around the set point, φ⁺ = A φ + B v + N (v ⊗ φ).
    P
        (n, n); V = φᵀP⁻¹φ.
    K, K_w
        (nu, n), (nu, nu n); v = (I − K_w (I ⊗ φ))⁻¹ K φ.
    decay
        ρ.
    ball
        Level of V that is reached, and not left; 0 where it is the set point itself.
    error
        The bound of the model's error.
    low, high
        (nx,) the box in which the region lies, and on which the bound has to hold.
    v_max
        (nu,) |v| is below these limits in the region.
    margin
        Least eigenvalue of the checked inequality, in the coordinates of `FeedbackProof`.
    estimated
        Whether the set point need not be an equilibrium.
    noise
        (nx,) largest error of the measured states; zeros where they are exact.
    dt, states, inputs
        Those of the model.
    sampled
        Lower and upper corner of the states in the data.
    limits
        The limits that the user gave.
    """

    deviation: DeviationModel
    P: Float[np.ndarray, "n n"]
    K: Float[np.ndarray, "nu n"]
    K_w: Float[np.ndarray, "nu nun"]
    decay: float
    ball: float
    error: ErrorBound
    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]
    v_max: Float[np.ndarray, " nu"]
    margin: float
    estimated: bool
    noise: Float[np.ndarray, " nx"]
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    sampled: tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nx"]]
    limits: Limits | None = None

    @property
    def is_proof(self) -> bool:
        """Whether the bound of the error is an assumption that was given, and not an estimate from samples."""
        return self.error.method != "scenario"

    def value(self, X: ArrayLike) -> Float[np.ndarray, "..."]:
        """Return V of a state (nx,) or of rows of states (M, nx)."""
        phi = self.deviation.lift(X)
        return np.asarray(np.einsum("...i,...i->...", phi, phi @ np.linalg.inv(self.P)))

    def contains(self, X: ArrayLike) -> np.ndarray:
        """Return where V ≤ 1, for a state or rows of states."""
        return np.asarray(self.value(X) <= 1.0)

    def feedback(self, X: ArrayLike) -> Float[np.ndarray, "... nu"]:
        """Return u = u_s + v of a state (nx,) or of rows of states (M, nx)."""
        phi = self.deviation.lift(X)
        n, m = phi.shape[-1], len(self.K)
        gain = np.einsum("jik,...k->...ji", self.K_w.reshape(m, m, n), phi)
        right: Float[np.ndarray, "... nu"] = phi @ self.K.T
        v = np.asarray(np.linalg.solve(np.eye(m) - gain, right[..., None]), dtype=np.float64)
        return self.deviation.u + v[..., 0]

    def sample(self, count: int, rng: np.random.Generator | int = 0) -> Float[np.ndarray, "count nx"]:
        """Return states drawn uniformly from the region {V ≤ 1}, by rejection from an ellipsoid that holds it.

        Raises
        ------
        CertificateError
            The region is too thin a part of the ellipsoid.
        """
        source, nx = checks.generator(rng), len(self.low)
        C = self.deviation.C
        factor = np.linalg.cholesky(C @ self.P @ C.T)  # V ≤ 1 lies in (x − x_s)ᵀ(C P Cᵀ)⁻¹(x − x_s) ≤ 1
        kept: list[Float[np.ndarray, "M nx"]] = []
        for _ in range(2000):
            ball = source.normal(size=(max(count, 1000), nx))
            ball *= (source.uniform(size=(len(ball), 1)) ** (1 / nx)) / np.linalg.norm(ball, axis=1, keepdims=True)
            X = self.deviation.x + ball @ factor.T
            kept.append(X[self.contains(X)])
            if sum(map(len, kept)) >= count:
                return np.vstack(kept)[:count]
        raise CertificateError("the region is too thin to draw states from; ask for fewer")

    def check(self, plant: StepMap, count: int = 10_000, rng: np.random.Generator | int = 0) -> float:
        """Return the share of states drawn from the region whose next V on a plant of known equations is above ρ V.

        Where the certificate has a ball, V may also end inside it.
        """
        X = self.sample(count, rng)
        U = self.feedback(X)
        X_next = np.array([plant(x, u) for x, u in zip(X, U, strict=True)])
        fallen = self.value(X_next) <= np.maximum(self.decay * self.value(X) * (1 + 1e-9), self.ball)
        if self.ball > 0:  # √V falls to √ρ √V + δ
            delta = np.sqrt(self.ball) * (1 - np.sqrt(self.decay))
            fallen |= np.sqrt(self.value(X_next)) <= np.sqrt(self.decay * self.value(X)) + delta + 1e-9
        return float(1 - fallen.mean())

    def terminal_set(self) -> TerminalSet:
        """Return {V ≤ 1} with its feedback, as `Limits(terminal=…)` takes it."""
        deviation = self.deviation
        kept, feedback = tuple(int(i) for i in deviation.kept), TerminalFeedback(deviation.u, self.K, self.K_w)
        return TerminalSet(deviation.z, of=deviation.lifting, W=np.linalg.inv(self.P), kept=kept, feedback=feedback)

    def weigh_end(self, cost: Cost) -> Float[np.ndarray, "n n"]:
        """Return s P⁻¹ for which s V falls by at least the stage cost in every step, as `Cost(Q_N=…)` takes it.

        In a step V falls by (1 − ρ) V, and ℓ ≤ λ V in the region, so s = λ / (1 − ρ). With v = (I − G)⁻¹K φ and
        ‖G‖ ≤ γ < 1 in the region, λ is the largest eigenvalue of SᵀQ S + KᵀK ‖R‖ / (1 − γ)² in the coordinates P^½;
        for a feedback without products it is that of SᵀQ S + KᵀR K. A certificate with a smaller `decay` asks for a
        smaller s. Weights of observables count from (nz, nz) on, those of states alone are (nx, nx).

        Raises
        ------
        CertificateError
            The certificate has a ball, so V does not fall everywhere; or the bound γ is not below 1.
        ObservableError
            The cost tracks an observable that the certificate does not hold.
        DataError
            The cost weighs changes of the inputs, which V does not know.
        """
        return weigh_decrease(self, cost)

    def controller(self, limits: Limits | None = None) -> "CertifiedFeedback":
        """Return the feedback as a controller; `limits` in place of those of the certificate."""
        return CertifiedFeedback(self, limits)

    def save(self, path: str | Path) -> None:
        """Write the certificate as data (.npz); `load_certificate` reads it.

        Raises
        ------
        LogError
            The path cannot be written.
        """
        save_value(self, path)

    def page(self) -> str:
        """Return the theorem, each assumption, what was checked, and what is not claimed, as Markdown."""
        from koopmpc.guarantees.statement import state_theorem

        return state_theorem(self)

    def __str__(self) -> str:
        """Return the certificate in a sentence."""
        goal = "the set point" if self.ball == 0 else f"the ball V ≤ {self.ball:.3g}"
        rows = [
            (name, f"{low:.4g} … {high:.4g}") for name, low, high in zip(self.states, self.low, self.high, strict=True)
        ]
        said = f"from every state with V ≤ 1 the loop reaches {goal}, if the error keeps its bound in the box"
        return f"{said}\n\n{format_markdown_table(('state', 'box'), rows)}"


def load_certificate(path: str | Path) -> Certificate:
    """Read a Certificate that its `save` wrote; this runs no code of the file.

    Raises
    ------
    LogError
        The file is missing, damaged, or does not hold a certificate.
    """
    return load_value(path, Certificate)


def weigh_decrease(certificate: Certificate, cost: Cost) -> Float[np.ndarray, "n n"]:
    """Return the weight of `Certificate.weigh_end`."""
    c, deviation = certificate, certificate.deviation
    if c.ball > 0:
        raise CertificateError(
            "Q_N is a certificate with a ball: inside it V does not fall, so it cannot pay for the stage cost; pass a"
            " certificate of an equilibrium with exact measurements"
        )
    cost = cost.resolve(c.states, c.inputs)
    of = cost.of.bind(c.states)
    (Q, R), n, nu = cost.matrices(of.nz, len(c.inputs)), len(c.P), len(c.inputs)
    if cost.rate(nu) is not None:
        raise DataError("Q_N is a certificate, and the cost has R_delta, which V does not know; leave R_delta out")
    place = {int(kept): i for i, kept in enumerate(deviation.kept)}
    S = np.zeros((of.nz, n))
    for row, index in enumerate(find_observables(deviation.lifting, of)):
        if int(index) in place:
            S[row, place[int(index)]] = 1.0
    root = np.linalg.cholesky(c.P)
    if np.abs(c.K_w).max(initial=0.0) > 0:
        # G = Σ_k (K_w)_k φ_k in the region: ‖G‖² ≤ Σ over the entries in the coordinates P^½
        parts = c.K_w.reshape(nu, nu, n) @ root
        gamma = float(np.linalg.norm(parts.reshape(nu * nu, n), 2)) if nu == 1 else float(np.linalg.norm(parts))
        if gamma >= 1:
            raise CertificateError(
                "the feedback of the certificate is a quotient whose input cannot be bounded in its region; certify a"
                " smaller region, or leave Q_N out"
            )
        spent = c.K.T @ c.K * float(np.linalg.norm(R, 2)) / (1 - gamma) ** 2
    else:
        spent = c.K.T @ R @ c.K
    worst = float(np.linalg.eigvalsh(root.T @ (S.T @ Q @ S + spent) @ root)[-1])
    weight = worst / (1 - c.decay) * np.linalg.inv(c.P)
    if n == deviation.lifting.nz:
        return (weight + weight.T) / 2
    whole = np.zeros((deviation.lifting.nz, deviation.lifting.nz))
    whole[np.ix_(deviation.kept, deviation.kept)] = (weight + weight.T) / 2
    return whole


class CertifiedFeedback(FeedbackLaw):
    """u = u_s + (I − K_w (I ⊗ φ))⁻¹ K φ of a certificate, clipped to limits outside the region.

    Inside {V ≤ 1} nothing is clipped. Outside nothing is promised. The reference has to be the set point.

    Parameters
    ----------
    certificate
        Of `km.certify`.
    limits
        Input and rate limits; by default those of the certificate.
    """

    def __init__(self, certificate: Certificate, limits: Limits | None = None) -> None:
        checks.kind(certificate, "certificate", Certificate, "make one with km.certify")
        self.certificate, self.limits = certificate, limits
        sized = limits or certificate.limits or Limits()
        refuse_levels(sized, "a CertifiedFeedback")
        nu = len(certificate.inputs)
        box: Interval = sized.inputs(nu)
        super().__init__(certificate.dt, len(certificate.states), box, sized.rates(nu))

    def as_data(self) -> SavedController:
        """Return what the controller was made of."""
        return SavedController("CertifiedFeedback", None, limits=self.limits, options={"certificate": self.certificate})

    @classmethod
    def from_data(cls, saved: SavedController) -> "CertifiedFeedback":
        """Return the controller that is made of these data."""
        return cls(saved.options["certificate"], saved.limits)

    def build_program(self, reference: ArrayLike | None) -> Program:
        """Raise the DataError that says why no C code can be generated."""
        raise no_export(self, "its feedback is a quotient of observables, which koopmpc does not write in C")

    @alone
    def __call__(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None, w: ArrayLike | None = None
    ) -> Move:
        """Return u for state y; the first row of the reference has to be the set point, and `w` is not seen.

        Raises
        ------
        DataError
            The reference is not the set point.
        """
        start = perf_counter()
        x = checks.array(y, "y", (len(self.certificate.states),), finite=False)
        row = checks.reference_rows(checks.numbers(reference, "reference"), 0, len(x))[0]
        target = self.certificate.deviation.x
        if np.abs(row - target).max() > 1e-9 * (1 + np.abs(target).max()):
            raise DataError(
                f"the reference is {row.tolist()}, and the certificate is for the set point {target.tolist()}; certify"
                " another one"
            )
        self.take_applied(applied)
        good = bool((np.abs(x) < HUGE).all())
        return self.limit_input(self.certificate.feedback(x) if good else None, start)


register_controller(ControllerKind(CertifiedFeedback))
