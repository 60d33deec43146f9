"""Three papers with I. Kevrekidis: EDMD on monomials, on a polynomial kernel, and on trained Gaussians."""

from collections.abc import Callable
from functools import partial
from time import perf_counter

import casadi as ca
import numpy as np

import koopmpc as km
from koopmpc import papers

percent = papers.percent

A = np.array([[0.9, -0.04], [0.0, 0.8]])
W = np.array([[1.0, -0.4], [0.0, 1.0]])  # rows are the left eigenvectors of A
SAMPLES = 100  # pairs (x, A x) of the linear plant
DEGREE = 4  # total degree of the monomials
POWERS = [(i, n - i) for n in range(DEGREE + 1) for i in range(n, -1, -1)]
SIZES = (2, 4, 6, 8, 10)  # numbers of states in the comparison of times
LANDMARKS = (25, 50, 100, 200, 400)  # numbers of landmarks
KERNEL_GAP = 1e-8  # eigenvalues of the kernel and of all monomials may differ by this


def reproduce_williams(page: papers.Page, quick: bool, progress: papers.TellPart) -> list[papers.Claim]:
    """Williams et al. 2015: EDMD finds eigenvalues and eigenfunctions.

    M. Williams, I. Kevrekidis and C. Rowley, *A Data-Driven Approximation of the Koopman Operator: Extending
    Dynamic Mode Decomposition*, J. Nonlinear Sci. 25 (2015), its linear example.

    x⁺ = A x with A = [.9 −.04; 0 .8]; ψ holds all monomials of total degree 0 to 4. A linear plant maps them to
    themselves, so EDMD is exact: its eigenvalues are .9ⁱ·.8ʲ with i + j ≤ 4, and its eigenfunctions (w₁ᵀx)ⁱ
    (w₂ᵀx)ʲ, where w are the left eigenvectors of A. The data are {samples} states from a normal distribution and
    their successors.
    """
    progress("EDMD")
    model = km.edmd(_make_pairs(A, SAMPLES), _monomials(DEGREE))
    exact = np.array([0.9**i * 0.8**j for i, j in POWERS])
    order = [int(np.abs(model.eigenvalues - value).argmin()) for value in exact]
    found = model.eigenvalues[order]
    grid = np.stack(np.meshgrid(*[np.linspace(-2, 2, 21)] * 2), axis=-1).reshape(-1, 2)
    phi = model.eigenfunctions(grid)[:, order]
    off = [_angle(phi[:, k], (grid @ W[0]) ** i * (grid @ W[1]) ** j) for k, (i, j) in enumerate(POWERS)]
    gap, farthest = float(np.abs(found - exact).max()), float(np.max(off))
    page.text("## Eigenvalues and eigenfunctions", """The last column is the sine of the angle between φ and
        (w₁ᵀx)ⁱ (w₂ᵀx)ʲ on a grid over [−2, 2]².""")  # fmt: skip
    page.table(
        ("i, j", "exact λ", "|λ − exact|", "φ off by"),
        [
            (f"{i}, {j}", f"{value:.6g}", f"{abs(f - value):.0e}", f"{o:.0e}")
            for (i, j), value, f, o in zip(POWERS, exact, found, off, strict=True)
        ],
    )
    page.picture(
        "eigenfunctions",
        "Eigenfunctions of λ = .9, .8 and .72",
        partial(
            km.plot.save,
            km.plot.eigenfunction_maps(model, [order[k] for k in (1, 2, 4)], (0, 1), ((-2.0, 2.0), (-2.0, 2.0))),
        ),
    )
    steps = np.arange(31)[:, None]
    curves = {"EDMD": (np.real(found) ** steps), "exact": exact**steps}
    page.curve("Powers of the eigenvalues", 1.0, [f"λ {i},{j}" for i, j in POWERS], curves)
    return [
        papers.judge_claim(
            "eigenvalues",
            "all 15 are .9ⁱ·.8ʲ, ± 1e-10",
            holds=gap <= 1e-10 and len(set(order)) == len(POWERS),
            why=f"farthest off by {gap:.0e}",
            required=True,
        ),
        papers.judge_claim(
            "eigenfunctions",
            "(w₁ᵀx)ⁱ (w₂ᵀx)ʲ, ± 1e-9 (ours)",
            holds=farthest <= 1e-9,
            why=f"farthest off by {farthest:.0e}",
            required=True,
        ),
    ]


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Return the sine of the angle between two complex vectors."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return float(np.linalg.norm(a - np.vdot(b, a) * b))


edmd_paper = papers.make_paper("williams", reproduce_williams.__doc__, reproduce_williams, samples=SAMPLES)


def reproduce_kernel(page: papers.Page, quick: bool, progress: papers.TellPart) -> list[papers.Claim]:
    """Williams, Rowley & Kevrekidis 2015: kernel EDMD, and Nyström's approximation for many samples.

    M. Williams, C. Rowley and I. Kevrekidis, *A Kernel-Based Method for Data-Driven Koopman Spectral Analysis*, J.
    Comput. Dyn. 2 (2015).

    With the kernel k(x, y) = (1 + xᵀy)^p kernel EDMD has the eigenvalues of EDMD on all monomials to degree p, and
    forms no monomial: its cost goes with the samples. Measured: the exact law on the linear plant of Williams,
    Kevrekidis & Rowley 2015 and on a Duffing oscillator without input, ẍ = −0.5 ẋ + x − x³, sampled at 0.1 s; the
    time of both fits for plants of 2 to {largest} states, degree 4, from 120 samples; and for the Gaussian kernel
    and 2,000 samples of Duffing the error on held-out samples with 25 to 400 of them as landmarks.
    """
    progress("the law of the polynomial kernel")
    claims = [*_check_kernel_law(page)]
    progress("cost")
    claims += _measure_cost(page, SIZES[:-1] if quick else SIZES)
    progress("landmarks")
    return claims + _measure_landmarks(page)


def _collect_sampled_duffing(episodes: int, steps: int, seed: int = 0) -> km.Episodes:
    plant = km.discretize(km.load_problem("duffing").dynamics, 0.1, km.RK4(4))
    data = km.collect(
        plant, km.Uniform([-2.0, -2.0], [2.0, 2.0]), km.Noise(0.0, 0.0), episodes=episodes, steps=steps, rng=seed
    )
    return km.Episodes([km.Episode(X=e.X) for e in data], data.dt, data.states)


def _make_pairs(matrix: np.ndarray, count: int) -> km.Episodes:
    X = np.random.default_rng(0).standard_normal((count, len(matrix)))
    return km.Episodes([km.Episode(X=np.stack([x, matrix @ x])) for x in X], 1.0)


def _check_kernel_law(page: papers.Page) -> list[papers.Claim]:
    cases = {"linear plant": _make_pairs(A, SAMPLES), "Duffing": _collect_sampled_duffing(60, 3)}
    rows: list[tuple[object, ...]] = []
    worst: dict[str, float] = {}
    for name, data in cases.items():
        for p in (1, 2, 3, 4):
            full, kernel = km.edmd(data, _monomials(p)), km.identify.kernel_edmd(data, "polynomial", degree=p)
            gap = _distance(full.eigenvalues, kernel.eigenvalues)
            worst[name] = max(worst.get(name, 0.0), gap)
            rows.append((name, p, full.nz, kernel.nz, f"{gap:.0e}"))
    page.text("## The law", "*Apart* is the largest distance of an eigenvalue of one from the nearest of the other.")
    page.table(("data", "degree", "monomials", "coordinates of the kernel", "apart"), rows)
    return [
        papers.judge_claim(
            name,
            f"eigenvalues of all monomials, ± {KERNEL_GAP:g}",
            holds=gap <= KERNEL_GAP,
            why=f"{gap:.0e}",
            required=True,
        )
        for name, gap in worst.items()
    ]


def _monomials(degree: int) -> km.Lifting:
    return km.Constant() + km.State() + (km.Monomials(degree) if degree > 1 else km.Constant())


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    distances = np.abs(a[:, None] - b)
    return float(max(distances.min(axis=0).max(), distances.min(axis=1).max()))


def _measure_cost(page: papers.Page, sizes: tuple[int, ...]) -> list[papers.Claim]:
    times: dict[str, list[float]] = {"EDMD on monomials": [], "kernel EDMD": []}
    rows: list[tuple[object, ...]] = []
    for nx in sizes:
        rng = np.random.default_rng(nx)
        data = _make_pairs(0.9 * np.linalg.qr(rng.standard_normal((nx, nx)))[0], 120)
        with km.errors.hide_fit_warnings():
            full, first = _time_fit(lambda data=data: km.edmd(data, _monomials(4)))
            kernel, second = _time_fit(lambda data=data: km.identify.kernel_edmd(data, "polynomial", degree=4))
        for name, value in zip(times, (first, second), strict=True):
            times[name].append(value)
        rows.append((nx, full.nz, kernel.nz, f"{1e3 * first:.3g}", f"{1e3 * second:.3g}"))
    page.text("## Cost", "Times of one run on the machine that wrote this page; their growth is what counts.")
    page.table(("states", "monomials", "coordinates of the kernel", "EDMD [ms]", "kernel EDMD [ms]"), rows)
    drawn = {name: (np.array(sizes), 1e3 * np.array(each)) for name, each in times.items()}
    page.picture(
        "cost",
        "Time of a fit, degree 4, 120 samples",
        partial(km.plot.save, papers.draw_panels([papers.CurvePanel("states", "time [ms]", drawn, log="y")])),
    )
    growth = {name: each[-1] / each[0] for name, each in times.items()}
    why = f"{growth['EDMD on monomials']:.0f} times for EDMD, {growth['kernel EDMD']:.1f} times for the kernel"
    says = f"from {sizes[0]} to {sizes[-1]} states, cost goes with the samples and not with the monomials"
    holds = growth["kernel EDMD"] < growth["EDMD on monomials"] / 4
    return [papers.judge_claim("cost", says, holds=holds, why=why)]


def _time_fit(fit: Callable[[], km.LinearPredictor]) -> tuple[km.LinearPredictor, float]:
    start = perf_counter()
    model = fit()
    return model, perf_counter() - start


def _measure_landmarks(page: papers.Page) -> list[papers.Claim]:
    train, test = _collect_sampled_duffing(100, 20), _collect_sampled_duffing(50, 20, seed=1)
    errors: list[float] = []
    for m in LANDMARKS:
        with km.errors.hide_fit_warnings():
            model = km.identify.kernel_edmd(train, "gaussian", width=1.0, landmarks=m, ridge=1e-12)
        missed = np.concatenate([model.rollout(e.X[0], np.empty((10, 0)))[-1] - e.X[10] for e in test])
        errors.append(float(np.linalg.norm(missed) / np.linalg.norm([e.X[10] for e in test])))
    page.text("## Landmarks", "Relative error ten steps, 1 s, ahead on 50 episodes that were not fitted.")
    page.table(("landmarks", "error [%]"), [(m, percent(e)) for m, e in zip(LANDMARKS, errors, strict=True)])
    curve = np.array(errors)[:, None]
    drawn = {"Gaussian kernel": (np.array(LANDMARKS), 100 * curve[:, 0])}
    page.picture(
        "landmarks",
        "Error after 1 s",
        partial(km.plot.save, papers.draw_panels([papers.CurvePanel("landmarks", "error [%]", drawn, log="y")])),
    )
    page.curve("Error by landmarks, in the order of the table", 1.0, ("error",), {"Gaussian kernel": curve})
    says = "few landmarks of many samples suffice: the error falls with their number"
    why = f"from {percent(errors[0])} % at {LANDMARKS[0]} to {percent(errors[-1])} % at {LANDMARKS[-1]}"
    return [
        papers.judge_claim("Nyström", says, holds=errors[-1] < errors[0] / 10, in_part=errors[-1] < errors[0], why=why)
    ]


kernel_paper = papers.make_paper("kernel", reproduce_kernel.__doc__, reproduce_kernel, largest=SIZES[-1])


# Settings of dictionary learning
DT = 0.25  # sample time [s]
STEPS = 10  # steps of a trajectory, and horizon of the errors
COUNT = 1000  # trajectories in each data set
RIDGE = 1e-8
WIDTHS = (0.3, 0.4, 0.5, 0.6, 0.8, 1.2)  # candidate widths of fixed Gaussians
FEW = 25  # number of Gaussians in a small dictionary
MANY = 100  # number of Gaussians in a large dictionary
WINDOWS = 300  # trajectories that the training reads


class Duffing(km.Dynamics):
    """ẍ = −.5 ẋ + x − x³, Li et al. 2017."""

    states = ("x", "v")
    inputs = ()

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """Return [v, −.5 v + x − x³]."""
        return ca.vertcat(x[1], -0.5 * x[1] + x[0] - x[0] ** 3)


def reproduce_dictionary(page: papers.Page, quick: bool, progress: papers.TellPart) -> list[papers.Claim]:
    """Dictionary learning: 25 trained Gaussians against 100 fixed ones.

    Q. Li, F. Dietrich, E. Bollt and I. Kevrekidis, *Extended dynamic mode decomposition with dictionary learning: a
    data-driven adaptive spectral decomposition of the Koopman operator*, Chaos 27 (2017). Its claim is in kind: a
    few observables that are trained predict as well as many fixed ones. The paper trains a neural network; here the
    centres and the widths of Gaussians are trained by `km.train`, variable projection on the N-step error.

    Duffing's oscillator without input, ẍ = −.5ẋ + x − x³, sampled at .25 s: {count} trajectories of 10 steps from
    starts uniform in [−2, 2]². Observables are the state, the constant, and Gaussians with centres uniform in
    [−2, 2]². Fixed ones share one width, the best of {widths} on held-out data. Trained ones start at the same random
    centres from the width of the 100, and each gets a width of its own. The error is that of `km.score`: over 10
    steps and {count} unseen trajectories, relative to the size of each state.
    """
    seeds, iterations, count = (1, 30, 200) if quick else (3, 800, COUNT)
    data, held, unseen = (_collect_duffing(count, seed) for seed in range(3))
    found: dict[str, list[km.LinearPredictor]] = {name: [] for name in ("25 fixed", "100 fixed", "25 trained")}
    widths: dict[str, list[float]] = {"25 fixed": [], "100 fixed": []}
    changes: list[str] = []
    for seed in range(seeds):
        progress(f"dictionary {seed + 1} of {seeds}")
        centers = np.random.default_rng(10 + seed).uniform(-2, 2, (MANY, 2))
        for name, some in (("25 fixed", centers[:FEW]), ("100 fixed", centers)):
            fits = {width: _fit_gaussians(data, some, width) for width in WIDTHS}
            best = min(fits, key=lambda width: _total_error(fits[width], held))
            found[name].append(fits[best])
            widths[name].append(best)
        start = _make_lifting(centers[:FEW], np.full(FEW, widths["100 fixed"][-1]))
        trained = km.train(
            start, data, horizon=STEPS, held_out=held, ridge=RIDGE, windows=WINDOWS, iterations=iterations
        )
        found["25 trained"].append(trained)
        assert trained.report is not None
        changes.append(trained.report.changes[-1])
    errors = {name: np.array([_total_error(model, unseen) for model in models]) for name, models in found.items()}
    columns = [errors["25 fixed"], widths["25 fixed"], errors["25 trained"], errors["100 fixed"], widths["100 fixed"]]
    page.text("## Errors on unseen trajectories", "One row for each draw of the centres.")
    page.table(
        ("25 fixed [%]", "their width", "25 trained [%]", "100 fixed [%]", "their width"),
        [(percent(a), w, percent(b), percent(c), v) for a, w, b, c, v in zip(*columns, strict=True)],
    )
    page.items(changes)
    centers = np.random.default_rng(10).uniform(-2, 2, (MANY, 2))
    by_width = np.array([_total_error(_fit_gaussians(data, centers, width), unseen) for width in WIDTHS])
    said = ", ".join(f"{percent(error)} % at {width}" for error, width in zip(by_width, WIDTHS, strict=True))
    page.text(f"The 100 depend on their width: with the centres of the first row the errors are {said}.")
    _draw_dictionary(page, {name: models[0] for name, models in found.items()}, unseen)
    few, own = (float(np.median(errors[name])) for name in ("25 fixed", "25 trained"))
    best, many = (
        float(errors[name][int(np.argmin([_total_error(model, held) for model in found[name]]))])
        for name in ("25 trained", "100 fixed")
    )
    usual = float(np.median(by_width))
    return [
        papers.judge_claim(
            "25 trained, 25 fixed",
            "training makes a dictionary better",
            holds=bool((errors["25 trained"] < 0.7 * errors["25 fixed"]).all()),
            in_part=own < few,
            why=f"{percent(own)} % against {percent(few)} %, medians",
            required=not quick,
        ),
        papers.judge_claim(
            "25 trained, 100 fixed",
            "25 trained Gaussians predict as well as 100 fixed ones",
            holds=best <= many,
            in_part=best <= usual,
            why=f"{percent(best)} % against {percent(many)} %, the draws that held-out data choose. The width of the "
            f"100 is chosen, too; the median of the {len(WIDTHS)} gives {percent(usual)} %",
        ),
        papers.judge_claim(
            "held-out data",
            "a trained dictionary is never worse than untrained (ours)",
            holds=bool((errors["25 trained"] <= errors["25 fixed"]).all()),
            why=f"{int((errors['25 trained'] <= errors['25 fixed']).sum())} of {seeds} draws are better on unseen data",
            required=True,
        ),
    ]


def _draw_dictionary(page: papers.Page, models: dict[str, km.LinearPredictor], unseen: km.Episodes) -> None:
    """Draw the error by steps ahead, the centres of the Gaussians, and one long prediction."""
    ahead = DT * np.arange(1, STEPS + 1)
    by_step = {
        name: (ahead, np.sqrt(np.mean(km.score(model, unseen, STEPS).relative ** 2, axis=1)))
        for name, model in models.items()
    }
    spots = {name: _centers(model.lifting) for name, model in models.items() if name != "100 fixed"}
    panels = [
        papers.CurvePanel("time ahead [s]", "relative error", by_step, log="y", title="Unseen trajectories"),
        papers.CurvePanel(
            "x", "v", {name: (c[:, 0], c[:, 1]) for name, c in spots.items()}, points=True, title="Centres"
        ),
    ]
    page.picture(
        "errors",
        "Error by time ahead, and where the Gaussians stand",
        partial(km.plot.save, papers.draw_panels(panels)),
    )
    truth = km.discretize(Duffing(), DT).rollout([-1.6, 1.2], np.zeros((2 * STEPS, 0)))
    curves = {"truth": truth}
    curves |= {name: model.rollout(truth[0], np.zeros((2 * STEPS, 0))) for name, model in models.items()}
    drawn = [
        papers.CurvePanel(
            "time [s]", state, {name: (DT * np.arange(len(X)), X[:, i]) for name, X in curves.items()}, ylim=(-2.5, 2.5)
        )
        for i, state in enumerate(("x", "v"))
    ]
    page.picture(
        "prediction",
        "A prediction over twice the horizon that was trained for",
        partial(km.plot.save, papers.draw_panels(drawn)),
    )
    page.curve("A prediction over 5 s", DT, ("x", "v"), curves)


def _make_lifting(centers: np.ndarray, width: float | np.ndarray) -> km.Lifting:
    return km.State() + km.Constant() + km.Gaussian(centers, width)


def _centers(lifting: km.Lifting) -> np.ndarray:
    """Return the centres of the Gaussians in a sum."""
    (bells,) = (part for part in getattr(lifting, "parts", ()) if isinstance(part, km.Gaussian))
    return bells.centers


def _fit_gaussians(data: km.Episodes, centers: np.ndarray, width: float) -> km.LinearPredictor:
    with km.errors.hide_fit_warnings():
        return km.edmd(data, _make_lifting(centers, width), ridge=RIDGE)


def _total_error(model: km.LinearPredictor, episodes: km.Episodes) -> float:
    return km.score(model, episodes, STEPS).total


def _collect_duffing(count: int, seed: int) -> km.Episodes:
    plant = km.discretize(Duffing(), DT)
    X = plant.rollouts(np.random.default_rng(seed).uniform(-2, 2, (count, 2)), np.zeros((count, STEPS, 0)))
    return km.Episodes([km.Episode(X=x) for x in X], DT, plant.states)


dictionary_paper = papers.make_paper(
    "dictionary", reproduce_dictionary.__doc__, reproduce_dictionary, count=COUNT, widths=", ".join(map(str, WIDTHS))
)
