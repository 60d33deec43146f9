"""Theory of Snyder & Song (2021): equations, eigenvalues, the failure on the cart-pole, and a caution they cite."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Complex, Float

import koopmpc as km
from koopmpc import papers

from ..plants import Pendulum, swing_frequency
from .settings import (
    LINEAR,
    OBSERVABLES,
    TARGET,
    Fits,
    Reconstruction,
    Setting,
    centre_episodes,
    fit_reconstruction,
    predict_episode,
)

percent = papers.percent

CAUSES = """\
Under LQR the state settles at (1, 0, π, 0). Its motion about that point has four eigenvalues of its own, and
staying away from the origin takes a fifth, λ = 1: one more than DMD on four states has, and one more than rank 4
keeps of any lifting. Rank 5 does little better, for a truncated SVD keeps the directions of largest variance,
which are not those of the motion. With the origin at the target, or a constant among the observables, DMD is
right; with all singular values kept, EDMD is. No fault of Koopman theory is needed to explain what happens under
LQR."""

FREQUENCY = """\
√(g/L) = {small:.5f} rad/s for small angles; {right:.5f} rad/s at an amplitude of π/4, by the complete elliptic
integral. A fit of one trajectory finds the frequency of its amplitude. On a larger or smaller swing that is
wrong, which is what the held-out error shows."""

EQUATIONS = """\
Each is one public function. The last column is its relative distance to the formula written out in NumPy, on
the pendulum's trajectory with Fourier observables of first order, reduced to rank {rank} of {width}; numbers as in
the paper."""

SIDES = """\
*Left against right.* Θ⁺Θ′ is the transpose of A_Y: the ξ of eigenfunctions are left eigenvectors of A_Y, and
its right eigenvectors are the modes. φ = Θ ξ misses λ φ(x_k) = φ(x_{{k+1}}) by {left} % a step (median,
monomials 3); the same formula with right eigenvectors by {right} %."""

CAUTION = """\
E. Gonzalez, M. Abudia, M. Jury, R. Kamalapurkar and J. Rosenfeld, *Anti-Koopmanism*, 2021, which the paper
cites: a lifted linear model may rebuild a trajectory and yet miss the system. Its check: each method at full
rank, the error over the first part of the run, of the trajectory that was fitted and, after the stroke, the
median over {others} trajectories from unseen starts, both predicted from their first state alone. Where the
second is many times the first, what was found is the trajectory."""

HORIZONS = (0.1, 0.5, 1.0, 2.0, 5.0, 10.0)  # [s]


@dataclass(frozen=True)
class Equation:
    """One equation: its number in the paper, the formula, the function, and the relative distance of their values."""

    number: str
    formula: str
    function: str
    residual: float


def check_equations(trajectory: km.Episodes, lifting: km.Lifting, rank: int) -> list[Equation]:
    """Compute each equation of the paper on one trajectory by our function and by its formula in NumPy.

    Parameters
    ----------
    trajectory
        One episode without inputs.
    lifting
        Θ; the snapshots Y are its observables. With `State()` Y is X.
    rank
        r of the truncated SVD.
    """
    (episode,) = trajectory
    bound = lifting.bind(trajectory.states)
    snapshots = trajectory.snapshots()
    Y, Y_next = bound(snapshots.X).T, bound(snapshots.X_next).T  # columns, as the paper has them
    whole, reduced = km.edmd(trajectory, bound), km.edmd(trajectory, bound, rank=rank)
    assert isinstance(reduced.lifting, km.spectrum.Projected)
    assert reduced.exact_modes is not None
    U, s, Vt = np.linalg.svd(Y, full_matrices=False)
    forward = Y_next @ Vt[:rank].T / s[:rank]  # Y′ V Σ⁻¹
    A = forward @ U[:, :rank].T
    basis, modes, values = reduced.lifting.basis, reduced.exact_modes, reduced.eigenvalues
    W = reduced.eigenvectors
    t = np.arange(len(episode.X)) * trajectory.dt
    b = km.spectrum.amplitudes(reduced, episode.X[0])
    exponents = np.exp(km.spectrum.continuous_eigenvalues(reduced) * t[:, None])
    ahead = np.real((exponents * b) @ reduced.modes.T)
    Theta, Theta_next = Y.T, Y_next.T
    phi = whole.eigenfunctions(snapshots.X)
    xi = whole.left_eigenvectors.T  # ξ_j in column j, φ_j = Θ ξ_j
    K = np.linalg.pinv(Theta) @ Theta_next
    worst = km.spectrum.linearity_error(whole, trajectory)
    missed = whole.eigenfunctions(snapshots.X_next) - phi * whole.eigenvalues
    by_hand = np.linalg.norm(missed, axis=0) / np.linalg.norm(phi, axis=0)
    return [
        Equation("10–12", "X = [x₁ … x_m], X′ = [x₂ … x_{m+1}]", "Episodes.snapshots",
                 _gap(snapshots.X_next[:-1], snapshots.X[1:])),
        Equation("14–17", "A = X′X⁺, X = U Σ Vᵀ", "dmd, edmd", _gap(whole.A, Y_next @ np.linalg.pinv(Y))),
        Equation("18–23", "Ã = Uᵀ X′ V Σ⁻¹", "dmd(rank=r).A, edmd(rank=r).A", _gap(reduced.A, basis.T @ A @ basis)),
        Equation("18–23", "Ã W = W Λ", "LinearPredictor.eigenvalues, eigenvectors", _gap(reduced.A @ W, W * values)),
        Equation("18–23", "Φ = X′ V Σ⁻¹ W, A Φ = Φ Λ", "LinearPredictor.exact_modes, modes",
                 _gap(A @ modes, modes * values)),
        Equation("18–23", "b = Φ⁺ x₁", "amplitudes", _gap(b, np.linalg.pinv(modes) @ bound(episode.X[0]))),
        Equation("18–23", "x(t) = Φ exp(Ω t) b, Ω = ln Λ / Δt", "continuous_eigenvalues, reconstruct",
                 _gap(km.spectrum.reconstruct(reduced, episode.X[0], t), ahead)),
        Equation("24–26", "y = Θᵀ(x), A_Y = Y′ Y⁺", "Lifting, edmd", _gap(whole.A @ Y, Y_next @ np.linalg.pinv(Y) @ Y)),
        Equation("27–31", "φ(x) = Θ(x) ξ", "LinearPredictor.eigenfunctions", _gap(phi, Theta @ xi)),
        Equation("27–31", "λ φ(x_k) = φ(x_{k+1})", "linearity_error", _gap(worst, by_hand)),
        Equation("27–31", "λ ξ = Θ⁺ Θ′ ξ", "LinearPredictor.left_eigenvectors", _gap(K @ xi, xi * whole.eigenvalues)),
    ]  # fmt: skip


def compare_sides(trajectory: km.Episodes, lifting: km.Lifting) -> tuple[float, float]:
    """Return the medians of ‖φ(x⁺) − λ φ(x)‖ / ‖φ(x)‖ for φ = ξᴴψ with left and for φ = vᵀψ with right eigenvectors.

    Θ⁺Θ′ is Aᵀ, so its right eigenvectors are the left eigenvectors of A. The right eigenvectors of A are the modes;
    they define no eigenfunctions.
    """
    model = km.edmd(trajectory, lifting)
    snapshots = trajectory.snapshots()
    Z, Z_next = model.lift(snapshots.X), model.lift(snapshots.X_next)
    left = _median_linearity(Z, Z_next, model.left_eigenvectors.T, model.eigenvalues)
    return left, _median_linearity(Z, Z_next, model.eigenvectors, model.eigenvalues)


def add_frequencies(page: papers.Page, fits: Fits) -> None:
    """Add the eigenvalues of the pendulum's fits beside the exact frequencies."""
    plant = Pendulum()
    small, right = swing_frequency(plant, 0.0), swing_frequency(plant, np.pi / 4)
    page.text("## The frequency of the pendulum", FREQUENCY.format(small=small, right=right))
    rows: list[tuple[object, ...]] = []
    for method in OBSERVABLES:
        fit = fits["pendulum"][method, True]
        size = abs(fit.model.eigenvalues[fit.leading])
        turn = abs(km.spectrum.continuous_eigenvalues(fit.model)[fit.leading].imag)
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
        ("observables", "|λ| of the leading φ", "frequency [rad/s]", "off √(g/L) [%]", "off that at π/4 [%]"), rows
    )


def add_equations(page: papers.Page, setting: Setting, fits: Fits) -> None:
    """Add each equation with the function that computes it, and a picture of the leading eigenfunction."""
    lifting = OBSERVABLES["EDMD Fourier 1"]
    width, rank = lifting.bind(setting.dynamics.states).nz, 4
    page.text("## The equations", EQUATIONS.format(rank=rank, width=width))
    page.table(
        ("equations", "formula", "function", "distance"),
        [
            (e.number, e.formula, f"`{e.function}`", "0" if e.residual == 0 else f"{e.residual:.0e}")
            for e in check_equations(setting.trajectory, lifting, rank)
        ],
    )
    left, right = compare_sides(setting.trajectory, OBSERVABLES["EDMD monomials 3"])
    page.text(SIDES.format(left=percent(left), right=percent(right)))
    fit = fits["pendulum"]["EDMD monomials 3", True]
    made = km.plot.eigenfunction_maps(fit.model, fit.leading, (0, 1), ((-1.0, 1.0), (-2.0, 2.0)))
    page.picture(
        "pendulum-eigenfunctions", "Pendulum, monomials 3: the leading eigenfunction", partial(km.plot.save, made)
    )


def causes(setting: Setting) -> dict[str, Reconstruction]:
    """Return fits of the cart-pole under LQR: origin at zero or at the target, with or without a constant."""
    squares = OBSERVABLES["EDMD monomials 2"]
    cases = {
        "DMD": (km.State(), False, None),
        "DMD with a constant": (km.State() + km.Constant(), False, None),
        "DMD on x − x_ref": (km.State(), True, None),
        "EDMD monomials 2, rank 4": (squares, False, 4),
        "EDMD monomials 2, rank 5": (squares, False, 5),
        "EDMD monomials 2": (squares, False, None),
        "EDMD monomials 2 on x − x_ref": (squares, True, None),
    }
    found: dict[str, Reconstruction] = {}
    for name, (lifting, moved, rank) in cases.items():
        data = [centre_episodes(each, TARGET) if moved else each for each in (setting.trajectory, setting.held_out)]
        found[name] = fit_reconstruction(data[0], lifting, data[1], rank)
    return found


def add_failure(page: papers.Page, setting: Setting, found: Mapping[str, Reconstruction]) -> None:
    """Add the effects of the origin of the coordinates and of the truncation on the fit of the cart-pole under LQR."""
    page.text("## Why the cart-pole failed", CAUSES)
    truth = setting.trajectory[0].X
    size, motion = float(np.linalg.norm(truth)), float(np.linalg.norm(truth - TARGET))
    rows: list[tuple[object, ...]] = []
    for name, fit in found.items():
        gap = float(np.linalg.norm(fit.X - fit.truth))
        rows.append(
            (
                name,
                f"{fit.rank} of {fit.width}",
                f"{fit.condition:.1e}",
                percent(gap / size),
                percent(gap / motion),
            )
        )
    page.table(("model", "rank", "σ₁/σ_r", "error, of ‖x‖ [%]", "of ‖x − x_ref‖ [%]"), rows)
    curves = {
        name: found[name].X + (np.asarray(TARGET) if "x_ref" in name else 0.0)
        for name in ("DMD", "DMD with a constant", "DMD on x − x_ref", "EDMD monomials 2")
    }
    made = km.plot.reconstruction({setting.title: (truth, curves)}, setting.dt, setting.dynamics.states)
    page.picture("why-cart-pole", "Cart-pole under LQR: origin and truncation", partial(km.plot.save, made))
    page.curve("why cart-pole", setting.dt, setting.dynamics.states, {"truth": truth, **curves})


def add_caution(page: papers.Page, settings: Mapping[str, Setting], fits: Fits) -> list[papers.Claim]:
    """Add errors of reconstruction and of prediction from unseen starts by horizon, and return the claim."""
    plants = ("pendulum", "pendulum-lqr", "cart-pole", "cart-pole-lqr")
    errors = {
        (name, method): measure_by_horizon(settings[name], fits[name][method, True], HORIZONS)
        for name in plants
        for method in OBSERVABLES
    }
    page.text("## A caution: reconstruction is not prediction", CAUTION.format(others=settings["pendulum"].others))
    page.table(
        ("data", "observables", *(f"{h:g} s [%]" for h in HORIZONS)),
        [
            (
                settings[name].title,
                method,
                *(f"{percent(own)} / {percent(new)}" for own, new in each),
            )
            for (name, method), each in errors.items()
        ],
    )
    best = min(OBSERVABLES, key=lambda method: errors["cart-pole", method][-1][1])
    missed = [each for each in errors.values() if each[-1][0] < LINEAR and each[-1][1] > 10 * max(each[-1][0], 1e-3)]
    drawn = [
        papers.CurvePanel(
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
    page.picture(
        "caution",
        "Reconstruction and prediction from unseen starts",
        partial(km.plot.save, papers.draw_panels(drawn)),
    )
    return [
        papers.judge_claim(
            "Gonzalez et al. 2021",
            "a model may rebuild a trajectory and miss the system",
            holds=bool(missed),
            why=f"{len(missed)} of {len(errors)} fits rebuild 10 s within {percent(LINEAR)} % and miss unseen starts by"
            f" ten times that or more; on the free cart-pole the best for unseen starts is {best} with"
            f" {percent(errors['cart-pole', best][-1][1])} %",
        )
    ]


def measure_by_horizon(setting: Setting, fit: Reconstruction, horizons: Sequence[float]) -> list[tuple[float, float]]:
    """Return the relative errors over the first h seconds: of the fitted trajectory, and the median of the held-out."""

    def errors(data: km.Episodes) -> np.ndarray:
        pairs = [(predict_episode(fit.model, e), e.X) for e in data]
        ends = [round(h / setting.dt) + 1 for h in horizons]
        return np.array([[papers.relative_error(X[:end], truth[:end]) for end in ends] for X, truth in pairs])

    own, new = errors(setting.trajectory)[0], np.median(errors(setting.held_out), axis=0)
    return [(float(a), float(b)) for a, b in zip(own, new, strict=True)]


def _median_linearity(
    Z: Float[np.ndarray, "M nz"],
    Z_next: Float[np.ndarray, "M nz"],
    V: Complex[np.ndarray, "nz nz"],
    values: Complex[np.ndarray, " nz"],
) -> float:
    phi = Z @ V
    return float(np.median(np.linalg.norm(Z_next @ V - phi * values, axis=0) / np.linalg.norm(phi, axis=0)))


def _gap(a: np.ndarray, b: np.ndarray) -> float:
    """Return ‖a − b‖ / ‖b‖."""
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
