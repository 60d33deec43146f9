"""docs/how/from_pid.md: its blocks print what it shows, and the predictive controller is better than the PID by far."""

from dataclasses import replace

import numpy as np
import pytest

import koopmpc as km
from koopmpc.synthesis.loops.fresh import run_fresh_loops
from koopmpc.synthesis.loops.pool import LoopPool
from tests.docs.page import alike, run


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::koopmpc.base.errors.FitWarning")
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
        **names["how"] | {"options": km.loop.LoopOptions(noise=[0.05, 0.05])},
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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::koopmpc.base.errors.FitWarning")
def test_one_sensor_is_enough_for_a_better_loop_that_the_stand_ins_do_not_call_lost(tmp_path):
    """The log of one level in closed loop: a design failed on it, and then called about a fifth of its loops lost."""
    names, _ = run("how/from_pid.md", tmp_path)
    twin, logs = names["twin"], names["logs"]
    one = km.Episodes([km.Episode(X=e.X[:, 1:], U=e.U) for e in logs], logs.dt, logs.states[1:], logs.inputs)
    limits = km.Limits(u_min=0, u_max=8, x_max=[20])
    cost = km.Cost(Q=1.0, R=0.1, R_delta=0.5)
    design = km.design(one, cost, limits, horizon=25, reference=[10.0], options=km.DesignOptions(bilinear=False))
    assert "delay" in design.best.title  # past rows stand in for the level that nobody measures
    assert dict(design.expected.loops)["neighbours"] > 100
    assert np.isfinite(design.expected.fresh.cost).all()
    known = design.evidence
    before = replace(known.neighbours, local=3, ridge=1e-4)  # what a slope was of, whatever the log
    pool = LoopPool(known.task, known.surrogates, before, known.low, known.high)
    fresh = run_fresh_loops(pool, km.compiled(design.controller), 600, np.random.default_rng(0))
    assert np.isinf(fresh.cost).mean() > 0.15
    wanted, rng = names["steps"][:, 0], np.random.default_rng(0)
    x, lower, moves = np.array([2.56, 4.0]), [4.0], []
    for k in range(149):
        move = design.controller(x[1:] + 0.05 * rng.standard_normal(1), wanted[k : k + 1])
        x = twin(x, move.u)
        moves.append(float(move.u[0]))
        lower.append(float(x[1]))
    old = names["runs"]["PID as it is"]
    error, before_it = (np.sqrt(np.mean((level - wanted) ** 2)) for level in (np.array(lower), old.X[:, 1]))
    assert error < 0.95 * before_it
    assert spend(np.array(lower), np.array(moves), wanted) < 0.9 * spend(old.X[:, 1], old.U[:, 0], wanted)


def spend(level, pump, wanted):
    """Return what the goal asks of a run: Q of the level, R of the pump about where it holds the level, R_delta."""
    at_rest = 0.8 * 3.1 * np.sqrt(wanted + 0.01) / 3.3
    off, moved = pump - at_rest[: len(pump)], np.diff(pump, prepend=at_rest[0])
    return np.sum((level - wanted) ** 2) + 0.1 * np.sum(off**2) + 0.5 * np.sum(moved**2)
