"""A Problem refuses what does not fit, with what was got and what to do."""

from dataclasses import replace

import pytest

import koopmpc as km
from tests.apps.tiny import write


@pytest.fixture
def problem(tmp_path):
    return km.load_problem(write(tmp_path))


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"cases": {}}, km.errors.DataError, "needs at least one case"),
        ({"cases": {"bad": km.Case([1.0, 2.0], [0.0], 3)}}, km.errors.ShapeError,
            r"case 'bad': x0 has shape \(2,\), expected \(1,\)"),
        ({"equilibrium": ([0.0, 0.0], [0.0])}, km.errors.ShapeError, r"equilibrium x has shape \(2,\)"),
        ({"equilibrium": ([float("nan")], [0.0])}, km.errors.DataError, "equilibrium x holds 1 NaN"),
        ({"dt": 0.0}, km.errors.DataError, "dt is 0 s; it must be above zero"),
        ({"horizon": 0}, km.errors.DataError, "horizon is 0; it must be at least 1"),
        ({"ridge": -1.0}, km.errors.DataError, "ridge is -1; it must be zero or above"),
        ({"angles": (1,)}, km.errors.DataError, "angles holds 1; pass indices of states, 0 to 0"),
        ({"cases": {"bad": km.Case([1.0], [0.0, 0.0], 3)}}, km.errors.ShapeError,
            r"case 'bad': reference has shape \(2,\), expected \(1,\) or \(steps\+1, nr\) = \(4, 1\)"),
        ({"cases": {"bad": km.Case([1.0], [[0.0]] * 3, 3)}}, km.errors.ShapeError,
            r"case 'bad': reference has shape \(3, 1\), expected"),
        ({"cost": km.Cost(Q=[1.0, 2.0], R=1.0)}, km.errors.ShapeError, r"Q has shape \(2,\), expected \(1, 1\)"),
        ({"cost": km.Cost(Q=1.0, R=[1.0, 2.0])}, km.errors.ShapeError, r"R has shape \(2,\)"),
        (
            {"cost": km.Cost(Q=1.0, R=1.0, of=km.Fourier(1, ["speed"]))},
            km.KoopmpcError,
            "speed",
        ),
        ({"limits": km.Limits(u_max=[1.0, 2.0])}, km.errors.ShapeError, r"limits: u_max has shape \(2,\)"),
        ({"limits": km.Limits(du_max=[1.0, 2.0])}, km.errors.ShapeError, r"limits: du_m.. has shape \(2,\)"),
        ({"limits": km.Limits(x_min=[0.0, 0.0])}, km.errors.ShapeError, r"limits: x_min has shape \(2,\)"),
        ({"limits": km.Limits(of=km.Fourier(1), y_max=[1.0, 1.0, 1.0])}, km.errors.ShapeError,
            r"limits: y_max has shape \(3,\), expected \(2,\)"),
        (
            {"cases": {"bad": km.Case([1.0], [0.0], 3, limits=km.Limits(u_max=[1.0, 2.0]))}},
            km.errors.ShapeError,
            r"case 'bad': limits: u_max has shape \(2,\)",
        ),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(problem, change, error, text):
    with pytest.raises(error, match=text):
        replace(problem, **change)


@pytest.mark.parametrize("name", ["up/down", "up\\down", "a:b", "two words", "line\nend", ""])
def test_a_case_is_named_as_a_file_can_be(problem, name):
    with pytest.raises(km.errors.DataError, match="its logs are named after it: leave out spaces"):
        replace(problem, cases={name: km.Case([1.0], [0.0], 3)})


@pytest.mark.parametrize("reference", [0.0, [0.0], [[0.0]] * 4])
def test_every_form_of_a_reference_that_simulate_takes_fits(problem, reference):
    assert replace(problem, cases={"good": km.Case([1.0], reference, 3)}).cases.keys() == {"good"}


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"equilibrium": ([21.0, 25.0], [1.0])}, km.errors.ShapeError, r"has 2 parts; pass \(x, u, w\)"),
        ({"equilibrium": ([21.0, 25.0], [1.0], [2.0, 3.0])}, km.errors.ShapeError, r"equilibrium w has shape \(2,\)"),
        ({"cases": {"bad": km.Case([20.0, 20.0], [21.0], 3)}}, km.errors.DataError,
            r"case 'bad': the plant has measured disturbances \(outside \[°C\]\); pass measured=, a row a step"),
        (
            {"cases": {"bad": km.Case([20.0, 20.0], [21.0], 3, measured=[[1.0]] * 4)}},
            km.errors.ShapeError,
            r"case 'bad': measured has shape \(4, 1\), expected \(1,\) or \(3, 1\): a row a step, a column for outside",
        ),
        (
            {"training": km.Training([20.0, 20.0], km.Noise(0, 4), episodes=2, steps=3)},
            km.errors.DataError,
            r"training: the plant has measured disturbances",
        ),
        (
            {"training": km.Training([20.0, 20.0], km.Noise(0, 4), episodes=2, steps=3, measured=[[1.0]] * 2)},
            km.errors.ShapeError,
            r"training: measured has shape \(2, 1\), expected \(1,\) or \(3, 1\) or \(2, 3, 1\)",
        ),
        ({"plant": km.load_problem("pendulum").dynamics}, km.errors.ShapeError,
            "the problem: its plant has 0 measured disturbances, the dynamics 1"),
    ],
)  # fmt: skip
def test_measured_disturbances_that_do_not_fit_are_refused(change, error, text):
    with pytest.raises(error, match=text):
        replace(km.load_problem("heat_pump"), **change)


def test_a_plant_without_disturbances_refuses_their_values(problem):
    with pytest.raises(km.errors.DataError, match=r"case 'bad': measured is given, but the dynamics name no dist"):
        replace(problem, cases={"bad": km.Case([1.0], [0.0], 3, measured=[1.0])})
    with pytest.raises(km.errors.DataError, match=r"training: measured is given, but the dynamics name no dist"):
        replace(problem, training=replace(problem.training, measured=[1.0]))
    with pytest.raises(km.errors.DataError, match=r"Case\.measured holds 1 NaN"):
        km.Case([1.0], [0.0], 3, measured=[float("nan")])
    with pytest.raises(km.errors.DataError, match=r"Training\.measured holds 1 NaN"):
        km.Training([1.0], km.Noise(0, 4), episodes=2, steps=3, measured=[float("nan")])
    disturbed = km.load_problem("heat_pump").dynamics
    with pytest.raises(km.errors.ShapeError, match="case 'bad': its plant has 1 measured disturbances, the dynamics 0"):
        replace(problem, cases={"bad": km.Case([1.0], [0.0], 3, plant=disturbed)})


def test_a_case_needs_steps_and_numbers():
    with pytest.raises(km.errors.DataError, match=r"Case\.steps is 0; it must be at least 1"):
        km.Case([0.0], [0.0], 0)
    with pytest.raises(km.errors.DataError, match=r"Case\.x0 holds 1 NaN"):
        km.Case([float("nan")], [0.0], 3)


def test_training_needs_episodes():
    with pytest.raises(km.errors.DataError, match=r"Training\.episodes is 0"):
        km.Training([0.0], lambda k, y, rng: [0.0], episodes=0, steps=3)


def test_select_keeps_all_but_the_other_cases(problem):
    one = problem.select("far")
    assert list(one.cases) == ["far"]
    assert one.dynamics is problem.dynamics
    with pytest.raises(km.errors.ProblemError, match=r"'tiny' has no case 'fra', did you mean 'far'\?"):
        problem.select("fra")


@pytest.mark.parametrize(("name", "wrong"), [("pendulum", ([0.3, 0.0], [0.0])), ("cart_pole", ([0.0] * 4, [5.0]))])
def test_a_point_where_the_plant_does_not_rest_is_named(name, wrong):
    with pytest.warns(
        UserWarning,
        match=r"the equilibrium does not rest: from it '(omega|velocity).*' moves by .* in one step of 0\.0",
    ):
        replace(km.load_problem(name), equilibrium=wrong)
