"""Plants, predictors and episodes that the tests of several rooms share."""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.linalg

import koopmpc as km

GRAVITY = 9.81


@dataclass(frozen=True)
class Pendulum(km.Dynamics):
    damping: float = 0.0  # [1/s]

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        return ca.vertcat(x[1], -GRAVITY * ca.sin(x[0]) - self.damping * x[1] + u)


def energy(X: np.ndarray) -> np.ndarray:
    """Energy a unit of mass of the undamped pendulum of 1 m, (…, 2) -> (…)."""
    return 0.5 * X[..., 1] ** 2 + GRAVITY * (1 - np.cos(X[..., 0]))


class Swing(km.Dynamics):
    """θ̈ = sin θ + u, upright at θ = 0."""

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        return ca.vertcat(x[1], ca.sin(x[0]) + u[0])


@dataclass(frozen=True)
class CartPole(km.Dynamics):
    cart: float = 1.0  # [kg]
    pole: float = 0.2  # [kg]
    length: float = 0.5  # [m]

    states = ("p [m]", "theta [rad]", "v [m/s]", "omega [rad/s]")
    inputs = ("force [N]",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        s, c = ca.sin(x[1]), ca.cos(x[1])
        pull = u + self.pole * self.length * x[3] ** 2 * s
        total = self.cart + self.pole
        alpha = (GRAVITY * s * total - pull * c) / (self.length * (total - self.pole * c**2))
        return ca.vertcat(x[2], x[3], (pull - self.pole * self.length * alpha * c) / total, alpha)


@dataclass(frozen=True)
class Spring(km.Dynamics):
    """A linear plant of which one mixed output is measured."""

    states = ("x [m]", "v [m/s]")
    inputs = ()

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        return ca.vertcat(x[1], -x[0])

    def measure(self, x: ca.SX) -> ca.SX:
        return ca.vertcat(x[1], x[0] + 2 * x[1])


def random_episodes(
    seed: int, lengths: list[int], nx: int, nu: int, *, noise: float = 1.0, scale: float = 1.0
) -> km.Episodes:
    """Episodes of pure noise: nothing of one row follows from another, so that no wrong pair goes unseen."""
    rng = np.random.default_rng(seed)
    parts = [
        km.Episode(
            X=scale * rng.uniform(-noise, noise, (length + 1, nx)),
            U=rng.uniform(-1, 1, (length, nu)),
        )
        for length in lengths
    ]
    return km.Episodes(parts, 0.1)


def one_step_pairs(
    step: Callable[[np.ndarray, np.ndarray], np.ndarray], nx: int, nu: int, count: int, seed: int = 0
) -> km.Episodes:
    """Return `count` episodes of one step from x, u ~ U[-1, 1]."""
    rng = np.random.default_rng(seed)
    parts: list[km.Episode] = []
    for _ in range(count):
        x, u = rng.uniform(-1, 1, nx), rng.uniform(-1, 1, nu)
        parts.append(km.Episode(X=[x, step(x, u)], U=[u]))
    return km.Episodes(parts, 0.01)


def brute_force(episodes: km.Episodes, lifting: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return every row [ψ(x) u ψ(x⁺)], one at a time."""
    return np.array(
        [np.concatenate([lifting(e.X[k]), e.U[k], lifting(e.X[k + 1])]) for e in episodes for k in range(len(e))]
    )


def random_predictor(
    seed: int, nx: int, nu: int, lifting: km.Lifting | None = None, radius: float = 0.95, dt: float = 0.1
) -> km.LinearPredictor:
    """Return a predictor whose A has this spectral radius; C is the identity on State, else random."""
    rng = np.random.default_rng(seed)
    states = tuple(f"x{i} [m]" for i in range(nx))
    bound = (lifting or km.State()).bind(states)
    A = rng.standard_normal((bound.nz, bound.nz))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    C = np.eye(nx) if lifting is None else rng.standard_normal((nx, bound.nz))
    B = rng.standard_normal((bound.nz, nu))
    return km.LinearPredictor(A, B, C, bound, dt, states, tuple(f"u{i} [N]" for i in range(nu)))


def random_pair(rng, nx, nu, radius=1.05):
    """Return a random (A, B) whose A has this spectral radius."""
    A = rng.normal(size=(nx, nx))
    return A * radius / np.abs(np.linalg.eigvals(A)).max(), rng.normal(size=(nx, nu))


def linear(A, B, constant=None, E=None, dt=0.1, *, units=False):
    """Return x⁺ = A x + B u (+ E w + c) as a predictor on State() (+ Constant()); `units` gives the names units."""
    nx, nu = np.shape(B)
    metre, newton = (" [m]", " [N]") if units else ("", "")
    states = tuple(f"x{i}{metre}" for i in range(nx))
    inputs = tuple(f"u{i}{newton}" for i in range(nu))
    A, B, C, lifting = np.array(A), np.array(B), np.eye(nx), km.State()
    if constant is not None:
        A = scipy.linalg.block_diag(A, 1.0)
        A[:nx, nx] = constant
        B, C, lifting = np.vstack([B, np.zeros((1, nu))]), np.eye(nx, nx + 1), km.State() + km.Constant()
    if E is None:
        return km.LinearPredictor(A, B, C, lifting, dt, states, inputs)
    E = np.vstack([E, np.zeros((len(A) - nx, np.shape(E)[1]))])
    names = tuple(f"w{i}" for i in range(E.shape[1]))
    return km.LinearPredictor(A, B, C, lifting, dt, states, inputs, E=E, disturbances=names)


def step_map(A, B, dt=0.1, constant=None):
    """Return x⁺ = A x + B u (+ c) as a StepMap."""
    nx, nu = np.shape(B)
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    c = np.zeros(nx) if constant is None else np.asarray(constant)
    return km.StepMap(ca.Function("F", [x, u], [ca.DM(A) @ x + ca.DM(B) @ u + ca.DM(c)]), dt)
