"""The parts of the report on Snyder & Song (2021): settings, tables of the figures, and the figures themselves."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from koopmpc.bench.page import Page
from koopmpc.data.collect import collect
from koopmpc.data.excitation import Noise
from koopmpc.figures.comparisons import reconstruction
from koopmpc.figures.plane import eigenfunctions
from koopmpc.identify.fits.dmd import dmd, dmdc
from koopmpc.papers.plants import Pendulum, frequency, inputs_of, trajectories
from koopmpc.papers.reconstruction import Reconstruction, Scene, percent, relative, unwarned
from koopmpc.papers.registry import Claim, Verdict
from koopmpc.papers.snyder import words
from koopmpc.papers.snyder.claims import Fits
from koopmpc.papers.snyder.equations import equations, sides
from koopmpc.papers.snyder.settings import FIGURES, OBSERVABLES, VARIANTS, gains
from koopmpc.plants.integrators import RK4
from koopmpc.plants.step_map import discretize
from koopmpc.predict.spectrum import continuous_eigenvalues

HEAD = ("data", "observables", "rank", "σ₁/σ_r", "error [%]", "held out [%]", "leading φ [%]", "φ within 5 %")


def settings(page: Page, claims: Sequence[Claim], change: float, others: int) -> None:
    """Open the report: what the paper is, what it left open, and how its claims fared.

    Parameters
    ----------
    page
        Where it goes.
    claims
        All of them.
    change
        By how much errors change, relative, where inputs are held over a sample.
    others
        How many trajectories were held out.
    """
    count = Counter(claim.verdict for claim in claims)
    plural = {Verdict.HOLDS: "hold", Verdict.IN_PART: "hold in part", Verdict.FAILS: "do not hold"}
    summary = ", ".join(f"{count[verdict]} {word}" for verdict, word in plural.items())
    page.text(
        "# Snyder & Song 2021, done again",
        words.OPENING.format(total=len(claims), summary=summary),
        words.SETTINGS,
        words.FEEDBACK.format(change=percent(change)),
        words.MEASURES.format(others=others),
    )


def verdicts(page: Page, claims: Sequence[Claim]) -> None:
    """Add the claims of abstract, results and discussion."""
    page.text("## What the paper says in words")
    page.table(
        ("where", "claim", "verdict", "why"),
        [(c.where, c.says, f"**{c.verdict.value}**", c.why) for c in claims],
    )


def numbers(page: Page, stage: Mapping[str, Scene], fits: Fits, claims: Sequence[Claim]) -> None:
    """Add one line a figure, data and rank, with the paper's claim of it, the verdict and why."""
    page.text("## The figures, in numbers")
    rows: list[tuple[object, ...]] = []
    told = iter(claims)
    for shown in FIGURES:
        for scene in shown.scenes:
            claim = next(told)
            for full in (True, False):
                fit = fits[scene].get((shown.method, full))
                if fit is not None:
                    said = (claim.says, f"**{claim.verdict.value}**", claim.why) if full else ("", "", "")
                    rows.append((shown.name, *_row(stage[scene], shown.method, fit), *said))
    page.table(("figure", *HEAD, "the paper", "verdict", "why"), rows)


def pictures(page: Page, stage: Mapping[str, Scene], fits: Fits) -> None:
    """Draw the figures of the paper, its appendix last."""
    page.text("## The figures", words.FIGURES)
    for shown in sorted(FIGURES, key=lambda shown: shown.appendix):
        cases = {
            stage[scene].title: (stage[scene].trajectory[0].X, _curves(shown.method, fits[scene]))
            for scene in shown.scenes
        }
        first = stage[shown.scenes[0]]
        data = " and ".join(stage[scene].title.split(", ")[-1] for scene in shown.scenes)
        caption = f"{first.title.split(',')[0]}, {data}: {shown.method}" + (" (appendix)" if shown.appendix else "")
        draw(page, shown.name, caption, cases, first)


def draw(
    page: Page,
    name: str,
    caption: str,
    cases: Mapping[str, tuple[np.ndarray, Mapping[str, np.ndarray]]],
    scene: Scene,
) -> None:
    """Draw reconstructions, a column a case, and put the curves into the recording, a tab a case."""
    states = scene.dynamics.states
    page.picture(name, caption, reconstruction(cases, scene.dt, states))
    for title, (truth, curves) in cases.items():
        size = float(np.linalg.norm(truth, axis=1).max())
        table = {"truth": np.hstack([truth, np.full((len(truth), 1), np.nan)])}
        for curve, X in curves.items():
            error = np.linalg.norm(X - truth, axis=1, keepdims=True) / size
            table[curve] = np.hstack([X, np.log10(np.maximum(error, 1e-16))])
        page.curve(f"{name}, {title}", scene.dt, (*states, "log10 of the relative error"), table)


def variants(page: Page, stage: Mapping[str, Scene], fits: Fits) -> None:
    """Add what the paper's words would also allow: the upright pendulum, g = 10, the databook's cart-pole."""
    page.text("## Other readings of the paper", words.VARIANTS)
    seen = {(scene, shown.method) for shown in FIGURES for scene in shown.scenes}
    page.table(
        HEAD,
        [
            _row(stage[scene], method, fit)
            for scene in (*VARIANTS, "cart-pole", "cart-pole-lqr")
            for (method, _), fit in fits[scene].items()
            if (scene, method) not in seen
        ],
    )
    chosen = ("DMD", "EDMD monomials 3", "EDMD Fourier 1")
    for name, names, caption in (
        ("upright", ("upright", "upright-lqr"), "Pendulum, upright: at full rank"),
        ("databook", ("databook", "databook-legacy"), "Cart-pole of the databook: at full rank"),
    ):
        cases = {
            stage[scene].title: (
                stage[scene].trajectory[0].X,
                {method: fits[scene][method, True].X for method in chosen},
            )
            for scene in names
        }
        draw(page, f"variant-{name}", caption, cases, stage[names[0]])


def gains_table(page: Page) -> None:
    """Add the feedbacks."""
    page.text("## The feedbacks", words.GAINS)
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


def frequencies(page: Page, fits: Fits) -> None:
    """Add the eigenvalues of the pendulum's fits beside what they should be."""
    plant = Pendulum()
    small, right = frequency(plant, 0.0), frequency(plant, np.pi / 4)
    page.text("## The frequency of the pendulum", words.FREQUENCY.format(small=small, right=right))
    rows: list[tuple[object, ...]] = []
    for method in OBSERVABLES:
        fit = fits["pendulum"][method, True]
        size = abs(fit.model.eigenvalues[fit.leading])
        turn = abs(continuous_eigenvalues(fit.model)[fit.leading].imag)
        rows.append(
            (
                method,
                f"{size:.6f}",
                f"{turn:.5f}",
                f"{100 * (turn / small - 1):+.2f}",
                f"{100 * (turn / right - 1):+.4f}",
            )
        )
    page.table(
        ("observables", "|λ| of the leading φ", "frequency [rad/s]", "off √(g/L) [%]", "off that at π/4 [%]"),
        rows,
    )


def theory(page: Page, scene: Scene, fits: Fits) -> None:
    """Add each equation with the function that computes it, and a picture of the leading eigenfunction."""
    lifting = OBSERVABLES["EDMD Fourier 1"]
    width, rank = lifting.bind(scene.dynamics.states).nz, 4
    page.text("## The equations", words.EQUATIONS.format(rank=rank, width=width))
    page.table(
        ("equations", "formula", "function", "distance"),
        [
            (e.number, e.formula, f"`{e.function}`", "0" if e.residual == 0 else f"{e.residual:.0e}")
            for e in equations(scene.trajectory, lifting, rank)
        ],
    )
    left, right = sides(scene.trajectory, OBSERVABLES["EDMD monomials 3"])
    page.text(words.SIDES.format(left=percent(left), right=percent(right)))
    fit = fits["pendulum"]["EDMD monomials 3", True]
    made = eigenfunctions(fit.model, fit.leading, (0, 1), ((-1.0, 1.0), (-2.0, 2.0)))
    page.picture("pendulum-eigenfunctions", "Pendulum, monomials 3: the leading eigenfunction", made)


def _row(scene: Scene, method: str, fit: Reconstruction) -> tuple[object, ...]:
    return (
        scene.title,
        method,
        f"{fit.rank} of {fit.width}",
        f"{fit.condition:.1e}",
        percent(fit.error),
        percent(fit.held_out),
        percent(float(fit.evolution[fit.leading])),
        f"{fit.linear} of {fit.rank}",
    )


def _curves(method: str, found: Mapping[tuple[str, bool], Reconstruction]) -> dict[str, np.ndarray]:
    """Return the reconstructions of one method by their rank."""
    fits = [found[method, full] for full in (True, False) if (method, full) in found]
    return {f"{'full rank' if i == 0 else f'rank {fit.rank}'}": fit.X for i, fit in enumerate(fits)}


def appendix_dmdc(page: Page, free: Scene, driven: Scene) -> None:
    """Add DMDc of the pendulum, where the input is the feedback's and where it excites."""
    K = gains()["pendulum"]
    plant = discretize(Pendulum(), driven.dt, RK4(8))
    held = trajectories(driven.dynamics, driven.x0, dt=driven.dt, steps=driven.steps, K=K, held=True)
    fed = inputs_of(held, plant.inputs, K)
    rich = collect(plant, driven.x0, Noise(-1.0, 1.0, hold=20), episodes=1, steps=driven.steps)
    other = collect(plant, driven.x0, Noise(-1.0, 1.0, hold=20), episodes=1, steps=driven.steps, rng=1)
    B = plant.linearize([0.0, 0.0], [0.0]).B
    page.text("### Appendix: DMDc of the pendulum", words.DMDC)
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
    page.table(
        ("model and data", "rank of [X; U]", "error [%]", "under another input [%]", "B, of the true one"),
        rows,
    )
    cases = {
        "LQR data": (held[0].X, {n: curves[n] for n in ("DMDc, LQR data", "DMDc, LQR data, B known")}),
        "Exciting input": (rich[0].X, {"DMDc, exciting input": curves["DMDc, exciting input"]}),
    }
    draw(page, "appendix-pendulum-dmdc", "Pendulum: DMDc (appendix)", cases, driven)
