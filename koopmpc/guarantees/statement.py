"""What a certificate says, in words: the theorem, each assumption, what was checked, what is not claimed."""

import numpy as np

from koopmpc.guarantees.certificate import Certificate
from koopmpc.text import format_markdown_table, to_percent

_METHODS = {
    "given": "You gave the constants. The proof rests on them.",
    "lipschitz": "c_x = c_u = L, because the error is 0 at the set point and has the Lipschitz constant L that you"
    " gave. The data did not refute L; they cannot prove it.",
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
    equilibrium = (
        ("the error is at most c_0 at the set point", "measured on the data, which include it")
        if c.estimated
        else ("(x_s, u_s) is an equilibrium of the plant", "you gave it")
    )
    noise = (
        ("the whole state is measured exactly", "you said so: noise was not given")
        if not c.noise.any()
        else (f"each measured state errs by {c.noise.tolist()} at most", "you gave it; its effect on ψ was sampled")
    )
    return [
        equilibrium,
        ("the error keeps its bound everywhere in the box", "see below"),
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
