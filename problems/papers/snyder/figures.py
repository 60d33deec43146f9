"""Snyder & Song 2021, reproduced: verdicts on its claims, choices that it leaves open, its figures and their values."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np

import koopmpc as km
from koopmpc import papers

from ..plants import Pendulum, attach_inputs, integrate_trajectories
from . import control, theory
from .settings import (
    FIGURES,
    SHAKINGS,
    TASKS,
    VARIANTS,
    Fits,
    PaperFigure,
    Reconstruction,
    Setting,
    all_settings,
    design_feedbacks,
    measure_hold_change,
    reconstruct_all,
)

percent = papers.percent

SMALL = 0.05  # two curves look equal in a picture up to this relative error
SAME = 1.25  # errors look equal in a picture if they differ by at most this factor
MARGINAL = 3.0  # an error that is smaller by less than this factor is a marginal gain
BETTER = 10.0  # an error that is smaller by more than this factor is a clear gain
PLAIN = 1e-3  # costs are equal if they differ by less than this share
GOOD = 1.1  # a controller works if its cost is below this factor of the best
GENERAL = 0.05  # a model generalises up to this relative error on trajectories that it was not fitted to

OPENING = """\
G. Snyder and Z. Song, *Koopman Operator Theory for Nonlinear Dynamic Modeling using Dynamic Mode
Decomposition*, 2021: DMD and EDMD of a pendulum and a cart-pole, uncontrolled and under LQR. `koopmpc reproduce
snyder` writes this page, its figures, and one Rerun recording of all curves. What the paper says is told in our
words. Of {total} claims {summary}."""

SETTINGS = """\
Masses, lengths, weights, starts, and the kinds of observables are the paper's. The rest it leaves open; we
chose g = 9.81 m/s², one trajectory of 10 s sampled at 0.01 s, reconstruction from its first state with
b = Φ⁺ψ(x₁), unscaled snapshots, truncated SVD. *Full rank* keeps every singular value above 10⁻¹⁰ σ₁; beside it
stands rank n, the number of states. Monomials include the states and the constant; Fourier observables are x,
sin kxᵢ, cos kxᵢ of every state. Where we differ: the pendulum starts at rest from π/4 but hangs at θ = 0, and the
cart-pole, which shifts by 2 m under LQR, starts 0.1 rad off where it is uncontrolled, for the paper's start is an
equilibrium. All numbers are ours; they are compared with what the paper says, not with numbers that it prints."""

FEEDBACK = """\
The feedback is continuous, inside the integration (RK4, eight substeps a sample). With an input that is held
over each sample the errors under LQR that are above 10⁻⁴ % change by {change} % at most."""

MEASURES = """\
*Error* is ‖x̂ − x‖ / ‖x‖ over all samples and states. *Held out* is its median over {others} trajectories of
the same system from other starts. *Leading φ* is ‖φ(x_k) − λᵏ φ(x₀)‖ / ‖φ‖ over the 10 s for the eigenfunction
with the largest share of the first state, and *φ within 5 %* says how many of all stay below 5 %, as a constant
always does. σ₁/σ_r is the condition number of the snapshots at the rank that is kept."""

LAYOUT = """\
Each column is one trajectory: its states over time, the truth beneath the reconstructions, and at the bottom the
error ‖x̂_k − x_k‖ / max ‖x‖ of each sample. A curve that leaves a panel is cut off there; its error is not. The
figures have names, not the numbers of the paper's."""

DMDC = """\
We know no claim of the paper's on these figures. Inputs are held over a sample. Uncontrolled,
DMDc is DMD. Under u = −K x the rows of [X; U] are dependent: the trajectory is rebuilt, and B is not found.
With B known, or with an input that excites, what remains is the error of a linear model of a pendulum at π/4."""

READINGS = """\
The upright pendulum, gravity of 10 m/s², and the cart-pole of the databook that the paper takes its plant from
(damping 1 N s/m, Q = I, R = 10⁻⁴, started 0.1 rad off): with the exact Jacobian, and labelled as legacy with
the Jacobian as printed there, whose sign of ∂v̇/∂θ is wrong. Also what the paper does not show of its own two
plants."""

GAINS = "u = −K (x − x_ref), continuous-time LQR on the exact Jacobian unless it says otherwise."

HEAD = ("data", "observables", "rank", "σ₁/σ_r", "error [%]", "held out [%]", "leading φ [%]", "φ within 5 %")


def reproduce_snyder(page: papers.Page, quick: bool, progress: papers.TellPart) -> list[papers.Claim]:
    """Write the page and return all claims; `quick` shortens long computations."""
    progress("trajectories and their reconstructions")
    others = 3 if quick else 10
    settings = all_settings(others)
    fits = {name: reconstruct_all(setting) for name, setting in settings.items()}
    change = measure_hold_change(settings, fits)
    causes = theory.causes(settings["cart-pole-lqr"])
    progress("models of exciting data")
    exciting = 10 if quick else 40
    predicted = {
        name: control.predict_held_out(settings[f"{name}-lqr"], shaking, exciting) for name, shaking in SHAKINGS.items()
    }
    progress("control on lifted models")
    length = {"steps": 20, "horizon": 8, "episodes": 30} if quick else {"steps": 200, "horizon": 60, "episodes": 100}
    tasks = {title: control.prepare_contest(title, **length) for title in TASKS}
    runs = {title: task.runs() for title, task in tasks.items()}
    progress("figures")
    said = judge_text(fits, causes["DMD on x − x_ref"].error, predicted, control.compute_ratios(runs))
    shown = judge_figures(fits)
    aside = papers.Page(page.folder, page.beside)  # the opening counts its claim, and its text follows later
    warned = theory.add_caution(aside, settings, fits)
    add_opening(page, [*said, *shown, *warned], change, others)
    page.text("## What the paper says in words")
    papers.add_verdicts(page, said)
    tabulate_figures(page, settings, fits, shown)
    pictures(page, settings, fits)
    appendix_dmdc(page, settings["pendulum"], settings["pendulum-lqr"])
    add_variants(page, settings, fits)
    add_feedbacks(page)
    theory.add_frequencies(page, fits)
    theory.add_equations(page, settings["pendulum"], fits)
    page.parts += aside.parts
    theory.add_failure(page, settings["cart-pole-lqr"], causes)
    control.add_inputs(page, predicted, exciting)
    control.add_loops(page, tasks, runs, length["episodes"])
    return [*said, *shown, *warned]


def judge_figure(shown: PaperFigure, setting: str, says: str, fits: Fits) -> papers.Claim:
    """Return the claim of one picture of the paper."""
    own, base = fits[setting][shown.method, True], fits[setting]["DMD", True]
    cut = fits[setting].get((shown.method, False), own)
    gain, cut_gain = base.error / own.error, base.error / cut.error
    where = f"{shown.name}, {setting}"
    errors = f"{percent(own.error)} % against {percent(base.error)} % of DMD"
    if says == "small error":
        return papers.judge_claim(where, says, holds=own.error < SMALL, why=f"{percent(own.error)} %")
    if says == "fails":
        return papers.judge_claim(
            where, says, holds=own.error > 0.5, why=f"{percent(own.error)} %, where x̂ = 0 would be 100 % off"
        )
    if says == "partly captured":
        moved = _motion_error(own)
        why = f"{percent(own.error)} % of ‖x‖, which is mostly θ = π; {percent(moved)} % of the motion x − x_ref"
        return papers.judge_claim(where, says, holds=own.error < SMALL < moved, why=why)
    if says == "no change against DMD":
        why = f"{errors}: sin θ is odd, and products of two states are even"
        return papers.judge_claim(where, says, holds=1 / SAME < gain < SAME, why=why)
    if says == "a marginal gain on DMD":
        return papers.judge_claim(where, says, holds=1 < gain < MARGINAL, why=errors)
    if says.startswith("better"):
        return papers.judge_claim(where, says, holds=gain > BETTER, in_part=gain > 1, why=errors)
    if says == "no gain on Fourier 1":
        first = fits[setting]["EDMD Fourier 1", True].error
        factor = first / own.error
        why = f"{percent(own.error)} % against {percent(first)} %: better by a factor of {factor:.2g}"
        why += ", at errors that a picture hardly shows" if first < SMALL else ""
        return papers.judge_claim(where, says, holds=factor < SAME, in_part=factor < MARGINAL, why=why)
    why = f"at rank {cut.rank} {percent(cut.error)} %, at rank {own.rank} {errors}"
    return papers.judge_claim(where, says, holds=gain < SAME, in_part=cut_gain < BETTER, why=why)


def judge_figures(fits: Fits) -> list[papers.Claim]:
    """Return the claims of all pictures, in the order of `FIGURES`."""
    return [
        judge_figure(shown, setting, says, fits)
        for shown in FIGURES
        for setting, says in zip(shown.settings, shown.says, strict=True)
    ]


def judge_text(
    fits: Fits,
    centred: float,
    predict_held_out: Mapping[str, Mapping[str, control.Prediction]],
    ratios: Mapping[str, Mapping[str, float]],
) -> list[papers.Claim]:
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
    paper = [p["DMD, feedback data"] for p in predict_held_out.values()]
    blind = [p["DMDc, feedback data"] for p in predict_held_out.values()]
    rich = [p["EDMDc, exciting data"] for p in predict_held_out.values()]
    lifted = [min(value for name, value in by.items() if "Fourier" in name) for by in ratios.values()]
    local = [by["LQR, linearisation"] for by in ratios.values()]
    wins = sum(ours < theirs - PLAIN for ours, theirs in zip(lifted, local, strict=True))
    losses = sum(theirs < ours - PLAIN for ours, theirs in zip(lifted, local, strict=True))
    return [
        papers.judge_claim(
            "abstract",
            "DMD and EDMD give a finite-dimensional linear model of a nonlinear system",
            holds=cubic.held_out < GENERAL and box.held_out < GENERAL,
            in_part=cubic.error < SMALL,
            why=f"of the fitted trajectory (pendulum, monomials 3: {percent(cubic.error)} %), not of the "
            f"system: {percent(cubic.held_out)} % from other starts, for the frequency depends on the amplitude",
        ),
        papers.judge_claim(
            "abstract",
            "EDMD finds the leading Koopman eigenfunctions",
            holds=led < SMALL and box_led < SMALL,
            in_part=led < SMALL,
            why=f"pendulum, monomials 3: φ(x_k) = λᵏ φ(x₀) to {percent(led)} % over 10 s; cart-pole, "
            f"Fourier 1: {percent(box_led)} %; on one trajectory φ is known along a curve alone",
        ),
        papers.judge_claim(
            "abstract",
            "linear control acts on the nonlinear system without linearisation at a fixed point",
            holds=max(lifted) < GOOD and wins > losses,
            in_part=max(lifted) < GOOD,
            why=f"it works on models of exciting data, Fourier 1, at {min(lifted):.4f} to {max(lifted):.4f} times the "
            f"cost of nonlinear MPC; LQR on the linearisation takes {min(local):.4f} to {max(local):.4f}: of "
            f"{len(local)} tasks the lifted model does better in {wins} and worse in {losses} by more than 0.1 %",
        ),
        papers.judge_claim(
            "results",
            "the pendulum is inverted",
            holds=upright.error < SMALL,
            why=f"DMD, uncontrolled: {percent(upright.error)} % upright, {percent(hanging.error)} % hanging; "
            "only θ = 0 hanging agrees with what the paper reports",
        ),
        papers.judge_claim(
            "results",
            "data under LQR show a controlled system, and models of them stand for it",
            holds=max(p.excited for p in paper) < GENERAL,
            in_part=max(p.feedback for p in paper) < 3 * GENERAL,
            why="reconstruction, no control model: fitted without B, "
            f"{_join(p.excited for p in paper)} % off where noise is added to u (pendulum and cart-pole), and with u "
            f"known A and B cannot be told apart: B is {_shares(blind)} times the true one. Models of exciting data "
            f"are {_join(p.excited for p in rich)} % off, and B is {_shares(rich)} times the true one",
        ),
        papers.judge_claim(
            "discussion",
            "truncation has to be avoided with monomials 3",
            holds=small.error > BETTER * cubic.error,
            why=f"pendulum: {percent(cubic.error)} % at rank {cubic.rank}, {percent(small.error)} % "
            f"at rank {small.rank}",
        ),
        papers.judge_claim(
            "discussion",
            "the cart-pole is beyond these observables",
            holds=shift.error > raw.error / SAME,
            in_part=cut.error > raw.error / SAME or box.error > SMALL,
            why="under LQR it is the origin and the truncation: DMD on x − x_ref is "
            f"{percent(centred)} % of ‖x − x_ref‖ off, DMD on x {percent(raw.error)} % of ‖x‖, monomials 2 at rank "
            f"{shift.rank} {percent(shift.error)} %; uncontrolled, the large swing stays at "
            f"{percent(squares.error)} % with monomials 2 and {percent(box.error)} % with Fourier 1; monomials 3 "
            f"rebuild it to {percent(cubes.error)} %, but from other starts {_describe_outcome(cubes.held_out)}",
        ),
        papers.judge_claim(
            "discussion",
            "control on the lifted model is future work",
            holds=max(lifted) < GOOD,
            why=f"done here, by LQR and by MPC with input limits: Fourier 1 takes {max(lifted):.4f} times the cost of "
            "nonlinear MPC at most",
        ),
    ]


def _motion_error(fit: Reconstruction) -> float:
    """Return the error relative to the distance from the last state."""
    return float(np.linalg.norm(fit.X - fit.truth) / np.linalg.norm(fit.truth - fit.truth[-1]))


def _describe_outcome(error: float) -> str:
    return "the reconstruction diverges" if percent(error) == "diverges" else f"to {percent(error)} %"


def _join(errors: Iterable[float]) -> str:
    return " and ".join(percent(error) for error in errors)


def _shares(found: list[control.Prediction]) -> str:
    return " and ".join(f"{p.b:.3f}" for p in found)


def add_opening(page: papers.Page, claims: Sequence[papers.Claim], change: float, others: int) -> None:
    """Write the opening of the report: the paper, the choices that it leaves open, and a summary of the verdicts.

    Parameters
    ----------
    page
        The report.
    claims
        All claims of the paper.
    change
        Largest relative change of an error where the feedback is held over a sample.
    others
        Number of held-out trajectories.
    """
    page.text(
        "# Snyder & Song 2021, done again",
        OPENING.format(total=len(claims), summary=papers.summarise_claims(claims)),
        SETTINGS,
        FEEDBACK.format(change=percent(change)),
        MEASURES.format(others=others),
    )


def tabulate_figures(
    page: papers.Page, settings: Mapping[str, Setting], fits: Fits, claims: Sequence[papers.Claim]
) -> None:
    """Add a table with a line for each figure, trajectory and rank: the paper's claim, the verdict and the reason."""
    page.text("## The figures, in numbers")
    rows: list[tuple[object, ...]] = []
    remaining = iter(claims)
    for shown in FIGURES:
        for setting in shown.settings:
            claim = next(remaining)
            for full in (True, False):
                fit = fits[setting].get((shown.method, full))
                if fit is not None:
                    said = (claim.says, f"**{claim.verdict.value}**", claim.why) if full else ("", "", "")
                    rows.append((shown.name, *_make_row(settings[setting], shown.method, fit), *said))
    page.table(("figure", *HEAD, "the paper", "verdict", "why"), rows)


def pictures(page: papers.Page, settings: Mapping[str, Setting], fits: Fits) -> None:
    """Draw the figures of the paper, those of its appendix last."""
    page.text("## The figures", LAYOUT)
    for shown in sorted(FIGURES, key=lambda shown: shown.appendix):
        cases = {
            settings[setting].title: (settings[setting].trajectory[0].X, _select_curves(shown.method, fits[setting]))
            for setting in shown.settings
        }
        first = settings[shown.settings[0]]
        data = " and ".join(settings[setting].title.split(", ")[-1] for setting in shown.settings)
        caption = f"{first.title.split(',')[0]}, {data}: {shown.method}" + (" (appendix)" if shown.appendix else "")
        draw_case(page, shown.name, caption, cases, first)


def draw_case(
    page: papers.Page,
    name: str,
    caption: str,
    cases: Mapping[str, tuple[np.ndarray, Mapping[str, np.ndarray]]],
    setting: Setting,
) -> None:
    """Draw reconstructions with a column for each case, and add a tab with the curves of each case to the recording."""
    states = setting.dynamics.states
    page.picture(name, caption, partial(km.plot.save, km.plot.reconstruction(cases, setting.dt, states)))
    for title, (truth, curves) in cases.items():
        size = float(np.linalg.norm(truth, axis=1).max())
        table = {"truth": np.hstack([truth, np.full((len(truth), 1), np.nan)])}
        for curve, X in curves.items():
            error = np.linalg.norm(X - truth, axis=1, keepdims=True) / size
            table[curve] = np.hstack([X, np.log10(np.maximum(error, 1e-16))])
        page.curve(f"{name}, {title}", setting.dt, (*states, "log10 of the relative error"), table)


def add_variants(page: papers.Page, settings: Mapping[str, Setting], fits: Fits) -> None:
    """Add other readings of the paper: the upright pendulum, g = 10 m/s², the databook's cart-pole."""
    page.text("## Other readings of the paper", READINGS)
    seen = {(setting, shown.method) for shown in FIGURES for setting in shown.settings}
    page.table(
        HEAD,
        [
            _make_row(settings[setting], method, fit)
            for setting in (*VARIANTS, "cart-pole", "cart-pole-lqr")
            for (method, _), fit in fits[setting].items()
            if (setting, method) not in seen
        ],
    )
    chosen = ("DMD", "EDMD monomials 3", "EDMD Fourier 1")
    for name, names, caption in (
        ("upright", ("upright", "upright-lqr"), "Pendulum, upright: at full rank"),
        ("databook", ("databook", "databook-legacy"), "Cart-pole of the databook: at full rank"),
    ):
        cases = {
            settings[setting].title: (
                settings[setting].trajectory[0].X,
                {method: fits[setting][method, True].X for method in chosen},
            )
            for setting in names
        }
        draw_case(page, f"variant-{name}", caption, cases, settings[names[0]])


def add_feedbacks(page: papers.Page) -> None:
    """Add the gains of all feedbacks."""
    page.text("## The feedbacks", GAINS)
    titles = {
        "pendulum": "pendulum, hanging, Q = diag(0, 10), R = 1: pure damping",
        "upright": "pendulum, upright",
        "cart-pole": "cart-pole, Q = diag(5, 10, 0, 0), R = 1",
        "cart-pole-g10": "cart-pole, g = 10",
        "databook": "databook's cart-pole, Q = I, R = 10⁻⁴",
        "databook-legacy": "databook's cart-pole, Jacobian as printed (legacy)",
    }
    page.table(
        ("plant and weights", "K"),
        [(titles[name], ", ".join(f"{k + 0.0:.4f}" for k in K.ravel())) for name, K in design_feedbacks().items()],
    )


def appendix_dmdc(page: papers.Page, free: Setting, driven: Setting) -> None:
    """Add DMDc of the pendulum, with the input of the feedback and with an exciting input."""
    K = design_feedbacks()["pendulum"]
    plant = km.discretize(Pendulum(), driven.dt, km.RK4(8))
    held = integrate_trajectories(driven.dynamics, driven.x0, dt=driven.dt, steps=driven.steps, K=K, held=True)
    fed = attach_inputs(held, plant.inputs, K)
    rich = km.collect(plant, driven.x0, km.Noise(-1.0, 1.0, hold=20), episodes=1, steps=driven.steps)
    other = km.collect(plant, driven.x0, km.Noise(-1.0, 1.0, hold=20), episodes=1, steps=driven.steps, rng=1)
    B = plant.linearize([0.0, 0.0], [0.0]).B
    page.text("### Appendix: DMDc of the pendulum", DMDC)
    with km.errors.hide_fit_warnings():
        models = {
            "DMD, uncontrolled": (km.dmd(free.trajectory), free.trajectory),
            "DMDc, LQR data": (km.dmdc(fed), fed),
            "DMDc, LQR data, B known": (km.dmdc(fed, B=B), fed),
            "DMDc, exciting input": (km.dmdc(rich), rich),
        }
    rows: list[tuple[object, ...]] = []
    curves: dict[str, np.ndarray] = {}
    for name, (model, data) in models.items():
        episode, report = data[0], model.report
        assert report is not None
        curves[name] = model.rollout(episode.X[0], episode.U[:, : model.nu])
        elsewhere = model.rollout(other[0].X[0], other[0].U) if model.nu else None
        rows.append(
            (
                name,
                f"{report.rank} of {report.columns}",
                percent(papers.relative_error(curves[name], episode.X)),
                "–" if elsewhere is None else percent(papers.relative_error(elsewhere, other[0].X)),
                "–" if not model.nu else f"{float(model.B[1, 0] / B[1, 0]):.4g}",
            )
        )
    page.table(("model and data", "rank of [X; U]", "error [%]", "under another input [%]", "B, of the true one"), rows)
    cases = {
        "LQR data": (held[0].X, {n: curves[n] for n in ("DMDc, LQR data", "DMDc, LQR data, B known")}),
        "Exciting input": (rich[0].X, {"DMDc, exciting input": curves["DMDc, exciting input"]}),
    }
    draw_case(page, "appendix-pendulum-dmdc", "Pendulum: DMDc (appendix)", cases, driven)


def _make_row(setting: Setting, method: str, fit: Reconstruction) -> tuple[object, ...]:
    return (
        setting.title,
        method,
        f"{fit.rank} of {fit.width}",
        f"{fit.condition:.1e}",
        percent(fit.error),
        percent(fit.held_out),
        percent(float(fit.evolution[fit.leading])),
        f"{fit.linear} of {fit.rank}",
    )


def _select_curves(method: str, found: Mapping[tuple[str, bool], Reconstruction]) -> dict[str, np.ndarray]:
    """Return the reconstructions of one method, named after their rank."""
    fits = [found[method, full] for full in (True, False) if (method, full) in found]
    return {"full rank" if i == 0 else f"rank {fit.rank}": fit.X for i, fit in enumerate(fits)}


paper = papers.Paper("snyder", "Snyder & Song 2021, DMD and EDMD of pendulum and cart-pole", reproduce_snyder)
