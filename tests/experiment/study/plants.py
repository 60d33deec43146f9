"""Random nonlinear plants of one to three states, with a goal and limits on both sides, and poor logs near rest."""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.optimize

import koopmpc as km

NOISES = (0.001, 0.005, 0.01)  # of the sensors, as a share of the range between the limits, in turn
DT = 0.1
POOR = (3, 30)  # episodes and steps of the first logs
SMALL = 0.3  # their inputs, of 2
STANDING = 5  # one plant of so many stands under a controller


@dataclass(frozen=True, eq=False)
class DrawnPlant(km.Dynamics):
    """ẋ = A x + B u + C sin(2x) x_0 + D x u_0 + load: without a load each is at rest in 0, some unstable."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    load: np.ndarray | float = 0.0
    states = ("a", "b", "c")
    inputs = ("u", "v")

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ."""
        return self.A @ x + self.B @ u + self.C @ ca.sin(2 * x) * x[0] + self.D @ x * u[0] + self.load


@dataclass(frozen=True, eq=False)
class StudyTask:
    """What `next_experiment` is given, and the plant on which its plans run.

    Attributes
    ----------
    gather
        First logs by seed.
    noise
        (nx,) standard deviations of the sensors.
    controller
        A standing controller, whose set points are planned; None where inputs are.
    """

    plant: km.StepMap
    gather: Callable[[int], km.Episodes]
    cost: km.Cost
    limits: km.Limits
    reference: np.ndarray
    noise: np.ndarray
    controller: km.LQR | None = None

    def blur(self, clean: km.Episodes, rng: np.random.Generator) -> km.Episodes:
        """Return what noisy sensors show of these episodes."""
        noisy = [km.Episode(X=e.X + self.noise * rng.standard_normal(e.X.shape), U=e.U) for e in clean]
        return km.Episodes(noisy, clean.dt, clean.states, clean.inputs)


def build_plant(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, load: np.ndarray | float = 0.0
) -> km.StepMap:
    """Return the step map of a `DrawnPlant` with as many names as it has states and inputs."""

    class Plant(DrawnPlant):
        states, inputs = DrawnPlant.states[: len(A)], DrawnPlant.inputs[: B.shape[1]]

    return km.discretize(Plant(A, B, C, D, load), DT)


def draw_task(seed: int) -> StudyTask:
    """Return a random plant with an equilibrium to go to, and limits a little beyond it and rest."""
    rng = np.random.default_rng([35, seed])
    while True:
        nx = int(rng.integers(1, 4))
        nu = int(rng.integers(1, min(nx, 2) + 1))
        A = rng.normal(size=(nx, nx))
        A += (rng.uniform(-1.5, 0.3) - np.linalg.eigvals(A).real.max()) * np.eye(nx)
        B = rng.normal(size=(nx, nu)) * rng.uniform(0.7, 1.5)
        plant = build_plant(A, B, 0.3 * rng.normal(size=(nx, nx)), 0.2 * rng.normal(size=(nx, nx)))
        u_r = rng.uniform(-0.8, 0.8, nu)
        x_r, _, ended, _ = scipy.optimize.fsolve(
            lambda x, plant=plant, u_r=u_r: np.asarray(plant(x, u_r)) - x, np.zeros(nx), full_output=True
        )
        if ended == 1 and 0.1 < np.abs(x_r).max() < 1.0:
            break
    beyond = rng.uniform(0.2, 0.6, nx)
    low, high = np.minimum(x_r, 0) - beyond, np.maximum(x_r, 0) + beyond
    limits = km.Limits(u_min=-2, u_max=2, x_min=low, x_max=high)
    cost = km.Cost(Q=rng.uniform(0.1, 2.0, nx), R=rng.uniform(0.02, 0.3, nu))
    noise = NOISES[seed % len(NOISES)] * (high - low)
    standing = None
    if seed % STANDING == STANDING - 1:
        standing = km.LQR(
            km.LinearPredictor.local(plant, np.zeros(nx), np.zeros(nu)), cost, km.Limits(u_min=-2, u_max=2)
        )

    def gather(number: int) -> km.Episodes:
        draw = np.random.default_rng([35, seed, number])
        if standing is None:
            small = km.Noise(np.full(nu, -SMALL), SMALL, hold=4)
            clean = km.collect(plant, np.zeros(nx), small, episodes=POOR[0], steps=POOR[1], rng=draw)
            return task.blur(clean, draw)
        goals = SMALL * x_r * np.repeat(draw.uniform(-1, 1, (POOR[0], POOR[1] + 1, 1))[:, ::6], 6, axis=1)
        runs = [
            km.simulate(
                plant,
                standing,
                x0=np.zeros(nx),
                reference=rows[: POOR[1] + 1],
                steps=POOR[1],
                noise=noise,
                rng=draw,
            )
            for rows in goals
        ]
        read = [km.Episode(X=run.Y, U=run.U) for run in runs]
        return km.Episodes(read, DT, plant.states, plant.inputs)

    task = StudyTask(plant, gather, cost, limits, np.asarray(x_r), noise, standing)
    return task
