"""What an excitation is.

It is started once an episode: `start(steps, dt, rng)` draws all that is random and returns the policy
u_k = policy(k, y). One that does not look at y also gives its whole `sequence` at once.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from koopmpc.values import Value

Policy = Callable[[int, Float[np.ndarray, " ny"]], Float[np.ndarray, " nu"]]


class Excitation(Value, ABC):
    """A frozen description of inputs, with `nu` of them."""

    @property
    @abstractmethod
    def nu(self) -> int:
        """Number of inputs."""

    @abstractmethod
    def start(self, steps: int, dt: float, rng: np.random.Generator) -> Policy:
        """Return the policy u_k = policy(k, y) of one episode of `steps` steps of dt [s]."""


class OpenLoop(Excitation):
    """An excitation that does not look at y."""

    @abstractmethod
    def sequence(self, steps: int, dt: float, rng: np.random.Generator) -> Float[np.ndarray, "steps nu"]:
        """Return all inputs of one episode, (steps, nu)."""

    def start(self, steps: int, dt: float, rng: np.random.Generator) -> Policy:
        """Return the policy that reads out the sequence."""
        U = self.sequence(steps, dt, rng)
        return lambda k, _: U[k]
