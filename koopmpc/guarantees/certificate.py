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
from koopmpc.base.text import format_markdown_table, to_percent
from koopmpc.base.values import Value
from koopmpc.control.ask.checks import FEEDBACK_FIELDS
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Interval, Limits, require_known
from koopmpc.control.ask.terminal import TerminalFeedback, TerminalSet
from koopmpc.control.kinds import ControllerKind, register_controller
from koopmpc.control.move import Move, alone
from koopmpc.control.program import Program, SavedController, no_export
from koopmpc.control.step.feedback import FeedbackLaw
from koopmpc.guarantees.deviation import DeviationModel, measure_spending
from koopmpc.guarantees.error_bounds import ErrorBound
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
        if self.ball > 0:
            raise CertificateError(
                "Q_N is a certificate with a ball: inside it V does not fall, so it cannot pay for the stage cost; pass"
                " a certificate of an equilibrium with exact measurements"
            )
        deviation, nz = self.deviation, self.deviation.lifting.nz
        worst = measure_spending(deviation, self.P, self.K, self.K_w, cost.resolve(self.states, self.inputs))
        weight = worst / (1 - self.decay) * np.linalg.inv(self.P)
        if len(weight) == nz:
            return (weight + weight.T) / 2
        whole = np.zeros((nz, nz))
        whole[np.ix_(deviation.kept, deviation.kept)] = (weight + weight.T) / 2
        return whole

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
        return _state_theorem(self)

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


_METHODS = {
    "given": "You gave the constants. The proof rests on them.",
    "covering": "They are a proof, given L: the errors of the pairs, and L times the distance to them, bound the error"
    " on every cell of a grid over the box and the inputs. The data did not refute L; they cannot prove it.",
    "lipschitz": "They are a proof, given L: c_x = c_u = L, because the error is 0 at the set point and has"
    " the Lipschitz constant L that you gave. The data did not refute L; they cannot prove it.",
}


def _state_theorem(certificate: Certificate) -> str:
    """Return the page of a certificate as Markdown."""
    c, error = certificate, certificate.error
    goal = (
        "and x tends to the set point"
        if c.ball == 0
        else f"until V ≤ {c.ball:.3g}, and then V stays there: an ultimate bound, not stability"
    )
    parts = [
        "# Certificate",
        "## Theorem",
        f"Let x be a state with V(x) = φᵀP⁻¹φ ≤ 1, φ = ψ(x) − ψ(x_s), and let the assumptions below hold. Then under"
        f" u = κ(x) every later state has V ≤ 1, every state and input keeps the limits, and V falls by the factor"
        f" {c.decay:.6g} or more in each step of {c.dt:g} s, {goal}.",
        "## Assumptions",
        format_markdown_table(("assumption", "why it is believed"), _list_assumptions(c)),
        "## The bound of the error",
        f"‖S^−½ r‖ ≤ c_x ‖D⁻¹φ‖ + c_u ‖v/d‖ + c_0 with c_x = {error.c_x:.4g}, c_u = {error.c_u:.4g},"
        f" c_0 = {error.c_0:.4g}, where r is what the model misses of φ in one step. {_describe_bound(c)}",
        "The box, and the limits of the inputs around u_s:",
        format_markdown_table(
            ("signal", "from", "to"),
            [
                *((n, f"{a:.5g}", f"{b:.5g}") for n, a, b in zip(c.states, c.low, c.high, strict=True)),
                *(
                    (n, f"{s - v:.5g}", f"{s + v:.5g}")
                    for n, s, v in zip(c.inputs, c.deviation.u, c.v_max, strict=True)
                ),
            ],
        ),
        "## What was checked",
        "\n".join(f"- {line}" for line in _list_checks(c)),
        "## What is not claimed",
        "\n".join(f"- {line}" for line in _list_limits(c)),
    ]
    return "\n\n".join(parts) + "\n"


def _list_assumptions(c: Certificate) -> list[tuple[str, str]]:
    error = c.error
    measured = "measured on the data, which include it"
    equilibrium = (
        ("the error is at most c_0 at the set point", "see below" if error.method == "covering" else measured)
        if c.estimated
        else ("(x_s, u_s) is an equilibrium of the plant", "you gave it")
    )
    steep = f"you gave L = {error.lipschitz:.4g}"
    slope = [("the error has the Lipschitz constant L in the box", steep)] if error.lipschitz else []
    noise = (
        ("the whole state is measured exactly", "you said so: noise was not given")
        if not c.noise.any()
        else (f"each measured state errs by {c.noise.tolist()} at most", "you gave it; its effect on ψ was sampled")
    )
    return [
        equilibrium,
        ("the error keeps its bound everywhere in the box", "see below"),
        *slope,
        noise,
        ("the plant is a map x⁺ = f(x, u) that does not change, without disturbances", "not checked"),
        ("the input acts at once and as computed", "not checked"),
    ]


def _describe_bound(c: Certificate) -> str:
    error = c.error
    if error.method in _METHODS:
        return _METHODS[error.method]
    exact = " They are at the level of rounding: the data are exact." if error.c_x <= 1e-8 >= error.c_u else ""
    return (
        f"These are the least constants that hold on {error.pairs} pairs of {error.episodes} episodes.{exact} A"
        f" scenario argument says of them: they hold on all pairs of at least {to_percent(1 - error.share)} of episodes"
        f" that are drawn like these, with the confidence {to_percent(error.confidence)}. That does not prove it for"
        " the rest. The model must not have been fitted to these episodes, and they must be independent."
        " The box, the sizes, the shape of the error and the least values of the constants come from other episodes, a"
        " half of all."
    )


def _list_checks(c: Certificate) -> list[str]:
    error = c.error
    lines = [
        f"The inequality behind the theorem was evaluated after the solver, in plain arithmetic: its least eigenvalue"
        f" is {c.margin:.3g}, above zero.",
        "The region lies inside the box and inside the limits, by the same arithmetic.",
    ]
    if error.held_out:
        lines.append(
            f"Of {error.held_out} pairs that did not make the bound, {error.broken} broke it"
            + (f" ({to_percent(error.broken / error.held_out)})." if error.broken else ".")
        )
    return lines


def _list_limits(c: Certificate) -> list[str]:
    low, high = c.sampled
    lines = ["Nothing outside {V ≤ 1}.", "That the region is the largest one: it is the largest that was found."]
    if (c.low < low - 1e-12).any() or (c.high > high + 1e-12).any():
        lines.append(
            "That the data support it: part of the box was never sampled, and there the bound is your word alone."
        )
    if not c.is_proof:
        lines.append("A proof for the plant: the bound of the error holds with a probability, see above.")
    if c.ball > 0:
        lines.append("That the set point is reached.")
    if not np.all(np.isfinite(c.v_max)):
        lines.append("Anything about limits of inputs that were not given.")
    lines.append("Performance: the feedback was chosen for a large region, and not for a small cost.")
    return lines


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
        require_known(sized, "a CertifiedFeedback", FEEDBACK_FIELDS)
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
