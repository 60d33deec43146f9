"""km.next_experiment: safe plans that teach where the loop works, their bands, files and sentences."""

import csv
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from koopmpc.experiment.ensemble import Ensemble, fit_ensemble, stack_regressors
from koopmpc.experiment.planner import Planner, _name_terms
from koopmpc.experiment.standing import check_standing
from koopmpc.experiment.visits import weigh_visits
from koopmpc.lifting.base import strip_unit


@dataclass(frozen=True)
class Cart(km.Dynamics):
    """A cart with drag on a track."""

    states = ("x [m]", "v [m/s]")
    inputs = ("F [N]",)

    def rhs(self, x, u):
        return ca.vertcat(x[1], u[0] - 0.5 * x[1])


CART = km.discretize(Cart(), dt=0.1)
COST = km.Cost(Q=[1, 0.1], R=0.1)
LIMITS = km.Limits(u_min=-2, u_max=2, du_max=1.5, x_min=[-2, -1], x_max=[2, 1])


def log_noisily(plant, x0, excitation, sigma, **more):
    clean = km.collect(plant, x0, excitation, **more)
    rng = np.random.default_rng(more.get("rng", 0))
    noisy = [km.Episode(X=e.X + sigma * rng.standard_normal(e.X.shape), U=e.U) for e in clean]
    return km.Episodes(noisy, clean.dt, clean.states, clean.inputs)


@pytest.fixture(scope="module")
def logs():
    return log_noisily(CART, [0.5, 0.0], km.Noise(-0.2, 0.2, hold=3), 0.002, episodes=4, steps=30)


@pytest.fixture(scope="module")
def plan(logs):
    return km.next_experiment(logs, COST, LIMITS, reference=[1, 0], steps=80, episodes=2, rng=1)


def test_inputs_and_bands_keep_all_limits(plan):
    assert (np.abs(plan.U) <= 2 + 1e-12).all()
    assert (np.abs(np.diff(plan.U, axis=1)) <= 1.5 + 1e-12).all()
    assert (plan.low[:, 1:] >= [-2, -1]).all()
    assert (plan.high[:, 1:] <= [2, 1]).all()
    assert (plan.low <= plan.X).all()
    assert (plan.high >= plan.X).all()
    assert plan.U.shape == (2, 80, 1)
    assert plan.X.shape == (2, 81, 2)


def test_all_members_begin_where_the_plan_begins(logs, monkeypatch):
    begun, simulate = [], Ensemble.simulate

    def watched(self, start, *more):
        begun.append(start)
        return simulate(self, start, *more)

    monkeypatch.setattr(Ensemble, "simulate", watched)
    plan = km.next_experiment(logs, COST, LIMITS, reference=[1, 0], steps=12, rng=1)
    for start in begun[-2:]:  # the candidates on the model alone, and the best ones on all members
        np.testing.assert_array_equal(start, np.tile(plan.X[0, 0], (len(start), 1)))
    assert 1 < len(begun[-1]) < len(begun[-2])


def test_the_true_plant_keeps_limits_under_it_and_mostly_the_band(plan):
    held = []
    for seed in range(10):
        new = log_noisily(CART, plan.starts, plan, 0.002, episodes=2, steps=80, rng=seed)
        assert all((np.abs(e.X) <= [2.02, 1.01]).all() for e in new)
        held += plan.review(new).held
    assert np.mean(held) >= 0.8


def test_planned_rows_lower_the_variance_as_promised(logs, plan):
    assert plan.is_worth_it
    assert 0 <= plan.after < plan.before
    both = logs.with_episodes([*logs, *log_noisily(CART, plan.starts, plan, 0.002, episodes=2, steps=80)])
    again = km.next_experiment(both, COST, LIMITS, reference=[1, 0], steps=80, episodes=2, rng=1)
    assert again.gain < plan.gain
    assert "worth" in again.verdict or again.is_worth_it


def test_much_data_leave_nothing_to_learn():
    much = log_noisily(CART, km.Uniform([-1, -0.5], [1, 0.5]), km.Noise(-2, 2, hold=3), 0.002, episodes=60, steps=60)
    plan = km.next_experiment(much, COST, LIMITS, reference=[0, 0], steps=40)
    assert not plan.is_worth_it
    assert "another experiment is not worth its length" in str(plan)
    assert "nothing is left" in plan.verdict


def test_a_plan_that_is_only_too_short_asks_for_a_longer_one(logs):
    plan = km.next_experiment(logs, COST, LIMITS, reference=[1, 0], steps=1)
    assert not plan.is_worth_it
    assert "is left to learn, so a longer one may be worth it" in plan.verdict


def test_the_gain_is_that_of_the_information_matrix(logs):
    rng = np.random.default_rng(0)
    model = km.edmd(logs, km.State() + km.Constant())
    ensemble = fit_ensemble(model, logs, rng)
    known = [(e.X[:-1], e.U) for e in logs]
    visits = weigh_visits(ensemble, rng.normal(size=(50, 2)), rng.normal(size=(50, 1)), known, rng)
    rows = visits.inform(rng.normal(size=(30, 2)), rng.normal(size=(30, 1)))
    one_by_one, information = 0.0, visits.information
    for row in rows:  # the matrix inversion lemma, row by row, is an independent oracle
        inverse = np.linalg.inv(information)
        drop = (visits.rows @ inverse @ row) ** 2 / (1 + row @ inverse @ row)
        one_by_one += float(visits.weights @ drop)
        information = information + np.outer(row, row)
    assert visits.gain(rows, visits.information) == pytest.approx(one_by_one, rel=1e-6)
    assert visits.spread_gain(rows) == pytest.approx(
        0.5 * (np.linalg.slogdet(information)[1] - np.linalg.slogdet(visits.information)[1])
    )
    assert visits.weights.sum() == pytest.approx(1.0)


def test_collect_gives_each_episode_its_own_plan(plan):
    new = km.collect(CART, plan.starts, plan, episodes=2, steps=80)
    assert not np.allclose(new[0].U, new[1].U)
    for e, episode in enumerate(new):
        assert np.allclose(plan.choose_episode(e).U[0], plan.U[e])
        assert np.abs(episode.U).max() <= 2 + 1e-12


def test_realtime_and_simulate_take_a_plan(plan):
    run = km.simulate(CART, plan, x0=plan.starts[0], reference=[0, 0], steps=80)
    same = km.collect(CART, plan.starts[0], plan.choose_episode(0), episodes=1, steps=80)
    assert np.allclose(run.U, same[0].U)
    plant = km.plants.SimulatedPlant(CART)
    done = km.realtime(plan, plant, dt=0.1, reference=[0, 0], steps=2, x0=plan.starts[0])
    assert done.steps == 2


def test_noise_drives_simulate_as_it_drives_collect():
    run = km.simulate(CART, km.PRBS(-1, 1), x0=[0, 0], reference=[0, 0], steps=30)
    assert set(np.unique(run.U)) == {-1.0, 1.0}


def test_the_file_holds_the_plan(plan, tmp_path):
    plan.save(tmp_path / "plan.csv")
    lines = [line for line in (tmp_path / "plan.csv").read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert len(rows) == 2 * 81
    U = np.array([float(row["F [N]"]) for row in rows]).reshape(2, 81)
    assert np.allclose(U[:, :-1], plan.U[:, :, 0])
    high = np.array([float(row["high x [m]"]) for row in rows]).reshape(2, 81)
    assert np.allclose(high, plan.high[:, :, 0])
    with pytest.raises(km.errors.DataError, match=r"does not end with \.csv"):
        plan.save(tmp_path / "plan.xlsx")


def test_the_words_say_when_to_stop(plan):
    assert "x is below -2 or above 2 m" in plan.abort_rules
    assert "3 steps in sequence" in plan.abort_rules
    assert "teaches" in str(plan)


def test_an_aborted_experiment_is_named(plan):
    half = km.collect(CART, plan.starts, plan, episodes=2, steps=30)
    assert "ends after 30 of 80 steps: the experiment was aborted" in str(plan.review(half))
    assert plan.review(half).steps == (30, 30)


def test_each_log_of_an_experiment_is_said_to_stay_inside_its_band_or_to_leave_it(plan):
    episodes = [
        km.Episode(X=(low + high) / 2, U=np.zeros((80, 1))) for low, high in zip(plan.low, plan.high, strict=True)
    ]
    X = np.array(episodes[1].X)
    X[7, 1] = plan.high[1, 7, 1] + 0.01
    found = plan.review(km.Episodes([episodes[0], km.Episode(X=X, U=episodes[1].U)], plan.dt, plan.states, plan.inputs))
    assert found.held == (True, False)
    assert found.sentences[0] == "log 0 stays inside the band"
    assert found.sentences[1].startswith("log 1 leaves the band at step 7: ")
    assert len(found.sentences) == 2


def test_the_terms_of_a_model_are_named_as_its_regressors_stand(logs):
    lifting = km.State() + km.Constant() + km.Monomials(2)
    model = km.bilinear_edmd(logs, lifting, ridge=1e-6)
    names, point = _name_terms(model), np.array([0.5, 0.25])
    values = {strip_unit(name): value for name, value in zip(model.lifting.names, model.lifting(point), strict=True)}
    u = strip_unit(model.inputs[0])
    expected = [values.get(name, 3.0 * values.get(name.removeprefix(f"{u} × "), 1.0)) for name in names]
    regressors = stack_regressors(model.lifting(point)[None], np.array([[3.0]]), np.zeros((1, 0)), bilinear=True)
    np.testing.assert_allclose(regressors[0], expected)
    assert names.count(u) == 2  # alone, and times the Constant
    assert len(set(names)) == len(names) - 1


def test_a_past_is_as_wide_as_the_room_of_its_states_and_inputs(logs, monkeypatch):
    widths, find = [], Planner._widths

    def watched(self, point):
        widths.append((find(self, point), self.asked.high - self.asked.low))
        return widths[-1][0]

    monkeypatch.setattr(Planner, "_widths", watched)
    model = km.edmd(logs, km.State() + km.Constant(), embedding=km.Delay(1), ridge=1e-6)
    km.next_experiment(logs, COST, LIMITS, reference=[1, 0], steps=12, rng=1, model=model)
    for found, states in widths:
        assert found.tolist() == [*states, 4.0, *states]  # x_k, u_{k-1}, x_{k-1}: inputs from -2 to 2
    assert widths


def test_set_points_are_planned_for_a_standing_controller():
    model = km.LinearPredictor.local(CART, [0, 0], [0])
    standing = km.LQR(model, km.Cost(Q=[4, 1], R=1), km.Limits(u_min=-2, u_max=2))
    data = log_noisily(CART, [0, 0], km.Feedback([[1.5, 1.2]], km.Noise(-0.1, 0.1)), 0.001, episodes=4, steps=40)
    plan = km.next_experiment(data, COST, LIMITS, reference=[0.5, 0], controller=standing, steps=40)
    assert plan.set_points.shape == (1, 41, 2)
    assert "set points" in str(plan)
    new = km.collect(CART, plan.starts, plan, episodes=1, steps=40)
    assert np.allclose(new[0].U[:20], np.clip(plan.U[0, :20], -2, 2), atol=0.1)
    assert not check_standing(standing, data)
    idle = log_noisily(CART, [0, 0], km.Noise(-0.3, 0.3), 0.001, episodes=4, steps=40)
    assert "the standing controller is not in the logs" in check_standing(standing, idle)[0]


def test_an_unstable_plant_is_held_with_delays_too():
    pendulum = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    pd = km.Feedback([[40, 15]], km.Noise(-3, 3), u_min=-25, u_max=25)
    data = log_noisily(pendulum, [0.1, 0.0], pd, 0.001, episodes=6, steps=40)
    cost = km.Cost(Q=[10, 1], R=0.1)
    limits = km.Limits(u_min=-25, u_max=25, x_min=[-1, -4], x_max=[1, 4])
    for embedding in (None, km.Delay(1)):
        model = km.edmd(data, km.State() + km.Constant(), embedding=embedding, ridge=1e-8)
        plan = km.next_experiment(
            data, cost, limits, reference=[0, 0], model=model, starts=[0.05, 0], steps=60, level=0.8
        )
        assert plan.K.any()
        new = log_noisily(pendulum, plan.starts, plan, 0.001, episodes=1, steps=60)
        assert (np.abs(new[0].X) < [1, 4]).all()


def test_the_seed_decides_all(logs, plan):
    again = km.next_experiment(logs, COST, LIMITS, reference=[1, 0], steps=80, episodes=2, rng=1)
    assert np.array_equal(plan.U, again.U)
    assert np.array_equal(plan.high, again.high)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"reference": None}, "no reference is given"),
        ({"starts": [3, 0]}, "a start is outside the limits: x = 3 m"),
        ({"starts": [-1.9, 0.9]}, "a start is outside the data"),
        ({"level": 1.5}, "pass a probability"),
        ({"limits": km.Limits(u_min=-2, u_max=2, x_min=[0.49, -0.02], x_max=[0.51, 0.02]), "starts": [0.5, 0]}, "no safe plan exists"),
        ({"limits": km.Limits(x_min=[-9, -1], x_max=[-8, 1])}, "no row of the data is inside the limits"),
        ({"controller": km.LQR(km.LinearPredictor.local(km.discretize(Cart(), 0.2), [0, 0], [0]), COST)}, "dt = 0.2"),
    ],
)  # fmt: skip
def test_what_cannot_be_planned_is_said(logs, more, words):
    call = {"cost": COST, "limits": LIMITS, "reference": [1, 0], "steps": 60} | more
    with pytest.raises(km.KoopmpcError, match=words):
        km.next_experiment(logs, **call)


def test_a_duration_shorter_than_the_past_is_refused(logs):
    model = km.edmd(logs, km.State(), embedding=km.Delay(5))
    with pytest.raises(km.errors.DataError, match="not longer than the 5 past steps"):
        km.next_experiment(logs, COST, LIMITS, reference=[1, 0], model=model, steps=4)
    still = logs.with_episodes([km.Episode(X=e.X) for e in logs]) if not logs.nu else None
    assert still is None
    with pytest.raises(km.errors.DataError, match="no inputs"):
        km.next_experiment(km.Episodes([km.Episode(X=e.X) for e in logs], 0.1), COST, LIMITS, reference=[1, 0])


def test_inputs_that_never_move_ask_for_a_first_log_by_hand():
    idle = km.Episodes([km.Episode(X=np.zeros((30, 2)), U=np.zeros((29, 1)))] * 3, 0.1)
    with pytest.raises(km.errors.DataError, match="u0 never moves in the data"):
        km.next_experiment(idle, COST, LIMITS, reference=[0, 0])


def test_limits_of_observables_hold_for_the_band(logs):
    limits = km.Limits(u_min=-2, u_max=2, of=km.Monomials(2, states=[1]), y_min=-1, y_max=0.25)
    plan = km.next_experiment(logs, COST, limits, reference=[1, 0], steps=60)
    assert (np.maximum(np.abs(plan.low), np.abs(plan.high))[:, 1:, 1] ** 2 <= 0.25 + 1e-9).all()


def test_the_picture_shows_plan_and_log(plan, tmp_path):
    new = km.collect(CART, plan.starts, plan, episodes=2, steps=80)
    drawing = km.plot.plan(plan, 1, log=new)
    assert len(drawing.axes) == 3
    km.plot.save(drawing, tmp_path / "plan.png")
    with pytest.raises(km.errors.ShapeError, match="pass the logs of this plan"):
        km.plot.plan(plan, 1, log=new[:1])


def test_a_dollar_in_a_name_is_a_letter_and_a_long_name_gets_lines_of_its_own(plan, tmp_path):
    long = "temperature of the upper vessel [degC]"
    drawing = km.plot.plan(replace(plan, states=(long, "b"), inputs=("a $u_{$ [N]",)))
    km.plot.save(drawing, tmp_path / "plan.png")
    assert drawing.axes[0].get_ylabel().count("\n") >= 1


@pytest.mark.slow
def test_a_design_gives_reference_model_and_controller():
    data = log_noisily(CART, km.Uniform([-0.5, -0.2], [0.5, 0.2]), km.Noise(-1, 1, hold=4), 0.002, episodes=8, steps=40)
    with km.errors.hide_fit_warnings():
        designed = km.design(
            data, COST, LIMITS, reference=[0.4, 0], horizon=12, bilinear=False, delays=(0,), loops=0, tighten=False
        )
    plan = km.next_experiment(data, COST, LIMITS, design=designed, steps=60)
    assert (plan.low[:, 1:] >= [-2, -1]).all()
    assert (plan.high[:, 1:] <= [2, 1]).all()
    assert plan.after < plan.before
