"""Fresh loops of a design, and what it says of places without data, of loads, and of logs that cannot serve it."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats.qmc import Halton

import koopmpc as km
from tests.closed_loop.controllers import Parts
from tests.closed_loop.judge import judged
from tests.closed_loop.more_tasks import ALL, MORE
from tests.closed_loop.optimum import held, optimum
from tests.compiler import needs_compiler
from tests.searches import design
from tests.synthesis.test_design import LIMITS, data, designed, mass
from tests.synthesis.test_loops import make_task, spring, spring_logs
from tests.synthesis.test_select import PLAIN, episodes_of


@cache
def fresh():
    return designed(data(count=15), loops=24)


def test_the_fresh_loops_of_a_design_are_counted_by_kind_and_give_its_bounds():
    expected = fresh().expected
    counts = dict(expected.loops)
    assert counts["neighbours"] + counts["models"] == 24
    assert min(counts.pop("neighbours"), counts.pop("models")) > 0
    assert counts == {"choice": 6, "choice, inputs 20 % off": 6, "corners": 4}
    assert expected.lost_bound == pytest.approx(1 - 0.05 ** (1 / 24))  # Clopper and Pearson without a failure
    low, high = expected.cost_interval
    assert low <= np.median(expected.fresh.cost) <= high
    assert expected.violation_bound <= expected.fresh.violation.max()
    assert "fresh loops" in str(expected)
    told = " ".join(str(expected).split())
    assert "6 in the choice, 6 there with inputs 20 % off, " in told
    assert " fresh on learned models, " in told
    assert "4 from corners of the goal's range" in told


def test_fresh_loops_change_no_choice():
    without = designed(data(count=15))
    assert without.leaderboard == fresh().leaderboard
    assert without.controller.predictor == fresh().controller.predictor
    assert without.expected.fresh is None


def diagonal(count=20):
    """Return logs of two decayed states that are always nearly equal: each has its range, and the plane is unknown."""
    rng, runs = np.random.default_rng(0), []
    for _ in range(count):
        X, U = [np.repeat(rng.uniform(-1, 1), 2)], rng.uniform(-1, 1, (30, 1))
        for u in U:
            X.append(0.9 * X[-1] + 0.1 * u + 0.002 * rng.standard_normal(2))
        runs.append(km.Episode(X=np.array(X), U=U))
    return km.Episodes(runs, 0.1)


@cache
def narrow():
    return designed(diagonal(), limits=km.Limits(u_min=-1, u_max=1), loops=6)


def test_starts_to_record_lie_outside_the_data_far_from_each_other():
    made = narrow()
    X, task = made.starts_to_record(12), made.evidence.task
    assert X.shape == (12, 2)
    assert ((task.low <= X) & (task.high >= X)).all()
    assert made.evidence.neighbours.find_outside_states(X).all()
    assert abs(X[0, 0] - X[0, 1]) == pytest.approx(np.abs(np.diff(made.starts_to_record(256))).max(), rel=0.2)
    assert (made.starts_to_record(3) == X[:3]).all()


def test_the_picture_of_blindness_shows_data_and_range_and_where_to_record(tmp_path):
    figure = km.plot.blindness(narrow())
    panel = figure.axes[0]
    assert "of the goal's range has no data around it" in panel.get_title()
    drawn = {line.get_label(): len(line.get_xdata()) for line in panel.get_lines()}
    assert drawn["record from here"] == 6
    task, rows = narrow().evidence.task, narrow().evidence.neighbours
    probes = task.low + (task.high - task.low) * Halton(2, scramble=False).random(256)
    assert drawn["range without data"] == rows.find_outside_states(probes).sum() > 0
    km.plot.save(figure, tmp_path / "blind.png")
    assert (tmp_path / "blind.png").stat().st_size > 5000
    with pytest.raises(km.errors.DataError, match="both axes are"):
        km.plot.blindness(narrow(), axes=(1, 1))


def test_the_picture_of_blindness_says_where_the_reference_is_outside():
    asked, drawn = narrow().evidence.task, []
    for row in ([0.1, 0.1], [0.8, -0.8], [9.0, 9.0]):
        evidence = replace(narrow().evidence, task=replace(asked, reference=np.array([row])))
        panel = km.plot.blindness(replace(narrow(), evidence=evidence)).axes[0]
        shown = {line.get_label(): len(line.get_xdata()) for line in panel.get_lines()}
        drawn.append((shown["reference outside the data"], "the reference lies outside" in panel.get_title()))
    assert drawn == [(0, False), (1, True), (1, True)]


def test_a_design_without_rows_of_its_data_has_no_picture():
    old = replace(narrow(), evidence=replace(narrow().evidence, neighbours=None))
    for ask in (km.plot.blindness, type(old).starts_to_record):
        with pytest.raises(km.errors.DataError, match="keeps no rows of its data"):
            ask(old)


def test_advice_on_limits_is_of_the_controller_that_is_returned():
    """Its fresh loops say it, and no loop of the choice, which had another end of its plans or another model."""
    for made in (fresh(), narrow()):
        over = made.expected.fresh.violation[np.isfinite(made.expected.fresh.violation)]
        said = [sentence for sentence in made.advice if sentence.startswith("limits are violated by up to")]
        assert len(said) == (np.mean(over > 0.01) > 0.01)
        assert all(f"in {np.sum(over > 0.01)} of {len(made.expected.fresh.violation)} fresh loops" in s for s in said)


def test_a_designed_controller_says_whether_a_step_is_known():
    controller = fresh().controller
    controller.reset()
    assert controller([0.1, 0.0], [0.0, 0.0]).known
    controller.reset()
    assert not controller([500.0, 400.0], [0.0, 0.0]).known


@pytest.mark.slow
def test_a_design_says_where_its_loops_last_longer_than_every_episode():
    found = designed(data(), horizon=3, limits=replace(LIMITS, u_min=-0.2, u_max=0.2), loops=0)
    assert found.expected.steps > 30
    assert any(f"loops take {found.expected.steps} steps, until a linear loop" in note for note in found.notes)
    reference = 0.2 * np.sin(np.arange(200) / 20)[:, None] * [1.0, 0.0]
    moves = designed(data(), horizon=3, reference=reference, loops=0)
    assert moves.expected.steps == 120
    assert any("loops take 120 steps, since the reference moves" in note for note in moves.notes)


@needs_compiler
@pytest.mark.slow
def test_a_design_counts_the_loops_of_its_finalists():
    found = designed(episodes_of(mass, count=9, steps=30), candidates=[PLAIN, PLAIN + km.Monomials(2)], loops=6)
    assert found.expected.loops["finalists"] == 2 * 60 + 480
    assert "of all finalists" in str(found.expected)


@pytest.mark.slow
def test_a_linear_finalist_that_is_taken_is_the_linear_controller_of_the_design_too(monkeypatch):
    monkeypatch.setattr("koopmpc.synthesis.confirm.list_finalists", lambda rows, best: [i for i in (0, 1) if i != best])
    monkeypatch.setattr("koopmpc.synthesis.confirm.choose_finalist", lambda *_: (1, 0, "it is safer"))
    plants = episodes_of(mass, count=9, steps=30)
    found = designed(plants, candidates=[PLAIN, PLAIN + km.Monomials(2)], bilinear=False, loops=2)
    assert any("takes the place of" in note for note in found.notes)
    assert found.chosen_linear == found.chosen
    assert found.linear is found.controller


@pytest.mark.slow
def test_where_each_signal_is_inside_but_no_log_has_both_the_design_says_so_and_holds():
    """A lifted model promised 0 of 60 lost and cost 1.43 and 2.54 times the optimum from two such starts."""
    parts = Parts(MORE["off the diagonal"], 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)
        advice = parts.design.advice
    assert any("of the goal's range" in sentence and "at the same time" in sentence for sentence in advice)
    for start in range(len(parts.task.starts)):
        alone, guarded = (judged(parts, name, start).ratio for name in ("designed", "guarded"))
        assert max(guarded, alone) < 1.05


@pytest.mark.slow
def test_plans_too_short_to_stop_before_a_limit_end_where_it_can_be_kept():
    """With this horizon the design went 12 % of the range beyond its limit."""
    parts = Parts(MORE["short horizon"], 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)
        notes = parts.design.notes
    assert any("6 steps are too short to stop before a limit" in note for note in notes)
    row = judged(parts, "designed", 0)
    assert row.ratio < 1.02
    assert row.violation < 0.005
    assert parts.design.controller.horizon == parts.task.horizon


@pytest.mark.slow
def test_the_heater_with_a_hidden_lag_stays_on():
    """A design of such logs once switched it off for ever; now it says that a state is hidden, and tries past rows."""
    task = MORE["hidden lag"]
    found = designed(
        task.data(0),
        km.Cost(Q=task.Q, R=task.R),
        task.limits,
        horizon=task.horizon,
        reference=task.reference,
        candidates=[km.State() + km.Constant()],
        delays=None,
    )
    assert any(sentence.startswith("a hidden state shows") for sentence in (*found.notes, *found.advice))
    assert max(row.recipe.candidate.delays for row in found.leaderboard) == 4
    for x0 in ([0.9, 22.0, 0.0], [0.35, 38.0, 40.0], [0.94, 28.6, 0.0]):
        run = km.simulate(task.plant, found.controller, x0=x0, reference=task.reference, steps=task.steps)
        assert np.abs(run.X[-1, :2] - task.reference).max() < 0.2
        assert 20 < run.U[-5:, 1].mean() < 35


@pytest.mark.slow
def test_a_design_with_noise_promises_what_fresh_loops_keep():
    *_, data, _ = make_task()
    rng = np.random.default_rng(1)
    noisy = data.with_episodes([km.Episode(X=e.X + 0.03 * rng.normal(size=e.X.shape), U=e.U) for e in data])
    limits = km.Limits(u_min=-2, u_max=2, x_min=[-np.inf, -0.5], x_max=[np.inf, 0.5])
    task = {"horizon": 10, "reference": [0.0, 0.0], "bilinear": False, "workers": 1}
    made = design(noisy, km.Cost(Q=[1, 0.1], R=0.01), limits, margin=0.9, **task)
    assert made.promise.holds
    assert f"for {made.promise.steps} steps" in str(made.promise)
    assert (made.expected.fresh.violation > 0.01).mean() <= 0.2


PERIOD = 60  # steps of the sine of both tasks


@pytest.mark.slow
def test_a_design_of_noisy_logs_leaves_no_offset_under_a_constant_load():
    """Without loads in its trial loops it left 0.061, for an estimator only brought noise."""
    cost, limits = km.Cost(Q=[5.0, 0.1], R=0.1), km.Limits(u_min=-3.0, u_max=3.0)
    asked = {"horizon": 10, "reference": [0.0, 0.0], "candidates": [km.State()], "loops": 0, "smooth": False}
    found = design(spring_logs(0.02), cost, limits, **asked)
    run = km.simulate(
        spring(0.3),
        found.controller,
        x0=[0.5, 0.0],
        reference=[0.0, 0.0],
        steps=150,
        options=km.loop.LoopOptions(noise=[0.02] * 2, rng=0),
    )
    assert abs(run.X[-50:, 0].mean()) < 0.02
    assert found.best.recipe.estimator is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["short preview", "preview beyond"])
def test_a_sine_costs_at_most_a_tenth_more_than_the_optimum_however_little_of_it_is_seen(name):
    """Previews of a tenth of a period to two; with a reference that rests at the end of its preview 1.51 and 1.14."""
    task = ALL[name]
    least, inputs, tracked = optimum(name, 0).cost, held(name), np.ptp(task.rows, axis=0) > 0
    rows = np.sin(2 * np.pi * np.arange(400) / PERIOD)[:, None] * tracked  # it goes on behind the end of the run
    np.testing.assert_allclose(rows[: len(task.rows)], task.rows, atol=1e-12)
    cost = km.Cost(Q=task.Q, R=task.R, u_target=task.u_target)
    for share in (0.1, 1 / 6, 0.25, 0.5, 1.0, 2.0):
        N = round(share * PERIOD)
        mpc, x, spent = km.BilinearMPC(task.equations, cost, task.limits, N), np.array(task.starts[0]), 0.0
        for k in range(task.steps):
            u = mpc(x, rows[k : k + N + 1]).u
            x = task.plant(x, u)
            spent += np.array(task.Q) @ (x - rows[k + 1]) ** 2 + np.array(task.R) @ (u - inputs[k]) ** 2
        assert spent < 1.1 * least, share


def test_a_design_says_what_its_logs_cannot_serve():
    one_start = np.tile([0.5, 0.0], (9, 1))
    same = km.collect(spring(), one_start, km.Noise(-3.0, 3.0), episodes=9, steps=40, rng=0)
    with pytest.warns(km.FitWarning, match="all 9 episodes start at p = 0.5"):
        found = design(
            same,
            km.Cost(Q=[1.0, 0.1], R=0.1),
            km.Limits(u_min=-3, u_max=3),
            horizon=8,
            reference=[0.0, 0.0],
            candidates=[km.State() + km.Constant()],
            delays=[0],
            bilinear=False,
            loops=0,
        )
    assert sum("all 9 episodes start at p = 0.5" in sentence for sentence in found.advice) == 1


def test_one_episode_is_refused_in_a_sentence():
    with pytest.raises(
        km.KoopmpcError,
        match=r"one episode of [0-9]+ steps, and a choice needs two of 40 steps or more, or one of 160:",
    ):
        km.design(
            spring_logs(0.0, 1),
            km.Cost(Q=[1.0, 0.1], R=0.1),
            km.Limits(u_min=-3, u_max=3),
            horizon=40,
            reference=[0, 0],
        )
