"""Run: everything that happened in one closed loop."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.move import Fallback, Status
from koopmpc.values import Value


@dataclass(frozen=True, eq=False)
class Plans(Value):
    """The plan of every step: X (T, N+1, nx), U (T, N, nu); NaN where a step had none."""

    X: Float[np.ndarray, "T N1 nx"]
    U: Float[np.ndarray, "T N nu"]


@dataclass(frozen=True, eq=False)
class Run(Value):
    """A closed loop of T steps of dt seconds, complete: `metrics` and the log need nothing else.

    Attributes
    ----------
    X
        (T+1, nx) true states, NaN where the plant hides them.
    Y
        (T+1, ny) measurements as the controller got them, noise and faults included.
    U
        (T, nu) inputs as applied.
    reference
        (T+1, nr) row k belongs to x_k.
    status, fallback
        T entries each.
    solve_time
        (T,) wall-clock time of each step [s].
    iterations
        (T,) solver iterations of each step.
    plans
        The plan of each step, where asked for.
    cost, limits
        What the run is judged by.
    slack
        (T,) how far the plan of each step breaks the soft limit that gives way most, in its own unit.
    u_reference
        (T, nu) inputs whose distance from U costs: what holds the reference; zeros by default.
    dt
        Sampling time [s].
    states, inputs, outputs
        Names with units.
    angles
        Indices of states whose errors wrap at ±π.
    metadata
        Names, numbers and lists: problem, controller, case, seeds, versions.
    """

    X: Float[np.ndarray, "T1 nx"]
    Y: Float[np.ndarray, "T1 ny"]
    U: Float[np.ndarray, "T nu"]
    reference: Float[np.ndarray, "T1 nr"]
    status: tuple[Status, ...]
    fallback: tuple[Fallback, ...]
    solve_time: Float[np.ndarray, " T"]
    iterations: Int[np.ndarray, " T"]
    cost: Cost | None
    limits: Limits | None
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    plans: Plans | None = None
    angles: tuple[int, ...] = ()
    metadata: Mapping[str, Any] = field(default_factory=dict[str, Any])
    u_reference: Float[np.ndarray, "T nu"] = field(default_factory=lambda: np.empty((0, 0)))
    slack: Float[np.ndarray, " Ts"] = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if not self.u_reference.size:
            object.__setattr__(self, "u_reference", np.zeros(self.U.shape))
        if not self.slack.size:
            object.__setattr__(self, "slack", np.zeros(len(self.U)))

    @property
    def steps(self) -> int:
        """Number of steps T."""
        return len(self.U)

    @property
    def time(self) -> Float[np.ndarray, " T1"]:
        """Time of every state [s]."""
        return np.arange(len(self.X)) * self.dt
