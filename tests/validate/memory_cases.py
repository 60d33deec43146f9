"""Logs with and without a hidden state, drawn at random: plants, inputs, noise, feedback."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import koopmpc as km

Right = Callable[[np.ndarray, float], list[float]]


class Plant(NamedTuple):
    """An equation ẋ = f(x, u), the sample time [s], the input's amplitude, and the columns that an output-only log has."""

    f: Right
    nx: int
    dt: float
    amplitude: float
    output: int


def draw_linear(rng: np.random.Generator) -> Plant:
    """Return a stable linear plant of two or three states in a chain with couplings, all of which the input moves."""
    nx = int(rng.integers(2, 4))
    A = -np.diag(rng.uniform(0.3, 2.0, nx)) + np.diag(rng.uniform(0.5, 1.5, nx - 1), 1) * (nx > 1)
    A[nx - 1, 0] = -rng.uniform(0.2, 1.5) / nx
    B = np.eye(nx)[-1]
    return Plant(lambda x, u: list(A @ x + B * u), nx, 0.3, 1.0, 0)


def draw_plant(rng: np.random.Generator, number: int) -> Plant:
    """Return a plant of this kind with random parameters."""
    a, b = rng.uniform(0.7, 1.4, 2)
    plants = (
        draw_linear(rng),
        Plant(lambda x, u: [x[1], -4 * a * np.sin(x[0]) - 0.4 * b * x[1] + u], 2, 0.08, 5.0, 0),
        Plant(lambda x, u: [x[1], a * (1 - x[0] ** 2) * x[1] - x[0] + u], 2, 0.12, 2.0, 0),
        Plant(lambda x, u: [x[1], -a * x[0] - b * x[0] ** 3 - 0.3 * x[1] + u], 2, 0.15, 1.5, 0),
        Plant(
            lambda x, u: [
                0.5 * a * (u + 1.2) - 0.8 * np.sqrt(max(x[0], 0.0)),
                0.8 * np.sqrt(max(x[0], 0.0)) - 0.7 * b * np.sqrt(max(x[1], 0.0)),
            ],
            2,
            0.4,
            0.9,
            1,
        ),
        Plant(lambda x, u: [x[1], -0.8 * a * np.tanh(8 * x[1]) - 0.5 * x[0] + 2 * u], 2, 0.1, 1.5, 0),
        Plant(
            lambda x, u: [8 * (x[1] - x[0]), x[0] * (26 * a - x[2]) - x[1] + 10 * u, x[0] * x[1] - 2.5 * x[2]],
            3,
            0.03,
            1.0,
            0,
        ),
        Plant(lambda x, u: [(x[1] - x[0]) / 2 - 0.15 * x[0], a * u - (x[1] - x[0]) / 3], 2, 0.5, 1.0, 0),
        Plant(
            lambda x, u: [
                x[2],
                x[3],
                2 * (x[1] - x[0]) - 0.2 * x[2] - a * x[0] + u,
                2 * (x[0] - x[1]) - 0.2 * x[3] - 0.3 * b * x[1] ** 3,
            ],
            4,
            0.2,
            1.5,
            0,
        ),
    )
    return plants[number % len(plants)]


def record(
    plant: Plant, rng: np.random.Generator, noise: float, *, closed: bool = False, states: tuple[int, ...] = ()
) -> km.Episodes:
    """Return logs of a plant: one record or many episodes, in open loop or under P or PI control of one output.

    Noise is a share of each state's spread; the controller reads it. `states` are the columns that are measured.
    """
    columns = list(states) or list(range(plant.nx))
    count, steps = (1, int(rng.integers(1200, 2400))) if rng.random() < 0.6 else (40, int(rng.integers(30, 60)))
    hold = int(rng.integers(1, 12))
    gain, integral = plant.amplitude * rng.uniform(0.3, 0.8), rng.choice([0.0, 0.1, 0.3])
    dither = rng.choice([0.0, 0.1, 0.3])

    def run(level: np.ndarray, episodes: int, length: int, size: np.ndarray) -> list[km.Episode]:
        logs: list[km.Episode] = []
        for _ in range(episodes):
            x = rng.uniform(0.1, 1.0, plant.nx)
            X, U = np.empty((length + 1, plant.nx)), np.empty((length, 1))
            aim, total = 0.0, 0.0
            for k in range(length + 1):
                X[k] = x + level * rng.standard_normal(plant.nx)
                if k == length:
                    break
                if k % (hold * (5 if closed else 1)) == 0:
                    aim = rng.uniform(-1, 1)
                u = plant.amplitude * aim
                if closed and size.any():
                    error = aim - (X[k, plant.output] - size[0]) / size[1]
                    total = float(np.clip(total + integral * error * plant.dt, -3, 3))
                    u = gain * (error + total) + dither * plant.amplitude * rng.uniform(-1, 1)
                    u = float(np.clip(u, -plant.amplitude, plant.amplitude))
                U[k] = u
                for _ in range(2):
                    h = plant.dt / 2
                    k1 = np.array(plant.f(x, u))
                    k2 = np.array(plant.f(x + h / 2 * k1, u))
                    k3 = np.array(plant.f(x + h / 2 * k2, u))
                    k4 = np.array(plant.f(x + h * k3, u))
                    x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            logs.append(km.Episode(X=X[:, columns], U=U))
        return logs

    exact = run(np.zeros(plant.nx), 1, 400, np.zeros(0))
    full = np.zeros(plant.nx)
    full[columns] = exact[0].X.std(axis=0)
    centre = float(exact[0].X[:, columns.index(plant.output)].mean()) if plant.output in columns else 0.0
    size = np.array([centre, max(full[plant.output], 1e-3)]) if closed else np.zeros(0)
    names = tuple(f"y{i}" for i in columns)
    return km.Episodes(run(noise * full, count, steps, size), plant.dt, states=names, inputs=("u",))
