"""Two papers of Williams, Kevrekidis & Rowley: EDMD on monomials, and on a kernel that stands for them."""

from collections.abc import Callable
from time import perf_counter

import numpy as np

from koopmpc.bench.library import load_problem
from koopmpc.data.collect import Uniform, collect
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.excitation import Noise
from koopmpc.errors import unwarned
from koopmpc.figures.eigenvalues import eigenfunctions
from koopmpc.figures.reports import Plot, plots
from koopmpc.identify.fits.edmd import edmd
from koopmpc.identify.fits.kernel import kernel_edmd
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.papers.registry import Claim, Tell, judged, percent, short
from koopmpc.plants.integrators import RK4
from koopmpc.plants.step_map import discretize
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.recording.page import Page

A = np.array([[0.9, -0.04], [0.0, 0.8]])
W = np.array([[1.0, -0.4], [0.0, 1.0]])  # rows: left eigenvectors of A
SAMPLES, DEGREE = 100, 4
POWERS = [(i, n - i) for n in range(DEGREE + 1) for i in range(n, -1, -1)]
SIZES = (2, 4, 6, 8, 10)  # numbers of states
LANDMARKS = (25, 50, 100, 200, 400)
LAW = 1e-8


def of_edmd(page: Page, quick: bool, tell: Tell) -> list[Claim]:
    """Williams et al. 2015: EDMD finds eigenvalues and eigenfunctions.

    M. Williams, I. Kevrekidis and C. Rowley, *A Data-Driven Approximation of the Koopman Operator: Extending
    Dynamic Mode Decomposition*, J. Nonlinear Sci. 25 (2015), its linear example.

    x⁺ = A x with A = [.9 −.04; 0 .8]; ψ holds all monomials of total degree 0 to 4. A linear plant maps them to
    themselves, so EDMD is exact: its eigenvalues are .9ⁱ·.8ʲ with i + j ≤ 4, and its eigenfunctions (w₁ᵀx)ⁱ
    (w₂ᵀx)ʲ, where w are the left eigenvectors of A. The data are {samples} states from a normal distribution and
    their successors.
    """
    tell("EDMD")
    model = edmd(_pairs(A, SAMPLES), _monomials(DEGREE))
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
        eigenfunctions(model, [order[k] for k in (1, 2, 4)], (0, 1), ((-2.0, 2.0), (-2.0, 2.0))),
    )
    steps = np.arange(31)[:, None]
    curves = {"EDMD": (np.real(found) ** steps), "exact": exact**steps}
    page.curve("Powers of the eigenvalues", 1.0, [f"λ {i},{j}" for i, j in POWERS], curves)
    return [
        judged(
            "eigenvalues",
            "all 15 are .9ⁱ·.8ʲ, ± 1e-10",
            holds=gap <= 1e-10 and len(set(order)) == len(POWERS),
            why=f"farthest off by {gap:.0e}",
            required=True,
        ),
        judged(
            "eigenfunctions",
            "(w₁ᵀx)ⁱ (w₂ᵀx)ʲ, ± 1e-9 (ours)",
            holds=farthest <= 1e-9,
            why=f"farthest off by {farthest:.0e}",
            required=True,
        ),
    ]


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Return the sine of the angle between two vectors."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return float(np.linalg.norm(a - np.vdot(b, a) * b))


edmd_paper = short("williams", of_edmd.__doc__, of_edmd, samples=SAMPLES)


def of_kernel(page: Page, quick: bool, tell: Tell) -> list[Claim]:
    """Williams, Rowley & Kevrekidis 2015: kernel EDMD, and Nyström's approximation for many samples.

    M. Williams, C. Rowley and I. Kevrekidis, *A Kernel-Based Method for Data-Driven Koopman Spectral Analysis*, J.
    Comput. Dyn. 2 (2015).

    With the kernel k(x, y) = (1 + xᵀy)^p kernel EDMD has the eigenvalues of EDMD on all monomials to degree p, and
    forms no monomial: its cost goes with the samples. Measured: the exact law on the linear plant of Williams,
    Kevrekidis & Rowley 2015 and on a Duffing oscillator without input, ẍ = −0.5 ẋ + x − x³, sampled at 0.1 s; the
    time of both fits for plants of 2 to {largest} states, degree 4, from 120 samples; and for the Gaussian kernel
    and 2,000 samples of Duffing the error on held-out samples with 25 to 400 of them as landmarks.
    """
    tell("the law of the polynomial kernel")
    claims = [*_law(page)]
    tell("cost")
    claims += _cost(page, SIZES[:-1] if quick else SIZES)
    tell("landmarks")
    return claims + _landmarks(page)


def _duffing(episodes: int, steps: int, seed: int = 0) -> Episodes:
    plant = discretize(load_problem("duffing").dynamics, 0.1, RK4(4))
    data = collect(plant, Uniform([-2.0, -2.0], [2.0, 2.0]), Noise(0.0, 0.0), episodes=episodes, steps=steps, rng=seed)
    return Episodes([Episode(X=e.X) for e in data], data.dt, data.states)


def _pairs(matrix: np.ndarray, count: int) -> Episodes:
    X = np.random.default_rng(0).standard_normal((count, len(matrix)))
    return Episodes([Episode(X=np.stack([x, matrix @ x])) for x in X], 1.0)


def _law(page: Page) -> list[Claim]:
    cases = {"linear plant": _pairs(A, SAMPLES), "Duffing": _duffing(60, 3)}
    rows: list[tuple[object, ...]] = []
    worst: dict[str, float] = {}
    for name, data in cases.items():
        for p in (1, 2, 3, 4):
            full, kernel = edmd(data, _monomials(p)), kernel_edmd(data, "polynomial", degree=p)
            gap = _apart(full.eigenvalues, kernel.eigenvalues)
            worst[name] = max(worst.get(name, 0.0), gap)
            rows.append((name, p, full.nz, kernel.nz, f"{gap:.0e}"))
    page.text("## The law", "*Apart* is the largest distance of an eigenvalue of one from the nearest of the other.")
    page.table(("data", "degree", "monomials", "coordinates of the kernel", "apart"), rows)
    return [
        judged(name, f"eigenvalues of all monomials, ± {LAW:g}", holds=gap <= LAW, why=f"{gap:.0e}", required=True)
        for name, gap in worst.items()
    ]


def _monomials(degree: int) -> Lifting:
    return Constant() + State() + (Monomials(degree) if degree > 1 else Constant())


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    distances = np.abs(a[:, None] - b)
    return float(max(distances.min(axis=0).max(), distances.min(axis=1).max()))


def _cost(page: Page, sizes: tuple[int, ...]) -> list[Claim]:
    times: dict[str, list[float]] = {"EDMD on monomials": [], "kernel EDMD": []}
    rows: list[tuple[object, ...]] = []
    for nx in sizes:
        rng = np.random.default_rng(nx)
        data = _pairs(0.9 * np.linalg.qr(rng.standard_normal((nx, nx)))[0], 120)
        with unwarned():
            full, first = _timed(lambda data=data: edmd(data, _monomials(4)))
            kernel, second = _timed(lambda data=data: kernel_edmd(data, "polynomial", degree=4))
        for name, value in zip(times, (first, second), strict=True):
            times[name].append(value)
        rows.append((nx, full.nz, kernel.nz, f"{1e3 * first:.3g}", f"{1e3 * second:.3g}"))
    page.text("## Cost", "Times of one run on the machine that wrote this page; their growth is what counts.")
    page.table(("states", "monomials", "coordinates of the kernel", "EDMD [ms]", "kernel EDMD [ms]"), rows)
    drawn = {name: (np.array(sizes), 1e3 * np.array(each)) for name, each in times.items()}
    page.picture("cost", "Time of a fit, degree 4, 120 samples", plots([Plot("states", "time [ms]", drawn, log="y")]))
    growth = {name: each[-1] / each[0] for name, each in times.items()}
    why = f"{growth['EDMD on monomials']:.0f} times for EDMD, {growth['kernel EDMD']:.1f} times for the kernel"
    says = f"from {sizes[0]} to {sizes[-1]} states, cost goes with the samples and not with the monomials"
    holds = growth["kernel EDMD"] < growth["EDMD on monomials"] / 4
    return [judged("cost", says, holds=holds, why=why)]


def _timed(fit: Callable[[], LinearPredictor]) -> tuple[LinearPredictor, float]:
    start = perf_counter()
    model = fit()
    return model, perf_counter() - start


def _landmarks(page: Page) -> list[Claim]:
    train, test = _duffing(100, 20), _duffing(50, 20, seed=1)
    errors: list[float] = []
    for m in LANDMARKS:
        with unwarned():
            model = kernel_edmd(train, "gaussian", width=1.0, landmarks=m, ridge=1e-12)
        missed = np.concatenate([model.rollout(e.X[0], np.empty((10, 0)))[-1] - e.X[10] for e in test])
        errors.append(float(np.linalg.norm(missed) / np.linalg.norm([e.X[10] for e in test])))
    page.text("## Landmarks", "Relative error ten steps, 1 s, ahead on 50 episodes that were not fitted.")
    page.table(("landmarks", "error [%]"), [(m, percent(e)) for m, e in zip(LANDMARKS, errors, strict=True)])
    curve = np.array(errors)[:, None]
    drawn = {"Gaussian kernel": (np.array(LANDMARKS), 100 * curve[:, 0])}
    page.picture("landmarks", "Error after 1 s", plots([Plot("landmarks", "error [%]", drawn, log="y")]))
    page.curve("Error by landmarks, in the order of the table", 1.0, ("error",), {"Gaussian kernel": curve})
    says = "few landmarks of many samples suffice: the error falls with their number"
    why = f"from {percent(errors[0])} % at {LANDMARKS[0]} to {percent(errors[-1])} % at {LANDMARKS[-1]}"
    return [judged("Nyström", says, holds=errors[-1] < errors[0] / 10, in_part=errors[-1] < errors[0], why=why)]


kernel_paper = short("kernel", of_kernel.__doc__, of_kernel, largest=SIZES[-1])
