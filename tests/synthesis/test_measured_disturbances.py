"""The heat pump of the page on measured disturbances: what learns from its logs is told the weather, and uses it."""

import re
from pathlib import Path

import pytest

import koopmpc as km

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def page():
    """The names that the page's block makes: plant, logs, cost, limits and the weather."""
    text = (Path(__file__).parents[2] / "docs/how/measured_disturbances.md").read_text()
    names = {"__name__": "page"}
    exec(compile(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0], "page", "exec"), names)
    return names


def spend(page, controller):
    """The closed-loop cost from a warm start under the weather that the controller is told."""
    W = page["weather"]
    options = {"cost": page["cost"], "limits": page["limits"], "measured": W}
    return km.metrics(
        km.simulate(page["plant"], controller, x0=[21.0, 26.0], reference=[21.0], steps=len(W), **options)
    ).cost


@pytest.fixture(scope="module")
def best(page):
    """The cost of nonlinear MPC on the exact equations."""
    return spend(page, km.NonlinearMPC(page["plant"], page["cost"], page["limits"], 48))


def test_select_finds_the_bilinear_model_with_w_and_its_controller_is_as_good_as_the_equations(page, best):
    found = km.select(page["logs"], horizon=48)
    assert found.bilinear.disturbances == ("outside [°C]",)
    assert found.bilinear.M.any()  # the compressor is worth less when it is cold
    assert any(row.bilinear for row in found.leaderboard)
    assert spend(page, km.BilinearMPC(found.bilinear, page["cost"], page["limits"], 48)) <= 1.05 * best
    report = km.trust(found.bilinear, page["logs"], horizon=48)
    assert report.score.rmse[-1].max() < 0.1


def test_a_design_from_logs_with_w_tries_bilinear_models_and_is_as_good_as_the_equations(page, best):
    design = km.design(page["logs"], page["cost"], page["limits"], horizon=48, reference=[21.0])
    assert any(row.recipe.candidate.bilinear for row in design.leaderboard)
    assert spend(page, design.controller) <= 1.05 * best
