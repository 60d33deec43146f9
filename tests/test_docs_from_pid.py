"""docs/how/from_pid.md: its blocks print what it shows, and the predictive controller is better than the PID by far."""

import numpy as np
import pytest

import koopmpc as km
from tests.docs.page import alike, run


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::koopmpc.errors.FitWarning")
def test_the_way_from_a_pid_leads_to_a_better_loop_without_a_bump(tmp_path):
    names, pairs = run("how/from_pid.md", tmp_path)
    for shown, printed in pairs:
        assert alike(shown, printed), printed
    wanted = names["steps"][:, 0]
    error = {name: np.sqrt(np.mean((one.X[:, 1] - wanted) ** 2)) for name, one in names["runs"].items()}
    over = {name: one.X[10:80, 1].max() - 12 for name, one in names["runs"].items()}
    assert error["predictive"] < error["PID as it is"]
    assert over["predictive"] < 0.3 * over["PID as it is"]
    ahead = km.simulate(
        names["twin"],
        names["design"].controller,
        x0=[2.56, 4],
        **names["how"] | {"preview": True},
        reference=names["steps"],
    )
    assert np.sqrt(np.mean((ahead.X[:, 1] - wanted) ** 2)) < 0.5 * error["PID as it is"]
    for one in names["runs"].values():
        assert ((one.U >= 0) & (one.U <= 8)).all()
    switched = names["run"]
    assert (switched.actor[0], switched.actor[-1]) == ("standby", "automatic")
    k = next(i for i, actor in enumerate(switched.actor) if actor == "automatic")
    usual = np.abs(np.diff(switched.U[10:k, 0])).max()
    assert abs(switched.U[k, 0] - switched.U[k - 1, 0]) < max(3 * usual, 0.3)
    assert (tmp_path / "c_code" / "Makefile").exists()
