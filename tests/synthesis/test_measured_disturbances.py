"""The heat pump of the page on measured disturbances: what learns from its logs is told the weather, and uses it."""

import re
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def page():
    """The names that the page's block makes: plant, E, logs, cost, limits and the weather W."""
    text = (Path(__file__).parents[2] / "docs/how/measured_disturbances.md").read_text()
    names = {"__name__": "page"}
    exec(compile(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0], "page", "exec"), names)
    return names


def spend(page, controller):
    """The closed-loop cost from a warm start under the weather that the controller is told."""
    plant, W = page["plant"], page["W"]
    x0, reference = [21.0, 30.0], [21.0]
    options = {"cost": page["cost"], "limits": page["limits"], "measured": W, "disturbance": W @ page["E"].T}
    return km.metrics(km.simulate(plant, controller, x0=x0, reference=reference, steps=len(W), **options)).cost


@pytest.fixture(scope="module")
def best(page):
    """The cost of nonlinear MPC on the exact equations, which are bilinear in the floor's temperature."""
    A = np.array([[0.91, 0.06, 0.0], [0.1, 0.9, 0.0], [0.0, 0.0, 1.0]])
    B, N = np.array([[0.0], [1.1], [0.0]]), np.zeros((1, 3, 3))
    N[0, 1, 1] = -0.016
    E = np.vstack([page["E"], [0.0]])
    plant = page["plant"]
    exact = km.BilinearPredictor(
        A, B, N, np.eye(2, 3), km.State() + km.Constant(), 900.0, plant.states, plant.inputs, E=E
    )
    x, u = np.array([20.0, 28.0]), np.array([2.0])
    np.testing.assert_allclose(exact.rollout(x, [u])[1], plant(x, u), atol=1e-9)
    return spend(page, km.NonlinearMPC(exact, page["cost"], page["limits"], 24))


def test_select_finds_the_bilinear_model_with_w_and_its_controller_is_as_good_as_the_equations(page, best):
    found = km.select(page["logs"], horizon=24)
    assert found.bilinear.disturbances == ("outside [°C]",)
    assert any(row.bilinear for row in found.leaderboard)
    assert spend(page, km.BilinearMPC(found.bilinear, page["cost"], page["limits"], 24)) <= 1.05 * best
    report = km.trust(found.bilinear, page["logs"], horizon=24)
    assert report.score.rmse[-1].max() < 0.05


def test_a_design_from_logs_with_w_tries_bilinear_models_and_is_as_good_as_the_equations(page, best):
    design = km.design(page["logs"], page["cost"], page["limits"], horizon=24, reference=[21.0])
    assert any(row.recipe.candidate.bilinear for row in design.leaderboard)
    assert spend(page, design.controller) <= 1.05 * best
