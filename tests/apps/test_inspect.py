"""inspect and replay: what a log says by itself, worst moments with their times, conditions, and the same run again."""

from dataclasses import replace

import numpy as np
import pytest

import koopmpc as km
from tests.apps.tiny import write


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inspected")
    problem = km.load_problem(write(folder))
    names, logs = ["lqr", "koopman-mpc"], folder / "logs"
    rows = km.sweep([problem], names, folder=logs / "starts", options=km.bench.SweepOptions(starts=2, log_starts=2))
    return [
        *rows,
        *km.sweep([problem.select("near")], names, folder=logs / "faults", options=km.bench.SweepOptions(faults=True)),
    ], folder


def test_a_log_says_what_ran_and_its_metrics_by_itself(swept):
    rows, folder = swept
    found = {each.path: each for each in km.bench.inspect_logs([folder / "logs"])}
    assert set(found) == {row.log for row in rows}
    for row in rows:
        own = found[row.log]
        assert own.metrics == row.metrics
        assert own.title.split()[:3] == [row.problem, row.case, row.controller]
        assert own.values["reached"] == row.reached


def test_the_worst_moments_are_where_they_happened(swept):
    row = next(row for row in swept[0] if row.fault == "solver-failure" and row.controller == "koopman-mpc")
    run = km.load_run(row.log)
    times = run.solve_time.copy()
    times[3] = 9.0
    run = replace(run, solve_time=times, limits=km.Limits(x_max=[0.4]), known=np.arange(run.steps) // 2 % 2)
    moments = km.bench.worst_moments(run)
    assert [moment.k for moment in moments] == sorted(moment.k for moment in moments)
    at = {
        kind: [m.k for m in moments if kind in m.what]
        for kind in ("slowest", "violation", "unknown", "fallback", "later")
    }
    assert at["slowest"] == at["later"] == [3]
    assert at["violation"] == [1 + int(np.argmax(run.X[1:, 0]))] or run.X[1:].max() <= 0.4
    fell = [k for k in range(run.steps) if run.fallback[k].value and not (k and run.fallback[k - 1].value)]
    assert at["fallback"][:5] == fell[:5]
    assert at["unknown"][:5] == list(range(0, run.steps, 4))[:5]
    assert all(moment.time == moment.k * run.dt for moment in moments)


def test_conditions_choose_logs(swept):
    rows, folder = swept
    chosen = {
        each.path
        for each in km.bench.inspect_logs([folder / "logs"], "cost > 2 and controller == 'lqr' or not reached")
    }
    assert chosen == {row.log for row in rows if (row.metrics.cost > 2 and row.controller == "lqr") or not row.reached}
    assert km.bench.RowFilter("0 < -cost <= 3").holds({"cost": -2.0})
    for bad, said in (
        ("cost >", "is not a comparison"),
        ("price > 1", "there is no figure 'price'"),
        ("cost > 'a'", "compares"),
        ("__import__('os').system('true')", "holds more than comparisons"),
        ("cost + 1 > 2", "holds more than comparisons"),
    ):
        with pytest.raises(km.errors.DataError, match=said):
            km.bench.RowFilter(bad).holds({"cost": 1.0})


def record_pendulum(path, steps):
    plant = km.discretize(km.load_problem("pendulum").dynamics, 0.05)
    cost, about = km.Cost(1, 1), {"x0": [0.1, 0], "reference": [0, 0], "steps": steps}
    run = km.simulate(plant, km.LQR(km.LinearPredictor.local(plant, [0, 0], [0]), cost), cost=cost, **about)
    km.record(run, path)
    return run


def test_a_cut_log_is_repaired_as_far_as_it_is_whole(tmp_path):
    run = record_pendulum(tmp_path / "cut.rrd", 600)
    data = (tmp_path / "cut.rrd").read_bytes()
    (tmp_path / "cut.rrd").write_bytes(data[: int(0.4 * len(data))])
    (cut,) = km.bench.inspect_logs([tmp_path], repair=True)
    assert "ends after step" in cut.cut
    assert 0 < cut.values["steps"] < 600
    np.testing.assert_array_equal(km.load_run(cut.repaired).X, run.X[: cut.values["steps"] + 1])


def test_every_run_of_a_sweep_replays_to_the_bit(swept):
    for row in swept[0]:
        found = km.bench.replay_log(row.log)
        assert found.differences == (), row.name
        assert str(found).startswith("the same to the bit: ")


def test_a_problem_that_has_changed_since_is_told(swept, tmp_path):
    rows = km.sweep([km.load_problem(write(tmp_path))], ["lqr"], folder=tmp_path / "logs")
    write(tmp_path, **{"Q=1.0": "Q=3.0"})
    found = km.bench.replay_log(rows[0].log)
    differences = found.differences
    assert str(found) == "not the same: " + "\n".join(differences)
    assert any(each.startswith("U from step 0") for each in differences)
    assert "cost: the problem has changed since" in differences
    run = km.load_run(rows[0].log)
    km.record(replace(run, metadata={}), tmp_path / "own.rrd")
    with pytest.raises(km.errors.LogError, match="does not say which problem, case and controller ran"):
        km.bench.replay_log(tmp_path / "own.rrd")


def test_a_run_of_your_own_replays_with_the_plant_and_the_controller_that_ran(tmp_path):
    problem, log = km.load_problem("pendulum:upright"), tmp_path / "own.rrd"
    plant = km.discretize(problem.dynamics, problem.dt)
    mpc = km.LinearMPC(plant, *problem.equilibrium, problem.cost, problem.limits, 20)
    about = {"x0": [0.5, 0], "reference": [0, 0], "steps": 60}
    km.record(
        km.simulate(plant, mpc, **about, options=km.loop.LoopOptions(noise=[0.01, 0.01]), limits=problem.limits), log
    )
    assert km.bench.replay_log(log, plant=plant, controller=mpc).differences == ()
    slower = km.LinearMPC(plant, *problem.equilibrium, problem.cost, problem.limits, 3)
    heavier = km.discretize(replace(problem.dynamics, m=1.01 * problem.dynamics.m), problem.dt)
    assert [each.split()[0] for each in km.bench.replay_log(log, plant=heavier).differences] == ["X"]
    assert "U from step 0 on" in km.bench.replay_log(log, controller=slower).differences
    km.record(
        km.simulate(plant, mpc, **about, options=km.loop.LoopOptions(faults=[km.faults.DroppedSamples(0.2)])), log
    )
    with pytest.raises(km.errors.LogError, match="is of a run with faults, DroppedSamples"):
        km.bench.replay_log(log, controller=mpc)


def test_the_log_of_a_model_says_what_it_is_and_where_its_forecasts_are_worst(tmp_path, swept):
    rng = np.random.default_rng(0)
    data = km.Episodes([km.Episode(X=rng.normal(size=(30, 2)), U=rng.normal(size=(29, 1))) for _ in range(4)], 0.1)
    model, log = km.edmd(data, km.State() + km.Constant()), tmp_path / "model.rrd"
    km.recording.record_model(model, data, log, horizon=5, rollouts=2)
    (found,) = km.bench.inspect_logs([log])
    errors = km.score(model, data, 5).rmse
    said = str(found)
    assert found.title == f"model of {', '.join(model.states)}"
    for i, state in enumerate(model.states):
        assert f"error of {state}" in said
        assert f"{errors[0, i]:.3g} after 1, {errors[2, i]:.3g} after 3, {errors[4, i]:.3g} after 5 steps" in said
        gaps = [np.abs(model.rollout(e.X[0], e.U[:5])[:, i] - e.X[:6, i]) for e in list(data)[:2]]
        r = int(np.argmax([gap.max() for gap in gaps]))
        k = int(np.argmax(gaps[r]))
        assert (k, f"largest error of {state}: {gaps[r][k]:.4g}, episode {r}") in [(m.k, m.what) for m in found.moments]
    assert [each.path for each in km.bench.inspect_logs([tmp_path], "spectral_radius > 0")] == [log]
    assert list(km.bench.inspect_logs([tmp_path], "violation > 0")) == []
    with pytest.raises(km.errors.LogError, match="koopmpc-model-1"):
        km.load_run(log)
