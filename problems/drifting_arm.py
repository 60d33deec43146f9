"""Drifting arm: a link whose payload grows by half while it follows steps and a sine.

A rigid link of 0.5 m moves in a vertical plane, θ = 0 hanging, with its mass at the end. In `drift` that mass is 1 kg
for a quarter of the run, then grows to 1.5 kg within a quarter, and stays; nobody is told. In `steady` it stays 1 kg.
"adaptive" learns on from each step, "offset-free" estimates a disturbance, "koopman-mpc" does neither.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

import koopmpc as km

DT, STEPS = 0.05, 400


@dataclass(frozen=True)
class Arm(km.Dynamics):
    """m L² θ̈ = −m g L sin θ − c θ̇ + u."""

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    m: float = 1.0  # mass at the end [kg]
    L: float = 0.5  # length [m]
    c: float = 0.2  # friction [N m s]
    g: float = 9.81  # gravity [m/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [ω, (u − c ω) / (m L²) − (g/L) sin θ]."""
        theta, omega = x[0], x[1]
        return ca.vertcat(omega, (u[0] - self.c * omega) / (self.m * self.L**2) - self.g / self.L * ca.sin(theta))

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the link, its joint and its payload."""
        theta = float(x[0])
        end = (self.L * float(np.sin(theta)), -self.L * float(np.cos(theta)))
        return [
            km.scene.Line("link", [(0.0, 0.0), end], width=0.03),
            km.scene.Disk("joint", (0.0, 0.0), 0.03, color=(70, 90, 110)),
            km.scene.Disk("payload", end, 0.06),
        ]


class Drifting:
    """The arm as a plant: step k is one of the mass `masses[k]`, rounded to 10 g; the last one stays."""

    dt, states, inputs, outputs = DT, Arm.states, Arm.inputs, Arm.states

    def __init__(self, masses: np.ndarray) -> None:
        levels, self._of = np.unique(np.round(masses, 2), return_inverse=True)
        self._maps = [km.discretize(Arm(m=float(m)), DT) for m in levels]
        self._x, self._k = np.zeros(2), 0

    @property
    def state(self) -> np.ndarray:
        """The true x."""
        return self._x

    def reset(self, x0: ArrayLike | None, rng: np.random.Generator | int) -> np.ndarray:
        """Begin at x0 with the first mass."""
        self._x, self._k = np.zeros(2) if x0 is None else np.array(x0, dtype=float), 0
        return self._x.copy()

    def step(self, u: ArrayLike) -> np.ndarray:
        """Go on by one step, and return the state."""
        last = len(self._of) - 1
        self._x = self._maps[int(self._of[min(self._k, last)])](self._x, u)
        self._k += 1
        return self._x.copy()


def growing(share: float) -> np.ndarray:
    """Return the mass at each step [kg]: it grows by `share` in the second quarter."""
    return 1.0 + share * np.clip(4 * np.arange(STEPS) / STEPS - 1, 0.0, 1.0)


def path() -> np.ndarray:
    """Return (STEPS + 1, 2) reference rows: the angle steps to and fro on a sine, then rests; no speed is asked for."""
    k = np.minimum(np.arange(STEPS + 1), STEPS - 60)
    return np.column_stack([np.sin(2 * np.pi * k / 130) + np.where(k % 100 < 50, 0.3, -0.3), 0.0 * k])


problem = km.Problem(
    dynamics=Arm(),
    dt=DT,
    equilibrium=([0.0, 0.0], [0.0]),
    training=km.Training(
        x0=km.Uniform([-1.5, -4.0], [1.5, 4.0]), excitation=km.Noise(-15.0, 15.0, hold=4), episodes=50, steps=50
    ),
    lifting=km.State() + km.Fourier(1, states=[0]) + km.Constant(),
    cost=km.Cost(Q=[100.0, 1.0], R=0.01),
    limits=km.Limits(u_min=-15.0, u_max=15.0),
    horizon=20,
    cases={
        "drift": km.Case(x0=[0.0, 0.0], reference=path(), steps=STEPS, plant=Drifting(growing(0.5))),
        "steady": km.Case(x0=[0.0, 0.0], reference=path(), steps=STEPS),
    },
    controllers=("koopman-mpc", "offset-free", "adaptive"),
    scene=Arm().scene,
)
