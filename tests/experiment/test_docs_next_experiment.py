"""docs/how/next_experiment.md: poor logs, a refused design, plans, new logs, a design that holds."""

import numpy as np
import pytest

import koopmpc as km
from tests.docs.page import alike, run


@pytest.mark.slow
def test_the_story_of_how_next_experiment_md_ends_in_a_design_that_holds(tmp_path):
    names, pairs = run("how/next_experiment.md", tmp_path)
    assert len(pairs) == 3
    for shown, printed in pairs:
        assert alike(shown, printed), printed
    plans = [plan for plan, _ in names["plans"]]
    held = [one for plan, log in names["plans"] for one in plan.review(log).held]
    assert np.mean(held) >= 0.7
    assert plans[0].gain > plans[-1].gain
    reach = [float(np.abs(plan.X[..., 0]).max()) for plan in plans]
    assert reach[0] < 0.6 < reach[-1]  # the first plan stays near the logs, the last one goes where the goal is
    assert isinstance(names["designed"].controller, km.KoopmanMPC)
    assert (tmp_path / "plan.csv").exists()
