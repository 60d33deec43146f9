"""The caution that Snyder & Song (2021) cite: a model may rebuild a trajectory and miss the system."""

from collections.abc import Mapping, Sequence

import numpy as np

from koopmpc.data.episodes import Episodes
from koopmpc.figures.plots import Plot, plots
from koopmpc.papers.reconstruction import LINEAR, Reconstruction, Setting, percent, reconstruction, relative
from koopmpc.papers.registry import Claim, judged
from koopmpc.papers.snyder.claims import Fits
from koopmpc.papers.snyder.settings import OBSERVABLES
from koopmpc.recording.page import Page

CAUTION = """\
E. Gonzalez, M. Abudia, M. Jury, R. Kamalapurkar and J. Rosenfeld, *Anti-Koopmanism*, 2021, which the paper
cites: a lifted linear model may rebuild a trajectory and yet miss the system. Its check: each method at full
rank, the error over the first part of the run, of the trajectory that was fitted and, after the stroke, the
median over {others} trajectories from unseen starts, both predicted from their first state alone. Where the
second is many times the first, what was found is the trajectory."""

HORIZONS = (0.1, 0.5, 1.0, 2.0, 5.0, 10.0)  # [s]


def caution(page: Page, settings: Mapping[str, Setting], fits: Fits) -> list[Claim]:
    """Add reconstruction against prediction from unseen starts, horizon by horizon, and return what it says."""
    plants = ("pendulum", "pendulum-lqr", "cart-pole", "cart-pole-lqr")
    errors = {
        (name, method): by_horizon(settings[name], fits[name][method, True], HORIZONS)
        for name in plants
        for method in OBSERVABLES
    }
    page.text("## A caution: reconstruction is not prediction", CAUTION.format(others=settings["pendulum"].others))
    page.table(
        ("data", "observables", *(f"{h:g} s [%]" for h in HORIZONS)),
        [
            (settings[name].title, method, *(f"{percent(own)} / {percent(new)}" for own, new in each))
            for (name, method), each in errors.items()
        ],
    )
    best = min(OBSERVABLES, key=lambda method: errors["cart-pole", method][-1][1])
    missed = [each for each in errors.values() if each[-1][0] < LINEAR and each[-1][1] > 10 * max(each[-1][0], 1e-3)]
    drawn = [
        Plot(
            "horizon [s]",
            "error [%]",
            {
                f"{method}, {which}": (np.array(HORIZONS), 100 * np.array(errors[name, method])[:, i])
                for method in ("DMD", "EDMD monomials 3", "EDMD Fourier 1")
                for i, which in enumerate(("fitted", "unseen"))
            },
            title=settings[name].title,
            log="y",
            ylim=(1e-8, 1e4),
        )
        for name in plants
    ]
    page.picture("caution", "Reconstruction and prediction from unseen starts", plots(drawn))
    return [
        judged(
            "Gonzalez et al. 2021",
            "a model may rebuild a trajectory and miss the system",
            holds=bool(missed),
            why=f"{len(missed)} of {len(errors)} fits rebuild 10 s within {percent(LINEAR)} % and miss unseen starts by"
            f" ten times that or more; on the free cart-pole the best for unseen starts is {best} with"
            f" {percent(errors['cart-pole', best][-1][1])} %",
        )
    ]


def by_horizon(setting: Setting, fit: Reconstruction, horizons: Sequence[float]) -> list[tuple[float, float]]:
    """Return the relative errors over the first h seconds: of the fitted trajectory, and the median of the held-out."""

    def errors(data: Episodes) -> np.ndarray:
        told = [(reconstruction(fit.model, e), e.X) for e in data]
        ends = [round(h / setting.dt) + 1 for h in horizons]
        return np.array([[relative(X[:end], truth[:end]) for end in ends] for X, truth in told])

    own, new = errors(setting.trajectory)[0], np.median(errors(setting.held_out), axis=0)
    return [(float(a), float(b)) for a, b in zip(own, new, strict=True)]
