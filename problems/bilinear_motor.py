"""Bilinear motor: the speed of a DC motor is set by its field current, which multiplies the states.

The second example of M. Korda and I. Mezić, "Linear predictors for nonlinear dynamical systems: Koopman operator
meets model predictive control", Automatica 93 (2018): a benchmark of S. Daniel-Berhe and H. Unbehauen (1998) in
scaled variables. A constant B cannot say that the same field current turns the motor one way or the other as the
armature current does, so the bilinear model is the fitting one. All weigh the speed alone.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class Motor(km.Dynamics):
    """ẋ₁ = v − r x₁ − k₁ x₂ u,  ẋ₂ = −m − d x₂ + k₂ x₁ u."""

    states = ("current [1]", "speed [1]")
    inputs = ("field [1]",)

    v: float = 19.10828025  # armature voltage [1/s]
    r: float = 39.3153  # its resistance over its inductance [1/s]
    k1: float = 32.2293  # back electromotive force [1/s]
    load: float = 3.333333333  # torque of the load [1/s]
    d: float = 1.6599  # friction [1/s]
    k2: float = 22.9478  # torque [1/s]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ of armature current and speed."""
        current = self.v - self.r * x[0] - self.k1 * x[1] * u[0]
        return ca.vertcat(current, -self.load - self.d * x[1] + self.k2 * x[0] * u[0])

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw a dial whose needle shows the speed, ±1 at ±120°, and bars for armature and field current."""
        angle = float(np.clip(x[1], -1.2, 1.2)) * 2 * np.pi / 3
        dial = [(float(np.sin(a)), float(np.cos(a))) for a in np.linspace(-2 * np.pi / 3, 2 * np.pi / 3, 40)]
        tip = (0.9 * float(np.sin(angle)), 0.9 * float(np.cos(angle)))
        return [
            km.scene.Line("dial", dial, width=0.03, color=(150, 160, 170)),
            km.scene.Line("needle", [(0.0, 0.0), tip], width=0.05),
            km.scene.Disk("hub", (0.0, 0.0), 0.07),
            km.scene.Line("current", [(1.3, 0.0), (1.3, float(x[0]))], width=0.12, color=(120, 130, 150)),
            km.scene.Line("field", [(1.6, 0.0), (1.6, float(u[0]))], width=0.12, color=(40, 120, 200)),
        ]


def held(motor: Motor, speed: float) -> tuple[list[float], list[float]]:
    """Return the state and the smaller field that hold a speed: a root of k₁ k₂ x₂ u² − k₂ v u + r (m + d x₂) = 0."""
    a, b, c = motor.k1 * motor.k2 * speed, motor.k2 * motor.v, motor.r * (motor.load + motor.d * speed)
    u = float(2 * c / (b + np.sqrt(b**2 - 4 * a * c)))
    return [(motor.v - motor.k1 * speed * u) / motor.r, speed], [u]


motor = Motor()
k = np.arange(301)
square = np.where(k <= 150, -0.3, 0.3)[:, None]
cosine = 0.5 * np.cos(2 * np.pi * k / 300)[:, None]
box = km.Limits(u_min=-1.0, u_max=1.0)
within = km.Limits(u_min=-1.0, u_max=1.0, x_min=[-np.inf, -0.4], x_max=[np.inf, 0.4])
weak = replace(motor, load=motor.load * 1.2, d=motor.d * 0.8)
start = [0.0, 0.6]


problem = km.Problem(
    dynamics=motor,
    dt=0.01,
    equilibrium=held(motor, 0.0),
    training=km.Training(x0=km.Uniform([-1.0, -1.0], [1.0, 1.0]), excitation=km.Noise(-1, 1), episodes=200, steps=100),
    lifting=km.State() + km.Monomials(3) + km.Constant(),
    cost=km.Cost(Q=1.0, R=0.01, of=km.State("speed")),
    limits=box,
    horizon=50,
    cases={
        "step": km.Case(x0=start, reference=square, steps=300),
        "reach": km.Case(x0=held(motor, 0.0)[0], reference=[0.3], steps=150),
        "beyond": km.Case(x0=[-0.1, 0.1], reference=cosine, steps=300, limits=within),
        "wrong": km.Case(x0=start, reference=square, steps=300, plant=weak),
        "noise": km.Case(x0=start, reference=square, steps=300, noise=[0.005, 0.005]),
        "delay": km.Case(x0=start, reference=square, steps=300, faults=[km.faults.ActuatorDelay(1)]),
    },
)
