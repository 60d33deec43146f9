"""What a refused certificate says: which assumption is in the way, found by bisection, and what to try."""

from dataclasses import dataclass, replace

import numpy as np

from koopmpc.guarantees.deviation import DeviationModel, find_stray_mode, is_stabilisable
from koopmpc.guarantees.error_bounds import ErrorBound, ErrorPairs
from koopmpc.guarantees.search import DECAY, Room, find_largest, prove


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
