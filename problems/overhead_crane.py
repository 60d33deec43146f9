"""Overhead crane: a load on a rope is carried over 3 m without a swing, by a trolley of bounded force.

A trolley of 5 kg and a load of 3 kg on a rope of 1.5 m, the load as a point mass and the rope taut: a textbook model,
as in H. Omar, "Control of gantry and tower cranes", PhD thesis, Virginia Tech (2003). Dry friction of the trolley
holds it where the drive is weak. φ = 0 hangs.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class Crane(km.Dynamics):
    """(M + m sin²φ) v̇ = u − f tanh(v/w) − c v + m sin φ (l ω² + g cos φ),  l ω̇ = −v̇ cos φ − g sin φ − b l ω."""

    states = ("position [m]", "velocity [m/s]", "swing [rad]", "rate [rad/s]")
    inputs = ("force [N]",)

    M: float = 5.0  # trolley [kg]
    m: float = 3.0  # load [kg]
    l: float = 1.5  # rope [m]  # noqa: E741
    f: float = 1.0  # dry friction [N]
    w: float = 0.1  # speed at which the trolley slips [m/s]
    c: float = 2.0  # rolling drag [N s/m]
    b: float = 0.05  # damping of the swing [1/s]
    g: float = 9.81  # gravity [m/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [v, v̇, ω, ω̇]."""
        v, swing, rate = x[1], x[2], x[3]
        S, C = ca.sin(swing), ca.cos(swing)
        force = u[0] - self.f * ca.tanh(v / self.w) - self.c * v + self.m * S * (self.l * rate**2 + self.g * C)
        push = force / (self.M + self.m * S**2)
        return ca.vertcat(v, push, rate, -(push * C + self.g * S) / self.l - self.b * rate)

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the rail, the trolley, the rope and the load, and the force as a bar of 1 m for 40 N."""
        at, swing = float(x[0]), float(x[2])
        load = (at + self.l * float(np.sin(swing)), -self.l * float(np.cos(swing)))
        return [
            km.scene.Line("rail", [(-1.0, 0.15), (4.5, 0.15)], width=0.05, color=(150, 160, 170)),
            km.scene.Box("trolley", (at, 0.0), (0.5, 0.2)),
            km.scene.Line("rope", [(at, 0.0), load], width=0.03, color=(120, 130, 150)),
            km.scene.Box("load", load, (0.35, 0.3), swing, color=(200, 90, 40)),
            km.scene.Line("force", [(at, 0.0), (at + float(u[0]) / 40, 0.0)], width=0.08, color=(40, 120, 200)),
        ]


crane, rest, there = Crane(), [0.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0]
t = 0.1 * np.arange(201)  # to and fro by 1 m
sway = np.column_stack([np.sin(0.6 * t), 0.6 * np.cos(0.6 * t), 0 * t, 0 * t])
box = km.Limits(u_min=-30.0, u_max=30.0)


def terms(x: ca.SX) -> list[ca.SX]:
    """Return the friction, and what turns with the swing."""
    return [ca.tanh(x[1] / 0.1), x[3] ** 2 * ca.sin(x[2]), x[3] * ca.cos(x[2])]


problem = km.Problem(
    dynamics=crane,
    dt=0.1,
    integrator=km.RK4(4),
    equilibrium=(rest, [0.0]),
    training=km.Training(
        x0=km.Uniform([-1.0, -1.5, -0.5, -1.0], [4.0, 1.5, 0.5, 1.0]),
        excitation=km.Noise(-30.0, 30.0, hold=3),
        episodes=300,
        steps=30,
    ),
    lifting=km.State()
    + km.Fourier(1, states="swing")
    + km.Expressions(terms, ["friction", "rate² sin(swing)", "rate cos(swing)"])
    + km.Constant(),
    cost=km.Cost(Q=[10.0, 1.0, 50.0, 5.0], R=0.01),
    limits=box,
    horizon=30,
    cases={
        "shift": km.Case(x0=rest, reference=there, steps=120),
        "catch": km.Case(x0=[0.0, 0.0, 0.6, 0.0], reference=rest, steps=120),
        "track": km.Case(x0=rest, reference=sway, steps=200),
        "beyond": km.Case(  # the place to reach lies 0.5 m behind the end of the rail
            x0=rest, reference=there, steps=120, limits=replace(box, x_max=np.array([2.5, np.inf, np.inf, np.inf]))
        ),
        "wrong": km.Case(x0=rest, reference=there, steps=120, plant=Crane(m=3.6, l=1.8, f=1.2)),
        "noise": km.Case(x0=rest, reference=there, steps=120, noise=[0.01, 0.02, 0.01, 0.02]),
        "delay": km.Case(x0=rest, reference=there, steps=120, faults=[km.faults.ActuatorDelay(1)]),
    },
    angles=(2,),
)
