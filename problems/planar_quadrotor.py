"""Planar quadrotor: two propellers carry a drone over 2 m, along a circle, and through a gust that nobody told of.

A drone of 0.5 kg in a vertical plane, thrusts f₁ (left) and f₂ (right): the planar quadrotor of R. Tedrake,
"Underactuated Robotics", chapter 3, with small air drag. It falls over without control, so its data are taken under
an LQR of the linearisation at hover. A thrust turns with the drone, f sin θ, which no constant B can say.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class Quadrotor(km.Dynamics):
    """m p̈ = (f₁ + f₂) [−sin θ, cos θ] − m g [0, 1] − c ṗ,  J θ̈ = l (f₂ − f₁)."""

    states = ("x [m]", "y [m]", "theta [rad]", "vx [m/s]", "vy [m/s]", "omega [rad/s]")
    inputs = ("left [N]", "right [N]")

    m: float = 0.5  # mass [kg]
    J: float = 0.005  # inertia [kg m²]
    l: float = 0.2  # half the distance of the propellers [m]  # noqa: E741
    c: float = 0.1  # drag [N s/m]
    g: float = 9.81  # gravity [m/s²]
    wind: float = 0.0  # sideways force of a gust [N]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [ṗ, θ̇, p̈, θ̈]."""
        lift, turn = (u[0] + u[1]) / self.m, self.l * (u[1] - u[0]) / self.J
        right = -lift * ca.sin(x[2]) + (self.wind - self.c * x[3]) / self.m
        return ca.vertcat(x[3], x[4], x[5], right, lift * ca.cos(x[2]) - self.g - self.c * x[4] / self.m, turn)

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the ground 1.5 m below, the drone, and both thrusts as lines of 1 m for 8 N."""
        S, C = float(np.sin(x[2])), float(np.cos(x[2]))

        def place(along: float, up: float) -> tuple[float, float]:
            return float(x[0]) + along * C - up * S, float(x[1]) + along * S + up * C

        arms = ((-self.l, float(u[0])), (self.l, float(u[1])))
        lines = [[place(a, 0.03), place(a, 0.03 + f / 8.0)] for a, f in arms]
        return [
            km.scene.Line("ground", [(-2.0, -1.5), (4.0, -1.5)], width=0.03, color=(150, 160, 170)),
            km.scene.Line("left_thrust", lines[0], width=0.04, color=(40, 120, 200)),
            km.scene.Line("right_thrust", lines[1], width=0.04, color=(40, 120, 200)),
            km.scene.Line("arm", [place(-self.l, 0.0), place(self.l, 0.0)], width=0.06),
            km.scene.Disk("body", place(0.0, 0.0), 0.08),
        ]


drone, rest = Quadrotor(), np.zeros(6)
hover = np.full(2, drone.m * drone.g / 2)
near = km.discretize(drone, 0.05).linearize(rest, hover)
hold = km.dlqr(near.A, near.B, [10.0, 10.0, 5.0, 1.0, 1.0, 0.1], [1.0, 1.0]).K
box = km.Limits(u_min=0.0, u_max=6.0)
t = 0.05 * np.arange(241)  # a circle of 1 m in 6 s
w = 2 * np.pi / 6.0
circle = np.column_stack([np.sin(w * t), 1 - np.cos(w * t), 0 * t, w * np.cos(w * t), w * np.sin(w * t), 0 * t])
there = [2.0, 1.0, 0.0, 0.0, 0.0, 0.0]
fence = km.Limits(u_min=0.0, u_max=6.0, x_max=[1.5, np.inf, np.inf, np.inf, np.inf, np.inf])


def products(x: ca.SX) -> list[ca.SX]:
    """Return ω² sin θ, ω² cos θ, ω sin θ and ω cos θ."""
    return [x[5] ** n * f(x[2]) for n in (1, 2) for f in (ca.sin, ca.cos)]


problem = km.Problem(
    dynamics=drone,
    dt=0.05,
    equilibrium=(rest, hover),
    training=km.Training(
        x0=km.Uniform([-1.0, -1.0, -0.7, -2.0, -2.0, -2.0], [1.0, 1.0, 0.7, 2.0, 2.0, 2.0]),
        excitation=km.Feedback(hold, km.Noise([-1.5, -1.5], [1.5, 1.5]), u_ref=hover, u_min=0.0, u_max=6.0),
        episodes=300,
        steps=40,
    ),
    lifting=km.State()
    + km.Fourier(1, states="theta")
    + km.Expressions(products, ["ω sin θ", "ω cos θ", "ω² sin θ", "ω² cos θ"])
    + km.Constant(),
    cost=km.Cost(Q=[10.0, 10.0, 5.0, 1.0, 1.0, 0.1], R=[0.5, 0.5]),
    limits=box,
    horizon=25,
    cases={
        "reach": km.Case(x0=rest, reference=there, steps=120),
        "tilted": km.Case(x0=[0.0, 0.0, 0.8, 0.0, 0.0, 0.0], reference=rest, steps=120),
        "track": km.Case(x0=rest, reference=circle, steps=240),
        "beyond": km.Case(x0=rest, reference=there, steps=120, limits=fence),  # the goal is 0.5 m behind a fence
        "wrong": km.Case(x0=rest, reference=there, steps=160, plant=Quadrotor(m=0.6, J=0.004, wind=0.3)),
        "noise": km.Case(x0=rest, reference=there, steps=120, noise=[0.01, 0.01, 0.005, 0.02, 0.02, 0.02]),
    },
    angles=(2,),
)
