"""The plants of the papers and their trajectories; integration errors are far below all reported errors.

Pendulum and cart-pole as in Snyder & Song, "Koopman operator theory for nonlinear dynamic modeling using dynamic mode
decomposition", 2021; the cart-pole with damping is that of Brunton & Kutz, "Data-Driven Science and Engineering",
2019, section 8.7.
"""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.special import ellipk

import koopmpc as km

SUBSTEPS = 8  # RK4 steps in a sample; in a sample of 0.01 s the error is below 1e-12


@dataclass(frozen=True)
class Pendulum(km.Dynamics):
    """θ̈ = ∓(g/L) sin θ + u / (m L²); θ = 0 is hanging, or upright if `upright`."""

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    m: float = 1.0  # mass [kg], Snyder & Song 2021
    L: float = 2.0  # length [m], Snyder & Song 2021
    g: float = 9.81  # gravity [m/s²]
    upright: bool = False

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [ω, ∓(g/L) sin θ + u / (m L²)]."""
        pull = self.g / self.L * ca.sin(x[0]) * (1.0 if self.upright else -1.0)
        return ca.vertcat(x[1], pull + u[0] / (self.m * self.L**2))


@dataclass(frozen=True)
class CartPole(km.Dynamics):
    """(M + m sin²θ) v̇ = u − d v + m sin θ (L ω² + g cos θ),  L ω̇ = −v̇ cos θ − g sin θ; θ = π is upright."""

    states = ("position [m]", "velocity [m/s]", "theta [rad]", "omega [rad/s]")
    inputs = ("force [N]",)

    M: float = 5.0  # cart mass [kg], Snyder & Song 2021
    m: float = 1.0  # pole mass, at the tip [kg], Snyder & Song 2021
    L: float = 2.0  # pole length [m], Snyder & Song 2021
    g: float = 9.81  # gravity [m/s²]
    d: float = 0.0  # damping of the cart [N s/m]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [v, v̇, ω, ω̇]."""
        S, C = ca.sin(x[2]), ca.cos(x[2])
        force = u[0] - self.d * x[1] + self.m * S * (self.L * x[3] ** 2 + self.g * C)
        acceleration = force / (self.M + self.m * S**2)
        return ca.vertcat(x[1], acceleration, x[3], -(acceleration * C + self.g * S) / self.L)


def build_right_side(dynamics: km.Dynamics) -> ca.Function:
    """Return f of ẋ = f(x, u) as a CasADi function of x (nx) and u (nu)."""
    x, u = ca.SX.sym("x", dynamics.nx), ca.SX.sym("u", dynamics.nu)
    return ca.Function("f", [x, u], [dynamics.rhs(x, u)])


def linearize_exactly(
    dynamics: km.Dynamics, x: ArrayLike
) -> tuple[Float[np.ndarray, "nx nx"], Float[np.ndarray, "nx nu"]]:
    """Return the exact A = ∂f/∂x and B = ∂f/∂u of ẋ = f(x, u) at (x, 0)."""
    point = np.asarray(x, dtype=float)
    f = build_right_side(dynamics)
    a, b = ca.SX.sym("x", dynamics.nx), ca.SX.sym("u", dynamics.nu)
    value = f(a, b)
    both = ca.Function("jacobians", [a, b], [ca.jacobian(value, a), ca.jacobian(value, b)])
    A, B = both(point, np.zeros(dynamics.nu))
    return np.array(ca.DM(A).full()), np.array(ca.DM(B).full())


def design_feedback(dynamics: km.Dynamics, x: ArrayLike, Q: ArrayLike, R: ArrayLike) -> km.control.Gain:
    """Return the continuous-time LQR of the linearisation at (x, 0)."""
    return km.lqr(*linearize_exactly(dynamics, x), Q, R)


def design_printed_feedback(plant: CartPole, Q: ArrayLike, R: ArrayLike) -> km.control.Gain:
    """Return the LQR of the Jacobian as the databook prints it, with the wrong sign of ∂v̇/∂θ at θ = π."""
    A, B = linearize_exactly(plant, [0.0, 0.0, np.pi, 0.0])
    A[1, 2] = -A[1, 2]
    return km.lqr(A, B, Q, R)


def swing_frequency(plant: Pendulum, amplitude: float) -> float:
    """Return ω = π √(g/L) / (2 K(sin² θ₀/2)) [rad/s] of the hanging pendulum released at rest at θ₀.

    K is the complete elliptic integral of the first kind, and the period 4 √(L/g) K.
    """
    quarter: float = ellipk(float(np.sin(amplitude / 2)) ** 2)  # of a period, in units of √(L/g)
    return float(np.pi / 2 * np.sqrt(plant.g / plant.L)) / quarter


def integrate_trajectories(
    dynamics: km.Dynamics,
    starts: ArrayLike,
    *,
    dt: float,
    steps: int,
    K: ArrayLike | None = None,
    x_ref: ArrayLike = 0.0,
    held: bool = False,
) -> km.Episodes:
    """Return x(k dt), k = 0 … steps, of ẋ = f(x, −K (x − x_ref)) from each start, without the inputs.

    Parameters
    ----------
    starts
        (E, nx), or one (nx,).
    dt
        Sample time [s].
    K
        (nu, nx), or (nx,) if nu is 1; no input by default.
    x_ref
        Scalar or (nx,), the target of the feedback.
    held
        True: u = −K (x_k − x_ref) is held over a sample. False: the feedback is continuous.
    """
    nx, nu = dynamics.nx, dynamics.nu
    rows = np.atleast_2d(np.asarray(starts, dtype=float))
    target = np.broadcast_to(np.asarray(x_ref, dtype=float), (nx,))
    matrix = np.zeros((nu, nx)) if K is None else np.asarray(K, dtype=float).reshape(nu, nx)
    x, u, none = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("none", 0)
    law = -ca.DM(matrix) @ (x - ca.DM(target))
    f = build_right_side(dynamics)
    F = km.RK4(SUBSTEPS).step(f if held else ca.Function("f", [x, u], [f(x, law)]), dt)
    sampled = ca.Function("F", [x, none], [F(x, law)])
    X = km.StepMap(sampled, dt, states=dynamics.states, inputs=()).rollouts(rows, np.empty((len(rows), steps, 0)))
    return km.Episodes([km.Episode(X=rows) for rows in X], dt, dynamics.states)


def attach_inputs(data: km.Episodes, names: tuple[str, ...], K: ArrayLike, x_ref: ArrayLike = 0.0) -> km.Episodes:
    """Return the episodes with the inputs u_k = −K (x_k − x_ref) that drove them."""
    matrix = np.asarray(K, dtype=float).reshape(len(names), data.nx)
    target = np.broadcast_to(np.asarray(x_ref, dtype=float), (data.nx,))
    episodes = [km.Episode(X=e.X, U=-(e.X[:-1] - target) @ matrix.T) for e in data]
    return km.Episodes(episodes, data.dt, data.states, names)


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """ẋ = f(x, u(x)) from one start: X (T+1, nx), U (T+1, nu), and the accumulated cost J (T+1,) = ∫ l(x, u) dt."""

    X: Float[np.ndarray, "T1 nx"]
    U: Float[np.ndarray, "T1 nu"]
    J: Float[np.ndarray, " T1"]

    @property
    def cost(self) -> float:
        """J of the whole run."""
        return float(self.J[-1])


def integrate_closed_loop(
    dynamics: km.Dynamics,
    law: Callable[[ca.SX], ca.SX],
    stage: Callable[[ca.SX, ca.SX], ca.SX],
    x0: ArrayLike,
    *,
    dt: float,
    seconds: float,
) -> ClosedLoop:
    """Integrate ẋ = f(x, u), J̇ = l(x, u) under the continuous feedback u = law(x).

    Parameters
    ----------
    dynamics
        f.
    law, stage
        u(x) and l(x, u), in CasADi operations.
    x0
        (nx,).
    dt
        Sample time [s]; each sample has `SUBSTEPS` RK4 steps.
    seconds
        Length of the run [s].
    """
    nx = dynamics.nx
    x, none = ca.SX.sym("x", nx + 1), ca.SX.sym("none", 0)
    u = ca.SX(ca.vertcat(law(x[:nx])))
    rate = ca.vertcat(build_right_side(dynamics)(x[:nx], u), stage(x[:nx], u))
    F = km.RK4(SUBSTEPS).step(ca.Function("f", [x, none], [rate]), dt)
    step_map = km.StepMap(F, dt, states=(*dynamics.states, "J"), inputs=())
    XJ = step_map.rollout([*np.asarray(x0, dtype=float), 0.0], np.empty((round(seconds / dt), 0)))
    U = np.array(ca.Function("u", [x], [u]).map(len(XJ))(XJ.T)).T
    return ClosedLoop(XJ[:, :nx], U, XJ[:, nx])
