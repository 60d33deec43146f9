"""Dictionary learning: 25 trained Gaussians against 100 fixed ones.

Q. Li, F. Dietrich, E. Bollt and I. Kevrekidis, *Extended dynamic mode decomposition with dictionary learning: a
data-driven adaptive spectral decomposition of the Koopman operator*, Chaos 27 (2017). Its claim is in kind: a few
observables that are trained predict as well as many fixed ones. The paper trains a neural network; here the centres
and the widths of Gaussians are trained by `km.train`, variable projection on the N-step error.

Duffing's oscillator without input, ẍ = −.5ẋ + x − x³, sampled at .25 s: {count} trajectories of 10 steps from starts
uniform in [−2, 2]². Observables are the state, the constant, and Gaussians with centres uniform in [−2, 2]². Fixed
ones share one width, the best of {widths} on held-out data. Trained ones start at the same random centres from
the width of the 100, and each gets a width of its own. The error is that of `km.score`: over 10 steps and {count}
unseen trajectories, relative to the size of each state.
"""

import casadi as ca
import numpy as np

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import unwarned
from koopmpc.figures.reports import Plot, plots
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.radial import Gaussian
from koopmpc.lifting.state import Constant, State
from koopmpc.papers.registry import Claim, Tell, judged, percent, short
from koopmpc.plants.dynamics import Dynamics
from koopmpc.plants.step_map import discretize
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.recording.page import Page
from koopmpc.synthesis.train import train
from koopmpc.validate.scoring import score

DT, STEPS, COUNT, RIDGE = 0.25, 10, 1000, 1e-8
WIDTHS = (0.3, 0.4, 0.5, 0.6, 0.8, 1.2)
FEW, MANY = 25, 100
WINDOWS = 300  # trajectories that the training works on


class Duffing(Dynamics):
    """ẍ = −.5 ẋ + x − x³, Li et al. 2017."""

    states = ("x", "v")
    inputs = ()

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """Return [v, −.5 v + x − x³]."""
        return ca.vertcat(x[1], -0.5 * x[1] + x[0] - x[0] ** 3)


def work(page: Page, quick: bool, tell: Tell) -> list[Claim]:
    """Train 25 Gaussians from several starts, and compare them with 25 and 100 fixed ones."""
    seeds, iterations, count = (1, 30, 200) if quick else (3, 800, COUNT)
    data, held, unseen = (_data(count, seed) for seed in range(3))
    found: dict[str, list[LinearPredictor]] = {name: [] for name in ("25 fixed", "100 fixed", "25 trained")}
    widths: dict[str, list[float]] = {"25 fixed": [], "100 fixed": []}
    changes: list[str] = []
    for seed in range(seeds):
        tell(f"dictionary {seed + 1} of {seeds}")
        centers = np.random.default_rng(10 + seed).uniform(-2, 2, (MANY, 2))
        for name, some in (("25 fixed", centers[:FEW]), ("100 fixed", centers)):
            fits = {width: _fitted(data, some, width) for width in WIDTHS}
            best = min(fits, key=lambda width: _error(fits[width], held))
            found[name].append(fits[best])
            widths[name].append(best)
        start = _lifting(centers[:FEW], np.full(FEW, widths["100 fixed"][-1]))
        trained = train(start, data, horizon=STEPS, held_out=held, ridge=RIDGE, windows=WINDOWS, iterations=iterations)
        found["25 trained"].append(trained)
        assert trained.report is not None
        changes.append(trained.report.changes[-1])
    errors = {name: np.array([_error(model, unseen) for model in models]) for name, models in found.items()}
    columns = [errors["25 fixed"], widths["25 fixed"], errors["25 trained"], errors["100 fixed"], widths["100 fixed"]]
    page.text("## Errors on unseen trajectories", "One row for each draw of the centres.")
    page.table(
        ("25 fixed [%]", "their width", "25 trained [%]", "100 fixed [%]", "their width"),
        [(percent(a), w, percent(b), percent(c), v) for a, w, b, c, v in zip(*columns, strict=True)],
    )
    page.items(changes)
    centers = np.random.default_rng(10).uniform(-2, 2, (MANY, 2))
    by_width = np.array([_error(_fitted(data, centers, width), unseen) for width in WIDTHS])
    said = ", ".join(f"{percent(error)} % at {width}" for error, width in zip(by_width, WIDTHS, strict=True))
    page.text(f"The 100 depend on their width: with the centres of the first row the errors are {said}.")
    _pictures(page, {name: models[0] for name, models in found.items()}, unseen)
    few, own = (float(np.median(errors[name])) for name in ("25 fixed", "25 trained"))
    best, many = (
        float(errors[name][int(np.argmin([_error(model, held) for model in found[name]]))])
        for name in ("25 trained", "100 fixed")
    )
    usual = float(np.median(by_width))
    return [
        judged(
            "25 trained, 25 fixed",
            "training makes a dictionary better",
            holds=bool((errors["25 trained"] < 0.7 * errors["25 fixed"]).all()),
            in_part=own < few,
            why=f"{percent(own)} % against {percent(few)} %, medians",
            required=not quick,
        ),
        judged(
            "25 trained, 100 fixed",
            "25 trained Gaussians predict as well as 100 fixed ones",
            holds=best <= many,
            in_part=best <= usual,
            why=f"{percent(best)} % against {percent(many)} %, the draws that held-out data choose. The width of the "
            f"100 is chosen, too; the median of the {len(WIDTHS)} gives {percent(usual)} %",
        ),
        judged(
            "held-out data",
            "a trained dictionary is never worse than untrained (ours)",
            holds=bool((errors["25 trained"] <= errors["25 fixed"]).all()),
            why=f"{int((errors['25 trained'] <= errors['25 fixed']).sum())} of {seeds} draws are better on unseen data",
            required=True,
        ),
    ]


def _pictures(page: Page, models: dict[str, LinearPredictor], unseen: Episodes) -> None:
    """Draw the error by steps ahead, where the Gaussians stand, and one long prediction."""
    ahead = DT * np.arange(1, STEPS + 1)
    by_step = {
        name: (ahead, np.sqrt(np.mean(score(model, unseen, STEPS).relative ** 2, axis=1)))
        for name, model in models.items()
    }
    spots = {name: _centers(model.lifting) for name, model in models.items() if name != "100 fixed"}
    panels = [
        Plot("time ahead [s]", "relative error", by_step, log="y", title="Unseen trajectories"),
        Plot("x", "v", {name: (c[:, 0], c[:, 1]) for name, c in spots.items()}, points=True, title="Centres"),
    ]
    page.picture("errors", "Error by time ahead, and where the Gaussians stand", plots(panels))
    truth = discretize(Duffing(), DT).rollout([-1.6, 1.2], np.zeros((2 * STEPS, 0)))
    curves = {"truth": truth}
    curves |= {name: model.rollout(truth[0], np.zeros((2 * STEPS, 0))) for name, model in models.items()}
    drawn = [
        Plot(
            "time [s]", state, {name: (DT * np.arange(len(X)), X[:, i]) for name, X in curves.items()}, ylim=(-2.5, 2.5)
        )
        for i, state in enumerate(("x", "v"))
    ]
    page.picture("prediction", "A prediction over twice the horizon that was trained for", plots(drawn))
    page.curve("A prediction over 5 s", DT, ("x", "v"), curves)


def _lifting(centers: np.ndarray, width: float | np.ndarray) -> Lifting:
    return State() + Constant() + Gaussian(centers, width)


def _centers(lifting: Lifting) -> np.ndarray:
    """Return the centres of the Gaussians in a sum."""
    (bells,) = (part for part in getattr(lifting, "parts", ()) if isinstance(part, Gaussian))
    return bells.centers


def _fitted(data: Episodes, centers: np.ndarray, width: float) -> LinearPredictor:
    with unwarned():
        return edmd(data, _lifting(centers, width), ridge=RIDGE)


def _error(model: LinearPredictor, episodes: Episodes) -> float:
    return score(model, episodes, STEPS).total


def _data(count: int, seed: int) -> Episodes:
    plant = discretize(Duffing(), DT)
    X = plant.rollouts(np.random.default_rng(seed).uniform(-2, 2, (count, 2)), np.zeros((count, STEPS, 0)))
    return Episodes([Episode(X=x) for x in X], DT, plant.states)


paper = short("dictionary", __doc__, work, count=COUNT, widths=", ".join(map(str, WIDTHS)))
