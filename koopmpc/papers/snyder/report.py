"""The report on Snyder & Song (2021): what the paper left open, its claims, its figures and their numbers."""

from collections.abc import Mapping, Sequence

import numpy as np

from koopmpc.data.collect import collect
from koopmpc.data.excitation import Noise
from koopmpc.errors import unwarned
from koopmpc.figures.series import reconstruction
from koopmpc.identify.fits.dmd import dmd, dmdc
from koopmpc.papers.plants import Pendulum, inputs_of, trajectories
from koopmpc.papers.registry import Claim, percent, relative, summary
from koopmpc.papers.snyder.claims import Fits
from koopmpc.papers.snyder.reconstruction import Reconstruction, Setting
from koopmpc.papers.snyder.settings import FIGURES, VARIANTS, gains
from koopmpc.plants.integrators import RK4
from koopmpc.plants.step_map import discretize
from koopmpc.recording.page import Page

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


def opening(page: Page, claims: Sequence[Claim], change: float, others: int) -> None:
    """Open the report: what the paper is, what it left open, and how its claims fared.

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
        OPENING.format(total=len(claims), summary=summary(claims)),
        SETTINGS,
        FEEDBACK.format(change=percent(change)),
        MEASURES.format(others=others),
    )


def numbers(page: Page, settings: Mapping[str, Setting], fits: Fits, claims: Sequence[Claim]) -> None:
    """Add a line for each figure, trajectory and rank, with the paper's claim, the verdict and why."""
    page.text("## The figures, in numbers")
    rows: list[tuple[object, ...]] = []
    told = iter(claims)
    for shown in FIGURES:
        for setting in shown.settings:
            claim = next(told)
            for full in (True, False):
                fit = fits[setting].get((shown.method, full))
                if fit is not None:
                    said = (claim.says, f"**{claim.verdict.value}**", claim.why) if full else ("", "", "")
                    rows.append((shown.name, *_row(settings[setting], shown.method, fit), *said))
    page.table(("figure", *HEAD, "the paper", "verdict", "why"), rows)


def pictures(page: Page, settings: Mapping[str, Setting], fits: Fits) -> None:
    """Draw the figures of the paper; those of its appendix come last."""
    page.text("## The figures", LAYOUT)
    for shown in sorted(FIGURES, key=lambda shown: shown.appendix):
        cases = {
            settings[setting].title: (settings[setting].trajectory[0].X, _curves(shown.method, fits[setting]))
            for setting in shown.settings
        }
        first = settings[shown.settings[0]]
        data = " and ".join(settings[setting].title.split(", ")[-1] for setting in shown.settings)
        caption = f"{first.title.split(',')[0]}, {data}: {shown.method}" + (" (appendix)" if shown.appendix else "")
        draw(page, shown.name, caption, cases, first)


def draw(
    page: Page,
    name: str,
    caption: str,
    cases: Mapping[str, tuple[np.ndarray, Mapping[str, np.ndarray]]],
    setting: Setting,
) -> None:
    """Draw reconstructions with a column for each case, and add a tab with the curves of each case to the recording."""
    states = setting.dynamics.states
    page.picture(name, caption, reconstruction(cases, setting.dt, states))
    for title, (truth, curves) in cases.items():
        size = float(np.linalg.norm(truth, axis=1).max())
        table = {"truth": np.hstack([truth, np.full((len(truth), 1), np.nan)])}
        for curve, X in curves.items():
            error = np.linalg.norm(X - truth, axis=1, keepdims=True) / size
            table[curve] = np.hstack([X, np.log10(np.maximum(error, 1e-16))])
        page.curve(f"{name}, {title}", setting.dt, (*states, "log10 of the relative error"), table)


def variants(page: Page, settings: Mapping[str, Setting], fits: Fits) -> None:
    """Add what the paper's words also allow: the upright pendulum, g = 10 m/s², the databook's cart-pole."""
    page.text("## Other readings of the paper", READINGS)
    seen = {(setting, shown.method) for shown in FIGURES for setting in shown.settings}
    page.table(
        HEAD,
        [
            _row(settings[setting], method, fit)
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
        draw(page, f"variant-{name}", caption, cases, settings[names[0]])


def feedbacks(page: Page) -> None:
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
        [(titles[name], ", ".join(f"{k + 0.0:.4f}" for k in K.ravel())) for name, K in gains().items()],
    )


def appendix_dmdc(page: Page, free: Setting, driven: Setting) -> None:
    """Add DMDc of the pendulum, with the input of the feedback and with an exciting input."""
    K = gains()["pendulum"]
    plant = discretize(Pendulum(), driven.dt, RK4(8))
    held = trajectories(driven.dynamics, driven.x0, dt=driven.dt, steps=driven.steps, K=K, held=True)
    fed = inputs_of(held, plant.inputs, K)
    rich = collect(plant, driven.x0, Noise(-1.0, 1.0, hold=20), episodes=1, steps=driven.steps)
    other = collect(plant, driven.x0, Noise(-1.0, 1.0, hold=20), episodes=1, steps=driven.steps, rng=1)
    B = plant.linearize([0.0, 0.0], [0.0]).B
    page.text("### Appendix: DMDc of the pendulum", DMDC)
    with unwarned():
        models = {
            "DMD, uncontrolled": (dmd(free.trajectory), free.trajectory),
            "DMDc, LQR data": (dmdc(fed), fed),
            "DMDc, LQR data, B known": (dmdc(fed, B=B), fed),
            "DMDc, exciting input": (dmdc(rich), rich),
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
                percent(relative(curves[name], episode.X)),
                "–" if elsewhere is None else percent(relative(elsewhere, other[0].X)),
                "–" if not model.nu else f"{float(model.B[1, 0] / B[1, 0]):.4g}",
            )
        )
    page.table(("model and data", "rank of [X; U]", "error [%]", "under another input [%]", "B, of the true one"), rows)
    cases = {
        "LQR data": (held[0].X, {n: curves[n] for n in ("DMDc, LQR data", "DMDc, LQR data, B known")}),
        "Exciting input": (rich[0].X, {"DMDc, exciting input": curves["DMDc, exciting input"]}),
    }
    draw(page, "appendix-pendulum-dmdc", "Pendulum: DMDc (appendix)", cases, driven)


def _row(setting: Setting, method: str, fit: Reconstruction) -> tuple[object, ...]:
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


def _curves(method: str, found: Mapping[tuple[str, bool], Reconstruction]) -> dict[str, np.ndarray]:
    """Return the reconstructions of one method, named after their rank."""
    fits = [found[method, full] for full in (True, False) if (method, full) in found]
    return {f"{'full rank' if i == 0 else f'rank {fit.rank}'}": fit.X for i, fit in enumerate(fits)}
