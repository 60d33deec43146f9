"""Neurons: tanh(w·x + b) as observables, for dry friction, diodes, valves and sensors at their limits."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import ShapeError
from koopmpc.base.values import checksum, freeze
from koopmpc.lifting.base import Lifting, StateChoice, find_states, freeze_choice


@dataclass(frozen=True, eq=False, init=False)
class Neurons(Lifting):
    """ψᵢ(x) = tanh(wᵢ·x + bᵢ): near 0 a straight line, far away ±1.

    Dry friction is tanh(v / width) of a velocity, or of a difference of two past rows. Two neurons hold a dead zone.

    Parameters
    ----------
    weights
        (q, n + 1), a row [wᵢ, bᵢ] for each neuron; wᵢ per unit of the states.
    states
        The n states that w multiplies, by index or name; all by default.

    Raises
    ------
    ShapeError
        When it is bound: a row has another number of entries than there are chosen states, plus one.

    Examples
    --------
    >>> import koopmpc as km
    >>> from koopmpc.lifting import Neurons
    >>> friction = Neurons([[100.0, 0.0]], states="v [m/s]").bind(["p [m]", "v [m/s]"])
    >>> [round(float(z), 3) for z in friction([[5.0, -1.0], [5.0, 0.0], [5.0, 0.001]]).ravel()]
    [-1.0, 0.0, 0.1]
    """

    tunable: ClassVar[Mapping[str, str]] = {"weights": "real"}
    weights: Float[np.ndarray, "q n1"]
    states: StateChoice | None

    def __init__(
        self, weights: ArrayLike, states: StateChoice | None = None, *, bound: tuple[str, ...] | None = None
    ) -> None:
        freeze(self, weights=checks.array(weights, "weights", (None, None)), states=freeze_choice(states), bound=bound)

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"tanh 1|89ab12cd"``, with a checksum of the weights: a name fixes the function."""
        columns = find_states(self.states, states, "Neurons")
        if len(columns) + 1 != self.weights.shape[1]:
            raise ShapeError(
                f"a row of weights has {self.weights.shape[1]} entries for {len(columns)} states "
                f"({', '.join(states[i] for i in columns)}); pass one for each state and an offset"
            )
        return tuple(f"tanh {i}|{checksum(row.tobytes(), bytes(columns)):08x}" for i, row in enumerate(self.weights, 1))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return tanh(w·x + b) of each neuron."""
        columns = find_states(self.states, self.bound_states, "Neurons")
        return ca.tanh(ca.DM(self.weights[:, :-1]) @ x[columns] + ca.DM(self.weights[:, -1]))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        columns = find_states(self.states, self.bound_states, "Neurons")
        Z[:] = (self.weights[:, :-1] @ x[columns]).T
        Z += self.weights[:, -1]
        np.tanh(Z, out=Z)
