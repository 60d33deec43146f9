"""Scene: a plant, where it starts, and the feedback that drives it; its trajectory, and others from other starts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from koopmpc.bench.reproduce.plants import trajectories
from koopmpc.bench.reproduce.reconstruction import Reconstruction, rebuilt
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import Lifting
from koopmpc.plant.dynamics import Dynamics


@dataclass(frozen=True, eq=False)
class Scene:
    """One trajectory of one plant.

    Attributes
    ----------
    title
        Plant and data, in words.
    dynamics
        ẋ = f(x, u).
    x0
        Where the trajectory starts.
    spread
        Held-out trajectories start uniformly in x0 ± spread.
    K, x_ref
        u = −K (x − x_ref), continuous; none by default.
    held
        Hold u over a sample.
    dt, steps
        Sample time [s] and length.
    others
        How many held-out trajectories.
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
        """The one that is fitted."""
        return self._run(np.asarray([self.x0]))

    @cached_property
    def held_out(self) -> Episodes:
        """Those that are not; the same starts each time."""
        away = np.random.default_rng(0).uniform(-1.0, 1.0, (self.others, len(self.x0)))
        return self._run(np.asarray(self.x0) + away * np.asarray(self.spread))

    def rebuilt(self, liftings: Mapping[str, Lifting], rank: int) -> dict[tuple[str, bool], Reconstruction]:
        """Return each lifting's reconstruction, by its name and whether all singular values were kept.

        A lifting of `rank` observables has one of them alone: nothing is left out of it.
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
