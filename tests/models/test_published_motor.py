"""The bilinear motor of Korda & Mezić (2018): control from its speed alone, with one delay."""

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
from jaxtyping import Float

import koopmpc as km


@dataclass(frozen=True)
class Motor(km.Dynamics):
    """Scaled so that |u| ≤ 1; x₁ is the current, x₂ the speed."""

    states: ClassVar[tuple[str, ...]] = ("current", "speed")
    inputs: ClassVar[tuple[str, ...]] = ("u",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        current = 19.10828025 - 39.3153 * x[0] - 32.2293 * x[1] * u[0]
        speed = -3.333333333 - 1.6599 * x[1] + 22.9478 * x[0] * u[0]
        return ca.vertcat(current, speed)


@pytest.fixture(scope="module")
def plant() -> km.StepMap:
    return km.discretize(Motor(), 0.01)


@pytest.fixture(scope="module")
def model(plant: km.StepMap) -> km.LinearPredictor:
    rng = np.random.default_rng(0)
    U = rng.uniform(-1, 1, (200, 1000, 1))
    X = plant.rollouts(rng.uniform(-1, 1, (200, 2)), U)
    data = km.Episodes([km.Episode(X=x[:, 1:], U=u) for x, u in zip(X, U, strict=True)], 0.01, ("speed",), ("u",))
    return km.edmd(data, km.State() + km.ThinPlate(rng.uniform(-1, 1, (100, 3))), embedding=km.Delay(1))


def closed_loop(
    plant: km.StepMap, mpc: km.KoopmanMPC, x: Float[np.ndarray, " nx"], reference: Float[np.ndarray, " T"]
) -> tuple[float, Float[np.ndarray, " T"], set[str]]:
    """Return Σ (y_k − r_k)² + 0.01 u_k² over k ≥ 1, y, and the statuses; the first input, 0, fills the delay."""
    mpc.reset(u_prev=[0.0])
    mpc(x[1:], reference[:1])
    x, u, total = plant(x, [0.0]), np.zeros(1), 0.0
    speeds, statuses = [x[1]], set[str]()
    for r in reference[1:]:
        move = mpc(x[1:], [r], applied=u)
        u = move.u
        statuses.add(move.status.name)
        total += float((x[1] - r) ** 2 + 0.01 * u[0] ** 2)
        x = plant(x, u)
        speeds.append(x[1])
    return total, np.array(speeds), statuses


@pytest.mark.slow
def test_the_step_costs_what_the_paper_s_data_give(plant: km.StepMap, model: km.LinearPredictor) -> None:
    """3.31 to 3.34 over random data; 2.61 is what preview would give, and 3.77 the local linear model."""
    mpc = km.KoopmanMPC(model, km.Cost(Q=[1.0], R=0.01, Q_N=[[1.0]]), km.Limits(u_min=-1, u_max=1), 100)
    reference = np.where(np.arange(301) <= 150, -0.3, 0.3)
    total, speeds, statuses = closed_loop(plant, mpc, np.array([0.0, 0.6]), reference)
    assert 3.28 < total < 3.36
    assert abs(speeds[-1] - 0.3) < 0.02
    assert statuses <= {"UNCONSTRAINED", "OPTIMAL"}


@pytest.mark.slow
def test_the_cosine_stays_within_its_band(plant: km.StepMap, model: km.LinearPredictor) -> None:
    """Every step is solved, at a cost near 2.36, and y stays within ±0.41 where ±0.4 is the limit."""
    limits = km.Limits(u_min=-1, u_max=1, x_min=[-0.4], x_max=[0.4])
    mpc = km.KoopmanMPC(model, km.Cost(Q=[1.0], R=0.01, Q_N=[[1.0]]), limits, 100)
    reference = 0.5 * np.cos(2 * np.pi * np.arange(301) / 300)
    total, speeds, statuses = closed_loop(plant, mpc, np.array([-0.1, 0.1]), reference)
    assert abs(total - 2.36) < 0.05
    assert np.abs(speeds).max() < 0.41
    assert statuses <= {"UNCONSTRAINED", "OPTIMAL", "SOFTENED"}
