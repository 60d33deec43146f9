"""Settings for Snyder & Song (2021): trajectories, reconstructions, the paper's figures, and our control tasks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

import koopmpc as km
from koopmpc import papers

from ..plants import CartPole, Pendulum, design_feedback, design_printed_feedback, integrate_trajectories

RESOLVED = 1e-6  # smaller errors are rounding and differ from machine to machine
CUT = 1e-10  # "full rank" keeps the singular values above this share of the largest
LINEAR = 0.05  # an eigenfunction is accepted below this relative error over a whole run
_CONSTANT = 1e-4  # an eigenfunction with |λ − 1| below this is a constant
PENDULUM_WEIGHTS: tuple[list[float], float] = ([0.0, 10.0], 1.0)  # Q and R of the paper
CART_POLE_WEIGHTS: tuple[list[float], float] = ([5.0, 10.0, 0.0, 0.0], 1.0)
DATABOOK_WEIGHTS: tuple[list[float], float] = ([1.0, 1.0, 1.0, 1.0], 1e-4)  # Brunton & Kutz 2019, section 8.7
UP = (0.0, 0.0, np.pi, 0.0)
TARGET = (1.0, 0.0, np.pi, 0.0)

OBSERVABLES: dict[str, km.Lifting] = {
    "DMD": km.State(),
    "EDMD monomials 2": km.State() + km.Monomials(2) + km.Constant(),
    "EDMD monomials 3": km.State() + km.Monomials(3) + km.Constant(),
    "EDMD Fourier 1": km.State() + km.Fourier(1),
    "EDMD Fourier 2": km.State() + km.Fourier(2),
}


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Reconstruction of a trajectory from its first state by z⁺ = A z, z = ψ(x): x(t) = Re Φ exp(Ωt) b.

    Attributes
    ----------
    model
        The fit.
    X
        (T+1, nx), the reconstruction.
    truth
        (T+1, nx), the trajectory that it was fitted to.
    rank, width
        Number of singular values kept, and of observables in ψ.
    condition
        σ₁ / σ_rank of the unscaled snapshots ψ(x_k).
    error
        ‖X − truth‖ / ‖truth‖ in the Frobenius norm.
    held_out
        Median of the same error over held-out trajectories.
    evolution
        (rank,) ‖φ(x_k) − λᵏ φ(x₀)‖ / ‖φ‖ of each eigenfunction, on the fitted trajectory.
    leading
        Index of the eigenfunction with the largest share |b_j| ‖Φ_j‖ of the first state. Of a complex pair it is the
        one with Im λ > 0; constants are left out.
    """

    model: km.LinearPredictor
    X: Float[np.ndarray, "T1 nx"]
    truth: Float[np.ndarray, "T1 nx"]
    rank: int
    width: int
    condition: float
    error: float
    held_out: float
    evolution: Float[np.ndarray, " nz"]
    leading: int

    @property
    def linear(self) -> int:
        """Number of eigenfunctions whose error is below `LINEAR`."""
        return int(np.sum(self.evolution < LINEAR))


def fit_reconstruction(
    trajectory: km.Episodes, lifting: km.Lifting, held_out: km.Episodes, rank: int | None = None
) -> Reconstruction:
    """Fit ψ(x⁺) = A ψ(x) to one trajectory by truncated SVD of the unscaled snapshots, and rebuild it.

    Parameters
    ----------
    trajectory
        One episode without inputs.
    lifting
        ψ.
    held_out
        Trajectories of the same system from other starts.
    rank
        Number of singular values to keep; by default all above `CUT` times the largest.
    """
    (episode,) = trajectory
    bound = lifting.bind(trajectory.states)
    s = np.linalg.svd(bound(episode.X[:-1]), compute_uv=False)
    full = int(np.sum(s > CUT * s[0]))
    kept = full if rank is None else min(rank, full)
    with km.errors.hide_fit_warnings():
        model = km.edmd(trajectory, bound, rank=kept)
    X = predict_episode(model, episode)
    share = np.abs(km.spectrum.amplitudes(model, episode.X[0])) * np.linalg.norm(model.modes, axis=0)
    values = model.eigenvalues
    moving = (np.abs(values - 1) > _CONSTANT) & (np.imag(values) >= 0)
    return Reconstruction(
        model=model,
        X=X,
        truth=episode.X,
        rank=kept,
        width=bound.nz,
        condition=float(s[0] / s[kept - 1]),
        error=papers.relative_error(X, episode.X),
        held_out=float(np.median([papers.relative_error(predict_episode(model, e), e.X) for e in held_out])),
        evolution=km.spectrum.evolution_error(model, trajectory),
        leading=int(np.argmax(np.where(moving, share, -1.0))),
    )


def predict_episode(model: km.LinearPredictor, episode: km.Episode) -> Float[np.ndarray, "T1 nx"]:
    """Return x(t) = Re Φ exp(Ωt) b at the times of the episode, from its first state."""
    with np.errstate(over="ignore", invalid="ignore"):
        return km.spectrum.reconstruct(model, episode.X[0], np.arange(len(episode.X)) * model.dt)


@dataclass(frozen=True, eq=False)
class Setting:
    """One trajectory of one plant, and held-out trajectories of it.

    Attributes
    ----------
    title
        Plant and data in words.
    dynamics
        ẋ = f(x, u).
    x0
        Start of the trajectory.
    spread
        Held-out trajectories start uniformly in x0 ± spread.
    K, x_ref
        The feedback u = −K (x − x_ref); none by default.
    held
        True: u is constant over a sample. False: the feedback is continuous.
    dt, steps
        Sample time [s] and length of a trajectory.
    others
        Number of held-out trajectories.
    """

    title: str
    dynamics: km.Dynamics
    x0: Sequence[float]
    spread: Sequence[float]
    K: Float[np.ndarray, "nu nx"] | None = None
    x_ref: Sequence[float] | float = 0.0
    held: bool = False
    dt: float = 0.01
    steps: int = 1000
    others: int = 10

    @cached_property
    def trajectory(self) -> km.Episodes:
        """The trajectory that is fitted."""
        return self._run(np.asarray([self.x0]))

    @cached_property
    def held_out(self) -> km.Episodes:
        """The held-out trajectories; their starts are reproducible."""
        away = np.random.default_rng(0).uniform(-1.0, 1.0, (self.others, len(self.x0)))
        return self._run(np.asarray(self.x0) + away * np.asarray(self.spread))

    def _run(self, starts: Float[np.ndarray, "E nx"]) -> km.Episodes:
        return integrate_trajectories(
            self.dynamics, starts, dt=self.dt, steps=self.steps, K=self.K, x_ref=self.x_ref, held=self.held
        )


def reconstruct_all(setting: Setting) -> dict[tuple[str, bool], Reconstruction]:
    """Return the reconstructions with each of `OBSERVABLES`, by name and by whether all singular values were kept.

    The others keep as many singular values as there are states. Observables that are no more than the states have only
    a reconstruction at full rank.
    """
    fits: dict[tuple[str, bool], Reconstruction] = {}
    for name, lifting in OBSERVABLES.items():
        for rank in (None, setting.dynamics.nx):
            fit = fit_reconstruction(setting.trajectory, lifting, setting.held_out, rank)
            if rank is None or fit.width > rank:
                fits[name, rank is None] = fit
    return fits


Fits = Mapping[str, Mapping[tuple[str, bool], Reconstruction]]  # by setting, then as `reconstruct_all` returns them


def measure_hold_change(settings: Mapping[str, Setting], fits: Fits) -> float:
    """Return the largest relative change of an error above `RESOLVED` if the feedback is held over a sample."""
    changes: list[float] = []
    for name in ("pendulum-lqr", "cart-pole-lqr"):
        held = reconstruct_all(replace(settings[name], held=True, others=1))
        changes += [abs(held[key].error / fit.error - 1) for key, fit in fits[name].items() if fit.error > RESOLVED]
    return max(changes)


def centre_episodes(episodes: km.Episodes, x_ref: ArrayLike) -> km.Episodes:
    """Return the episodes in the coordinates x − x_ref."""
    target = np.broadcast_to(np.asarray(x_ref, dtype=float), (episodes.nx,))
    return episodes.with_episodes([km.Episode(X=e.X - target, U=e.U, W=e.W) for e in episodes])


@dataclass(frozen=True)
class PaperFigure:
    """One figure of the paper: its name, the observables, the settings side by side, and the paper's statements.

    `says` holds one statement, in our words, for each setting.
    """

    name: str
    method: str
    settings: tuple[str, ...]
    says: tuple[str, ...]
    appendix: bool = False


_BOTH = ("pendulum", "pendulum-lqr")
FIGURES = (
    PaperFigure("pendulum-dmd", "DMD", _BOTH, ("small error",) * 2),
    PaperFigure("pendulum-monomials-2", "EDMD monomials 2", _BOTH, ("no change against DMD", "a marginal gain on DMD")),
    PaperFigure("pendulum-monomials-3", "EDMD monomials 3", _BOTH, ("better, without truncation",) * 2),
    PaperFigure("pendulum-fourier-1", "EDMD Fourier 1", _BOTH, ("better",) * 2),
    PaperFigure("pendulum-fourier-2", "EDMD Fourier 2", _BOTH, ("no gain on Fourier 1",) * 2),
    PaperFigure("cart-pole-dmd", "DMD", ("cart-pole", "cart-pole-lqr"), ("fails", "partly captured")),
    PaperFigure("cart-pole-monomials-2", "EDMD monomials 2", ("cart-pole-lqr",), ("no gain on DMD",)),
    PaperFigure("cart-pole-fourier-1", "EDMD Fourier 1", ("cart-pole-lqr",), ("no gain on DMD",)),
    PaperFigure(
        "appendix-cart-pole-monomials-2", "EDMD monomials 2", ("cart-pole",), ("no gain on DMD",), appendix=True
    ),
    PaperFigure("appendix-cart-pole-fourier-1", "EDMD Fourier 1", ("cart-pole",), ("no gain on DMD",), appendix=True),
)
VARIANTS = ("upright", "upright-lqr", "cart-pole-g10", "databook", "databook-legacy")


def all_settings(others: int = 10) -> dict[str, Setting]:
    """Return every trajectory that is fitted, by name, with `others` held-out trajectories beside each."""
    pendulum, upright = Pendulum(), Pendulum(upright=True)
    cart_pole, databook = CartPole(), CartPole(g=10.0, d=1.0)
    start, swing = (np.pi / 4, 0.0), (np.pi / 6, 0.5)
    off, tilt = (-1.0, 0.0, np.pi + 0.1, 0.0), (0.5, 0.2, 0.1, 0.1)
    shift, near = (-1.0, 0.0, np.pi, 0.0), (1.0, 0.2, 0.02, 0.02)
    K = design_feedbacks()
    found = {
        "pendulum": Setting("Pendulum, hanging, uncontrolled", pendulum, start, swing),
        "pendulum-lqr": Setting("Pendulum, hanging, LQR", pendulum, start, swing, K["pendulum"]),
        "upright": Setting("Pendulum, upright, uncontrolled", upright, start, swing),
        "upright-lqr": Setting("Pendulum, upright, LQR", upright, start, swing, K["upright"]),
        "cart-pole": Setting("Cart-pole, uncontrolled", cart_pole, off, tilt),
        "cart-pole-lqr": Setting("Cart-pole, LQR", cart_pole, shift, near, K["cart-pole"], TARGET),
        "cart-pole-g10": Setting("Cart-pole, LQR, g = 10", CartPole(g=10.0), shift, near, K["cart-pole-g10"], TARGET),
        "databook": Setting("Databook's cart-pole, LQR", databook, off, tilt, K["databook"], TARGET),
        "databook-legacy": Setting(
            "Databook's cart-pole, LQR as printed (legacy)", databook, off, tilt, K["databook-legacy"], TARGET
        ),
    }
    return {name: replace(setting, others=others) for name, setting in found.items()}


def design_feedbacks() -> dict[str, np.ndarray]:
    """Return K of each feedback by the name of its setting without "-lqr"."""
    databook = CartPole(g=10.0, d=1.0)
    return {
        "pendulum": design_feedback(Pendulum(), [0.0, 0.0], *PENDULUM_WEIGHTS).K,
        "upright": design_feedback(Pendulum(upright=True), [0.0, 0.0], *PENDULUM_WEIGHTS).K,
        "cart-pole": design_feedback(CartPole(), UP, *CART_POLE_WEIGHTS).K,
        "cart-pole-g10": design_feedback(CartPole(g=10.0), UP, *CART_POLE_WEIGHTS).K,
        "databook": design_feedback(databook, UP, *DATABOOK_WEIGHTS).K,
        "databook-legacy": design_printed_feedback(databook, *DATABOOK_WEIGHTS).K,
    }


@dataclass(frozen=True)
class Excitement:
    """Settings to collect data: episodes start in x ± spread, and uniform noise of ± `noise` is added to u."""

    spread: Sequence[float]
    noise: float


SHAKINGS: Mapping[str, Excitement] = {
    "pendulum": Excitement((1.0, 1.0), 4.0),
    "cart-pole": Excitement((1.0, 0.5, 0.1, 0.1), 10.0),
}


@dataclass(frozen=True)
class ControlTask:
    """The task of a controller, and the excitation of the plant for the data of its model.

    Attributes
    ----------
    dynamics, x_eq
        The plant and its equilibrium.
    K
        Name of the feedback that stabilises the plant while data are collected; None for a stable plant.
    shaking
        Excitation of the data about x_eq.
    cost, limit
        The paper's weights, and the bound on |u| in the runs with limits, which is below the largest |u| of LQR.
    x0, reference
        Start and target of the run.
    """

    dynamics: km.Dynamics
    x_eq: Sequence[float]
    K: str | None
    shaking: Excitement
    cost: km.Cost
    limit: float
    x0: Sequence[float]
    reference: Sequence[float]


_PENDULUM_COST = km.Cost(*PENDULUM_WEIGHTS)
_CART_POLE_COST = km.Cost(*CART_POLE_WEIGHTS)
_REST = (0.0, 0.0)
_START = (np.pi / 4, 0.0)
_SHIFTED = (-1.0, 0.0, np.pi, 0.0)
_LEANING = (0.0, 0.0, np.pi + 0.3, 0.0)
TASKS: Mapping[str, ControlTask] = {
    "pendulum, hanging, π/4": ControlTask(
        Pendulum(), _REST, None, Excitement((1.2, 2.0), 4.0), _PENDULUM_COST, 2.0, _START, _REST
    ),
    "pendulum, upright, π/4": ControlTask(
        Pendulum(upright=True), _REST, "upright", Excitement((1.0, 1.0), 10.0), _PENDULUM_COST, 20.0, _START, _REST
    ),
    "cart-pole, 2 m shift": ControlTask(
        CartPole(), UP, "cart-pole", Excitement((2.0, 1.0, 0.1, 0.1), 5.0), _CART_POLE_COST, 3.0, _SHIFTED, TARGET
    ),
    "cart-pole, 0.3 rad off": ControlTask(
        CartPole(), UP, "cart-pole", Excitement((2.0, 1.0, 0.4, 0.4), 10.0), _CART_POLE_COST, 40.0, _LEANING, UP
    ),
}
