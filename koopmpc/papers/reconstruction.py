"""A reconstruction: fit one trajectory, rebuild it from its first state, and predict held-out trajectories."""

import warnings
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import FitWarning
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.base import Lifting
from koopmpc.papers.plants import trajectories
from koopmpc.plants.dynamics import Dynamics
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.predict.spectrum import amplitudes, evolution_error, reconstruct
from koopmpc.values import Value

CUT = 1e-10  # "full rank" keeps the singular values above this share of the largest
LINEAR = 0.05  # relative error over a whole run below which an eigenfunction counts as one
_HUGE = 100.0  # a relative error beyond it has no digits worth reading
_STEADY = 1e-4  # an eigenfunction with |λ − 1| below it is a constant


@dataclass(frozen=True, eq=False)
class Reconstruction(Value):
    """The error of rebuilding a trajectory from its first state by z⁺ = A z, z = ψ(x): x(t) = Re Φ exp(Ωt) b.

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

    model: LinearPredictor
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


def rebuilt(trajectory: Episodes, lifting: Lifting, held_out: Episodes, rank: int | None = None) -> Reconstruction:
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
    with unwarned():
        model = edmd(trajectory, bound, rank=kept)
    X = reconstruction(model, episode)
    share = np.abs(amplitudes(model, episode.X[0])) * np.linalg.norm(model.modes, axis=0)
    values = model.eigenvalues
    moving = (np.abs(values - 1) > _STEADY) & (np.imag(values) >= 0)
    return Reconstruction(
        model=model,
        X=X,
        truth=episode.X,
        rank=kept,
        width=bound.nz,
        condition=float(s[0] / s[kept - 1]),
        error=relative(X, episode.X),
        held_out=float(np.median([relative(reconstruction(model, e), e.X) for e in held_out])),
        evolution=evolution_error(model, trajectory),
        leading=int(np.argmax(np.where(moving, share, -1.0))),
    )


def reconstruction(model: LinearPredictor, episode: Episode) -> Float[np.ndarray, "T1 nx"]:
    """Return x(t) = Re Φ exp(Ωt) b at the times of the episode, from its first state."""
    with np.errstate(over="ignore", invalid="ignore"):
        return reconstruct(model, episode.X[0], np.arange(len(episode.X)) * model.dt)


def relative(X: Float[np.ndarray, "T1 nx"], truth: Float[np.ndarray, "T1 nx"]) -> float:
    """Return ‖X − truth‖ / ‖truth‖ over all entries; inf where X left the finite numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.linalg.norm(X - truth) / np.linalg.norm(truth))
    return error if np.isfinite(error) else np.inf


def percent(error: float) -> str:
    """Return a relative error in %, with three digits; "diverges" where it is huge or not a number."""
    if not error < _HUGE:
        return "diverges"
    value = 100 * error
    return f"{value:.3g}" if value == 0 or value >= 1e-3 else f"{value:.1e}"


@contextmanager
def unwarned() -> Generator[None]:
    """Show no FitWarning, because the tables hold the rank, the condition and the warnings of each fit."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        yield


@dataclass(frozen=True, eq=False)
class Setting:
    """One trajectory of one plant, and others of it that are held out.

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
        Whether u is held over a sample; by default the feedback is continuous.
    dt, steps
        Sample time [s] and length of a trajectory.
    others
        Number of held-out trajectories.
    """

    title: str
    dynamics: Dynamics
    x0: Sequence[float]
    spread: Sequence[float]
    K: Float[np.ndarray, "nu nx"] | None = None
    x_ref: Sequence[float] | float = 0.0
    held: bool = False
    dt: float = 0.01
    steps: int = 1000
    others: int = 10

    @cached_property
    def trajectory(self) -> Episodes:
        """The trajectory that is fitted."""
        return self._run(np.asarray([self.x0]))

    @cached_property
    def held_out(self) -> Episodes:
        """The held-out trajectories, from the same starts each time."""
        away = np.random.default_rng(0).uniform(-1.0, 1.0, (self.others, len(self.x0)))
        return self._run(np.asarray(self.x0) + away * np.asarray(self.spread))

    def rebuilt(self, liftings: Mapping[str, Lifting], rank: int) -> dict[tuple[str, bool], Reconstruction]:
        """Return the reconstructions of each lifting by its name and by whether all singular values were kept.

        A lifting with no more than `rank` observables is fitted at full rank alone.
        """
        found: dict[tuple[str, bool], Reconstruction] = {}
        for name, lifting in liftings.items():
            for kept in (None, rank):
                fit = rebuilt(self.trajectory, lifting, self.held_out, kept)
                if kept is None or fit.width > rank:
                    found[name, kept is None] = fit
        return found

    def _run(self, starts: Float[np.ndarray, "E nx"]) -> Episodes:
        return trajectories(
            self.dynamics, starts, dt=self.dt, steps=self.steps, K=self.K, x_ref=self.x_ref, held=self.held
        )
