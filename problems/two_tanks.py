"""Two tanks: a pump fills the upper one, which drains into the lower one, whose level is to be set.

Two of the four tanks of K. Johansson, "The quadruple-tank process", IEEE Trans. Control Systems Technology 8 (2000),
one above the other, with his areas. Outflow by Torricelli's law, √(2 g h), which has no slope at an empty tank. Neither
tank may flow over at 20 cm, and the pump cannot suck.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

import koopmpc as km


def root(level: ca.SX) -> ca.SX:
    """Return √h, but for the last 0.1 mm, where the outflow is laminar: a root without slope stops every solver."""
    return level / (level**2 + 1e-4) ** 0.25


@dataclass(frozen=True)
class Tanks(km.Dynamics):
    """A₁ ḣ₁ = k u − a₁ √(2 g h₁),  A₂ ḣ₂ = a₁ √(2 g h₁) − a₂ √(2 g h₂)."""

    states = ("upper [cm]", "lower [cm]")
    inputs = ("pump [V]",)

    A1: float = 28.0  # ground of the upper tank [cm²]
    A2: float = 32.0  # of the lower one [cm²]
    a1: float = 0.071  # outlet of the upper tank [cm²]
    a2: float = 0.057  # of the lower one [cm²]
    k: float = 3.33  # flow of the pump [cm³/(s V)]
    g: float = 981.0  # gravity [cm/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [ḣ₁, ḣ₂]."""
        speed = (2 * self.g) ** 0.5
        upper, lower = self.a1 * speed * root(x[0]), self.a2 * speed * root(x[1])
        rising: ca.SX = (self.k * u[0] - upper) / self.A1
        return ca.vertcat(rising, (upper - lower) / self.A2)

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw both tanks, 20 cm high and 6 wide, their water, and the jet of the pump, as wide as its flow."""
        shapes: list[km.scene.Shape] = []
        for name, level, foot in (("upper", float(x[0]), 26.0), ("lower", float(x[1]), 0.0)):
            wall = [(-3.0, foot + 20.0), (-3.0, foot), (3.0, foot), (3.0, foot + 20.0)]
            full = float(np.clip(level, 0.01, 25.0))
            water = km.scene.Box(f"{name}_water", (0.0, foot + full / 2), (5.6, full), color=(40, 120, 200))
            shapes += [water, km.scene.Line(f"{name}_wall", wall, width=0.3)]
        jet = max(float(u[0]), 0.0) / 10.0 + 0.01
        return [*shapes, km.scene.Line("jet", [(-1.5, 50.0), (-1.5, 46.0)], width=jet, color=(40, 120, 200))]


def held(tanks: Tanks, lower: float) -> tuple[list[float], list[float]]:
    """Return the levels and the voltage that hold the lower level."""
    flow = tanks.a2 * np.sqrt(2 * tanks.g * lower)
    return [float((tanks.a2 / tanks.a1) ** 2 * lower), lower], [float(flow / tanks.k)]  # to a thousandth


def roots(x: ca.SX) -> list[ca.SX]:
    """Return the square roots of both levels, on which the outflows are linear."""
    return [root(x[0]), root(x[1])]


tanks = Tanks()
box = km.Limits(u_min=0.0, u_max=8.0, x_min=0.0, x_max=[20.0, 20.0])
low = held(tanks, 3.0)[0]
steps = np.where(np.arange(201) < 100, 12.0, 6.0)[:, None]
wave = (10.0 + 4.0 * np.sin(2 * np.pi * np.arange(301) / 150))[:, None]
leak = replace(tanks, a2=1.2 * tanks.a2, k=0.8 * tanks.k)


problem = km.Problem(
    dynamics=tanks,
    dt=4.0,
    integrator=km.RK4(4),
    equilibrium=held(tanks, 10.0),
    training=km.Training(
        x0=km.Uniform([1.0, 1.0], [20.0, 20.0]), excitation=km.Noise(0.0, 8.0, hold=4), episodes=300, steps=25
    ),
    lifting=km.State() + km.Expressions(roots, ["√upper", "√lower"]) + km.Monomials(2) + km.Constant(),
    cost=km.Cost(Q=1.0, R=0.1, of=km.State("lower")),
    limits=box,
    horizon=25,
    cases={
        "fill": km.Case(x0=low, reference=[12.0], steps=120),
        "steps": km.Case(x0=low, reference=steps, steps=200),
        "track": km.Case(x0=held(tanks, 10.0)[0], reference=wave, steps=300),
        "beyond": km.Case(x0=low, reference=[24.0], steps=150),  # the tank flows over at 20 cm
        "wrong": km.Case(x0=low, reference=[12.0], steps=150, plant=leak),
        "noise": km.Case(x0=low, reference=[12.0], steps=120, noise=[0.1, 0.1]),
        "delay": km.Case(x0=low, reference=[12.0], steps=120, faults=[km.faults.ActuatorDelay(1)]),
    },
)
