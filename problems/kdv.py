"""Korteweg–de Vries: waves in a ring of shallow water are raised and lowered by three forces along it, 128 states.

The third example of M. Korda and I. Mezić, "Linear predictors for nonlinear dynamical systems: Koopman operator meets
model predictive control", Automatica 93 (2018): their equation, forces, split-step method, lifting [y, 1, yᵢ yᵢ₊₁, y²]
and references, with 100 trajectories of data in place of 1000. The linearisation at rest knows nothing of waves that
run faster the higher they are. `nonlinear-mpc` would take seconds a step and is left out.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km

n = 128  # points of the ring [−π, π)
place = 2 * np.pi * np.arange(n) / n - np.pi
wave = np.fft.fftfreq(n, 1 / n) * (np.abs(np.fft.fftfreq(n, 1 / n)) < n / 2)  # the highest wave has no slope


def filtered(gains: np.ndarray) -> np.ndarray:
    """Return the matrix (n, n) that multiplies each wave by its gain."""
    return np.real(np.fft.ifft(gains[:, None] * np.fft.fft(np.eye(n), axis=0), axis=0))


slope = filtered(1j * wave)  # ∂/∂x
pushes = np.exp(-25.0 * (place[:, None] - np.array([-np.pi / 2, 0.0, np.pi / 2])) ** 2)  # (n, 3)


@dataclass(frozen=True)
class Wave(km.Dynamics):
    """y_t = −y y_x − y_xxx + Σ uᵢ exp(−25 (x − cᵢ)²), periodic on [−π, π]."""

    states = tuple(f"y{i} [1]" for i in range(n))
    inputs = ("left [1/s]", "middle [1/s]", "right [1/s]")

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ with spectral derivatives."""
        return -ca.mtimes(slope, x**2 / 2) - ca.mtimes(slope @ slope @ slope, x) + ca.mtimes(pushes, u)

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the water over the ring, laid flat, and the forces as bars, 1 for 2 / s."""
        bars: list[km.scene.Shape] = [
            km.scene.Line(name, [(at, 0.0), (at, float(push) / 2)], width=0.12, color=(40, 120, 200))
            for name, at, push in zip(("left", "middle", "right"), (-np.pi / 2, 0.0, np.pi / 2), u, strict=True)
        ]
        surface = [(float(at), float(y)) for at, y in zip(place, x, strict=True)]
        ground = km.scene.Line("rest", [(-np.pi, 0.0), (np.pi, 0.0)], width=0.02, color=(150, 160, 170))
        return [ground, *bars, km.scene.Line("wave", surface, width=0.05)]


@dataclass(frozen=True)
class SplitStep(km.plants.Integrator):
    """Strang's splitting: half a step of y_xxx exactly, a step of the rest by RK4, half a step of y_xxx; order 2."""

    def step(self, f: ca.Function, dt: float) -> ca.Function:
        """Return F of x⁺ = F(x, u); f is not used, for its stiff part is split off."""
        x, u = ca.MX.sym("x", n), ca.MX.sym("u", 3)
        half, force = ca.DM(filtered(np.exp(0.5j * dt * wave**3))), ca.mtimes(ca.DM(pushes), u)

        def rest(y: ca.MX) -> ca.MX:
            return force - ca.mtimes(ca.DM(slope), y**2 / 2)

        y = ca.mtimes(half, x)
        k1 = rest(y)
        k2 = rest(y + dt / 2 * k1)
        k3 = rest(y + dt / 2 * k2)
        y = y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rest(y + dt * k3))
        return ca.Function("F", [x, u], [ca.mtimes(half, y)], ["x", "u"], ["x_next"])


def products(x: ca.SX) -> list[ca.SX]:
    """Return the products of neighbours, and the squares."""
    return [x[i] * x[(i + 1) % n] for i in range(n)] + [x[i] ** 2 for i in range(n)]


rng = np.random.default_rng(0)
shapes = np.stack([np.exp(-((place - np.pi / 2) ** 2)), -(np.sin(place / 2) ** 2), np.exp(-((place + np.pi / 2) ** 2))])
starts = rng.dirichlet([1.0, 1.0, 1.0], 100) @ shapes  # Korda and Mezić mix three shapes
levels = np.concatenate([np.full(400, 0.5), np.zeros(400), np.full(601, 0.75)])
flat = np.zeros(n)


problem = km.Problem(
    dynamics=Wave(),
    dt=0.01,
    integrator=SplitStep(),
    equilibrium=(flat, np.zeros(3)),
    training=km.Training(x0=starts, excitation=km.Noise([-1.0] * 3, [1.0] * 3), episodes=100, steps=200),
    lifting=km.State()
    + km.Constant()
    + km.Expressions(products, [f"y{i} y{(i + 1) % n}" for i in range(n)] + [f"y{i}²" for i in range(n)]),
    ridge=1e-9,
    cost=km.Cost(Q=np.ones(n), R=np.full(3, 1e-3), u_target="zero"),
    limits=km.Limits(u_min=-1.0, u_max=1.0),
    horizon=10,
    cases={
        "raise": km.Case(x0=flat, reference=np.full(n, 0.5), steps=600),
        "steps": km.Case(x0=flat, reference=np.tile(levels[:, None], (1, n)), steps=1400),
        "still": km.Case(x0=0.8 * np.exp(-(place**2)), reference=flat, steps=600),
        "noise": km.Case(x0=flat, reference=np.full(n, 0.5), steps=600, noise=np.full(n, 0.02)),
        "delay": km.Case(x0=flat, reference=np.full(n, 0.5), steps=600, faults=[km.faults.ActuatorDelay(1)]),
    },
    controllers=("lqr", "linear-mpc", "koopman-mpc", "offset-free"),
)
