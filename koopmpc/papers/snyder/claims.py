"""The claims of Snyder & Song (2021), each with a verdict that the measured numbers give."""

from collections.abc import Iterable, Mapping

import numpy as np

from koopmpc.papers.registry import Claim, judged, percent
from koopmpc.papers.snyder.reconstruction import Prediction, Reconstruction
from koopmpc.papers.snyder.settings import FIGURES, Shown

Fits = Mapping[str, Mapping[tuple[str, bool], Reconstruction]]  # by setting, then by method and whether at full rank

SMALL = 0.05  # relative error up to which a reader takes two curves for one
SAME = 1.25  # errors within this factor are no change in a picture
MARGINAL = 3.0  # a gain below this factor is marginal
BETTER = 10.0  # a gain above this factor is plain
PLAIN = 1e-3  # costs that differ by less, relative, are alike
GOOD = 1.1  # a controller works where its cost is below this factor of the best
GENERAL = 0.05  # relative error on trajectories that were not fitted, up to which a model generalises


def of_figure(shown: Shown, setting: str, says: str, fits: Fits) -> Claim:
    """Return the claim of one picture of the paper."""
    own, base = fits[setting][shown.method, True], fits[setting]["DMD", True]
    cut = fits[setting].get((shown.method, False), own)
    gain, cut_gain = base.error / own.error, base.error / cut.error
    where = f"{shown.name}, {setting}"
    errors = f"{percent(own.error)} % against {percent(base.error)} % of DMD"
    if says == "small error":
        return judged(where, says, holds=own.error < SMALL, why=f"{percent(own.error)} %")
    if says == "fails":
        return judged(where, says, holds=own.error > 0.5, why=f"{percent(own.error)} %, where x̂ = 0 would be 100 % off")
    if says == "partly captured":
        moved = _moved(own)
        why = f"{percent(own.error)} % of ‖x‖, which is mostly θ = π; {percent(moved)} % of the motion x − x_ref"
        return judged(where, says, holds=own.error < SMALL < moved, why=why)
    if says == "no change against DMD":
        why = f"{errors}: sin θ is odd, and products of two states are even"
        return judged(where, says, holds=1 / SAME < gain < SAME, why=why)
    if says == "a marginal gain on DMD":
        return judged(where, says, holds=1 < gain < MARGINAL, why=errors)
    if says.startswith("better"):
        return judged(where, says, holds=gain > BETTER, in_part=gain > 1, why=errors)
    if says == "no gain on Fourier 1":
        first = fits[setting]["EDMD Fourier 1", True].error
        factor = first / own.error
        why = f"{percent(own.error)} % against {percent(first)} %: better by a factor of {factor:.2g}"
        why += ", at errors that a picture hardly shows" if first < SMALL else ""
        return judged(where, says, holds=factor < SAME, in_part=factor < MARGINAL, why=why)
    why = f"at rank {cut.rank} {percent(cut.error)} %, at rank {own.rank} {errors}"
    return judged(where, says, holds=gain < SAME, in_part=cut_gain < BETTER, why=why)


def of_figures(fits: Fits) -> list[Claim]:
    """Return the claims of all pictures, in the order of `FIGURES`."""
    return [
        of_figure(shown, setting, says, fits)
        for shown in FIGURES
        for setting, says in zip(shown.settings, shown.says, strict=True)
    ]


def of_text(
    fits: Fits,
    centred: float,
    predictions: Mapping[str, Mapping[str, Prediction]],
    ratios: Mapping[str, Mapping[str, float]],
) -> list[Claim]:
    """Return the claims of abstract, results and discussion, in our words.

    Parameters
    ----------
    fits
        All reconstructions.
    centred
        Relative error of DMD on x − x_ref of the cart-pole under LQR.
    predictions
        Errors on held-out data by plant and model.
    ratios
        Closed-loop costs divided by that of nonlinear MPC, by task and controller.
    """
    cubic, box = fits["pendulum"]["EDMD monomials 3", True], fits["cart-pole"]["EDMD Fourier 1", True]
    shift, cut = (fits["cart-pole-lqr"]["EDMD monomials 2", True], fits["cart-pole-lqr"]["EDMD monomials 2", False])
    raw, small = fits["cart-pole-lqr"]["DMD", True], fits["pendulum"]["EDMD monomials 3", False]
    hanging, upright = fits["pendulum"]["DMD", True], fits["upright"]["DMD", True]
    squares, cubes = (fits["cart-pole"][f"EDMD monomials {degree}", True] for degree in (2, 3))
    led = float(cubic.evolution[cubic.leading])
    box_led = float(box.evolution[box.leading])
    paper = [p["DMD, feedback data"] for p in predictions.values()]
    blind = [p["DMDc, feedback data"] for p in predictions.values()]
    rich = [p["EDMDc, exciting data"] for p in predictions.values()]
    lifted = [min(value for name, value in by.items() if "Fourier" in name) for by in ratios.values()]
    local = [by["LQR, linearisation"] for by in ratios.values()]
    wins = sum(ours < theirs - PLAIN for ours, theirs in zip(lifted, local, strict=True))
    losses = sum(theirs < ours - PLAIN for ours, theirs in zip(lifted, local, strict=True))
    return [
        judged(
            "abstract",
            "DMD and EDMD give a finite-dimensional linear model of a nonlinear system",
            holds=cubic.held_out < GENERAL and box.held_out < GENERAL,
            in_part=cubic.error < SMALL,
            why=f"of the fitted trajectory (pendulum, monomials 3: {percent(cubic.error)} %), not of the "
            f"system: {percent(cubic.held_out)} % from other starts, for the frequency depends on the amplitude",
        ),
        judged(
            "abstract",
            "EDMD finds the leading Koopman eigenfunctions",
            holds=led < SMALL and box_led < SMALL,
            in_part=led < SMALL,
            why=f"pendulum, monomials 3: φ(x_k) = λᵏ φ(x₀) to {percent(led)} % over 10 s; cart-pole, "
            f"Fourier 1: {percent(box_led)} %; on one trajectory φ is known along a curve alone",
        ),
        judged(
            "abstract",
            "linear control acts on the nonlinear system without linearisation at a fixed point",
            holds=max(lifted) < GOOD and wins > losses,
            in_part=max(lifted) < GOOD,
            why=f"it works on models of exciting data, Fourier 1, at {min(lifted):.4f} to {max(lifted):.4f} times the "
            f"cost of nonlinear MPC; LQR on the linearisation takes {min(local):.4f} to {max(local):.4f}: of "
            f"{len(local)} tasks the lifted model does better in {wins} and worse in {losses} by more than 0.1 %",
        ),
        judged(
            "results",
            "the pendulum is inverted",
            holds=upright.error < SMALL,
            why=f"DMD, uncontrolled: {percent(upright.error)} % upright, {percent(hanging.error)} % hanging; "
            "only θ = 0 hanging agrees with what the paper reports",
        ),
        judged(
            "results",
            "data under LQR show a controlled system, and models of them stand for it",
            holds=max(p.excited for p in paper) < GENERAL,
            in_part=max(p.feedback for p in paper) < 3 * GENERAL,
            why="reconstruction, no control model: fitted without B, "
            f"{_listed(p.excited for p in paper)} % off where noise is added to u (pendulum and cart-pole), and with u "
            f"known A and B cannot be told apart: B is {_shares(blind)} times the true one. Models of exciting data "
            f"are {_listed(p.excited for p in rich)} % off, and B is {_shares(rich)} times the true one",
        ),
        judged(
            "discussion",
            "truncation has to be avoided with monomials 3",
            holds=small.error > BETTER * cubic.error,
            why=f"pendulum: {percent(cubic.error)} % at rank {cubic.rank}, {percent(small.error)} % "
            f"at rank {small.rank}",
        ),
        judged(
            "discussion",
            "the cart-pole is beyond these observables",
            holds=shift.error > raw.error / SAME,
            in_part=cut.error > raw.error / SAME or box.error > SMALL,
            why="under LQR it is the origin and the truncation: DMD on x − x_ref is "
            f"{percent(centred)} % of ‖x − x_ref‖ off, DMD on x {percent(raw.error)} % of ‖x‖, monomials 2 at rank "
            f"{shift.rank} {percent(shift.error)} %; uncontrolled, the large swing stays at "
            f"{percent(squares.error)} % with monomials 2 and {percent(box.error)} % with Fourier 1; monomials 3 "
            f"rebuild it to {percent(cubes.error)} %, but from other starts {_outcome(cubes.held_out)}",
        ),
        judged(
            "discussion",
            "control on the lifted model is future work",
            holds=max(lifted) < GOOD,
            why=f"done here, by LQR and by MPC with input limits: Fourier 1 takes {max(lifted):.4f} times the cost of "
            "nonlinear MPC at most; all costs stand below",
        ),
    ]


def _moved(fit: Reconstruction) -> float:
    """Return the error relative to the motion away from the last state."""
    return float(np.linalg.norm(fit.X - fit.truth) / np.linalg.norm(fit.truth - fit.truth[-1]))


def _outcome(error: float) -> str:
    return "the reconstruction diverges" if percent(error) == "diverges" else f"to {percent(error)} %"


def _listed(errors: Iterable[float]) -> str:
    return " and ".join(percent(error) for error in errors)


def _shares(found: list[Prediction]) -> str:
    return " and ".join(f"{p.b:.3f}" for p in found)
