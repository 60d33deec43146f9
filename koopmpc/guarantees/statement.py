"""What a certificate says in words, and what a refusal does: which assumption is in the way, found by bisection."""

from dataclasses import dataclass, replace

import numpy as np

from koopmpc.base.text import format_markdown_table, to_percent
from koopmpc.guarantees.certificate import Certificate
from koopmpc.guarantees.deviation import DeviationModel, find_stray_mode, is_stabilisable
from koopmpc.guarantees.error_bounds import ErrorBound, ErrorPairs
from koopmpc.guarantees.search import DECAY, Room, find_largest, prove

_METHODS = {
    "given": "You gave the constants. The proof rests on them.",
    "covering": "They are a proof, given L: the errors of the pairs, and L times the distance to them, bound the error"
    " on every cell of a grid over the box and the inputs. The data did not refute L; they cannot prove it.",
    "lipschitz": "They are a proof, given L: c_x = c_u = L, because the error is 0 at the set point and has"
    " the Lipschitz constant L that you gave. The data did not refute L; they cannot prove it.",
}


def state_theorem(certificate: Certificate) -> str:
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


@dataclass(frozen=True)
class Refused:
    """A search without a certificate."""

    # model, room: those of the search
    model: DeviationModel
    room: Room
    bounds: dict[float, ErrorBound]  # the bound of the error on each share of the box that has one
    # decay, noise: as `prove` takes them
    decay: float | None
    noise: float
    pairs: ErrorPairs | None  # those that made the bounds; None where the user gave constants
    few: bool  # whether some smaller share of the box holds too few pairs for a bound

    def is_provable(
        self,
        bound: ErrorBound,
        scale: float,
        *,
        size: float = 1.0,
        noise: float = 1.0,
        wider: float = 1.0,
        decay: float | None = None,
    ) -> bool:
        """Return whether there is a certificate for this bound, with shares of region and noise, and wider inputs."""
        rho = decay or self.decay
        room = self.room.scale_by(scale * size)
        room = replace(room, inputs=wider * room.inputs)
        return prove(self.model, bound, room, scale, decay=rho, noise=noise * self.noise) is not None


def explain_refusal(refused: Refused) -> str:
    """Return which assumption is in the way of a certificate, and what to try."""
    model, decay = refused.model, refused.decay
    if not refused.bounds:
        return (
            "no certificate: the data have too few independent episodes for a bound of the error; collect 30 or more,"
            " best of one step each"
        )
    if not is_stabilisable(model, DECAY):
        return (
            "no certificate: the model itself cannot be stabilised around the set point, whatever its error. Its linear"
            f" part (A, B) has an unstable mode that no input moves, {find_stray_mode(model, DECAY)}; check the inputs"
            " of the model, or leave observables out"
        )
    if decay is not None and not is_stabilisable(model, decay):
        return (
            f"no certificate: V cannot fall to decay={decay:g} of itself in each step, for a mode of the model that no"
            f" input moves falls more slowly, {find_stray_mode(model, decay)}. Pass a decay nearer to 1, or leave it"
            " out"
        )
    scale, bound = min(refused.bounds.items(), key=lambda pair: pair[1].c_x + pair[1].c_u + pair[1].c_0)
    return "no certificate: " + (
        _explain_constants(refused, scale, bound)
        or _explain_error(refused, scale, bound)
        or _explain_model(refused, scale, bound)
    )


def _explain_constants(refused: Refused, scale: float, bound: ErrorBound) -> str:
    """Return that decay, noise or the constant part is in the way, if a part of it alone is not; else nothing."""
    if refused.decay is not None and refused.decay < DECAY:
        fall = 1 - refused.decay
        share = find_largest(lambda f: refused.is_provable(bound, scale, decay=1 - f * fall), (1 - DECAY) / fall, 1.0)
        if share > 0:
            return (
                f"V cannot fall so fast under this error: decay is {refused.decay:g}, and {1 - share * fall:.6g} is"
                " possible. Pass that, leave decay out, or reduce the error"
            )
    if refused.noise > 0:
        share = find_largest(lambda f: refused.is_provable(bound, scale, noise=f), 1e-4, 1.0)
        if share > 0:
            return (
                f"the noise of the measurements is too large: it pushes the loop out of every region inside the box,"
                f" and a certificate exists for {share:.2g} of it. Try a better sensor, or a wider box with wider"
                " limits"
            )
    if bound.c_0 > 0:
        share = find_largest(lambda f: refused.is_provable(replace(bound, c_0=f * bound.c_0), scale), 1e-4, 1.0)
        if share > 0:
            return (
                f"the error at the set point is too large: c_0 = {bound.c_0:.3g} pushes the loop out of every region"
                f" inside the box, and a certificate exists for {share:.2g} of it. Try a set point that the plant can"
                " hold, more data near it for the fit, less noise in the data, or a wider box"
                + (", and denser data for the covering" if bound.method == "covering" else "")
            )
    share = find_largest(lambda f: refused.is_provable(bound, scale, wider=1 / f), 1e-4, 1.0)
    if share > 0:
        return (
            f"the inputs have too little room around the set point, and {1 / share:.3g} times as much is enough. Pass"
            " wider limits, and data with inputs as large"
        )
    return ""


def _explain_error(refused: Refused, scale: float, bound: ErrorBound) -> str:
    """Return that the error is in the way, which part of it, and where it is largest; nothing where it is not."""
    parts = {
        "c_u": find_largest(lambda f: refused.is_provable(replace(bound, c_u=f * bound.c_u), scale), 1e-3, 1.0),
        "c_x": find_largest(lambda f: refused.is_provable(replace(bound, c_x=f * bound.c_x), scale), 1e-3, 1.0),
    }
    name = max(parts, key=lambda part: parts[part])
    share, also = parts[name], ""
    if not share:
        name = "these constants"
        share = find_largest(lambda f: refused.is_provable(bound.scale_by(f), scale), 1e-3, 1.0)
    if not share and refused.noise > 0:
        also = " and no noise"
        share = find_largest(lambda f: refused.is_provable(bound.scale_by(f), scale, noise=0.0), 1e-3, 1.0)
    if not share:
        return ""
    constants = f"c_x = {bound.c_x:.3g}, c_u = {bound.c_u:.3g}" + (f", c_0 = {bound.c_0:.3g}" if bound.c_0 else "")
    advice = {
        "c_u": "products of the inputs with more observables, smaller inputs",
        "c_x": "another dictionary, for example monomials of a higher degree",
    }.get(name, "another dictionary")
    if not refused.model.N.any():
        advice = f"a bilinear model, {advice}"
    if bound.c_0 > 0:
        advice += ", a set point that the plant can hold"
    if refused.few:
        advice += ", more data near the set point, where smaller boxes hold too few pairs"
    return (
        f"the error of the model is too large. It is bounded by {constants} on {scale:.3g} of the box, and a"
        f" certificate exists for {share:.2g} of {name}{also}.{_locate(refused, scale, bound)} Try {advice}, or a"
        " smaller region"
    )


def _locate(refused: Refused, scale: float, bound: ErrorBound) -> str:
    """Return at which state and input the error is nearest to its bound; nothing where no pairs made it."""
    if bound.method == "covering":
        return " They are those of a covering: denser data lower them."
    if refused.pairs is None:
        return " You gave the constants."
    model = refused.model
    pairs = refused.pairs.within(model.x - scale * refused.room.widths, model.x + scale * refused.room.widths)
    size, phi, v = bound.norms(pairs)
    at = int(np.argmax(size / np.maximum(bound.c_x * phi + bound.c_u * v + bound.c_0, 1e-300)))
    names = [*model.lifting.bound_states, *(f"u[{i}]" for i in range(len(model.u)))]
    values = [*pairs.X[at], *pairs.U[at]]
    place = ", ".join(f"{name} = {value:.3g}" for name, value in zip(names, values, strict=True))
    return f" The bound is set at {place}: data for the fit near there may reduce it."


def _explain_model(refused: Refused, scale: float, bound: ErrorBound) -> str:
    """Return that the region is in the way, or else the model."""
    exact = bound.scale_by(0.0)
    size = find_largest(lambda s: refused.is_provable(exact, scale, size=s, noise=0.0), 1e-4, 1.0)
    if size > 0:
        return (
            f"the region is too large. Even a model without error has none on {scale:.3g} of the box, and one on"
            f" {size * scale:.2g} of it. Pass a smaller region=, wider limits of the inputs, or data with larger inputs"
        )
    return (
        "even close to the set point and without an error the program finds none. The lifting holds observables that"
        " are nearly functions of one another; leave some of them out"
    )
