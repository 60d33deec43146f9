"""stabilise: the feedback holds what falls over, keeps the input bounds, and gives data that a design can use."""

import warnings
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.searches import design


@dataclass(frozen=True)
class Magnet(km.Dynamics):
    """A ball below an electromagnet: m z̈ = m g − k i²/z², L di/dt = u − R i."""

    states = ("gap [m]", "speed [m/s]", "current [A]")
    inputs = ("voltage [V]",)

    def rhs(self, x, u):
        return ca.vertcat(x[1], 9.81 - 9.6e-4 * x[2] ** 2 / x[0] ** 2, (u[0] - 11 * x[2]) / 0.4)


CURRENT = float(np.sqrt(9.81 / 9.6e-4) * 0.01)


def pendulum():
    return km.discretize(km.load_problem("pendulum").dynamics, 0.05), ([0, 0], [0]), [0.8, 2.0], -15, 15


def cart_pole():
    plant = km.discretize(km.load_problem("cart_pole").dynamics, 0.05)
    return plant, ([0, 0, np.pi, 0], [0]), [3, 3, 0.5, 1.5], -40, 40


def magnet():
    return km.discretize(Magnet(), 0.005), ([0.01, 0, CURRENT], [11 * CURRENT]), [0.005, 0.2, 1.0], 0, 25


PLANTS = [pendulum, cart_pole, magnet]


def found(case, rng=0, **more):
    plant, equilibrium, reach, low, high = case()
    return km.stabilise(plant, equilibrium, reach=reach, u_min=low, u_max=high, rng=rng, **more)


@pytest.mark.parametrize("case", PLANTS)
@pytest.mark.parametrize("rng", [0, 1])
def test_the_feedback_makes_the_true_linearisation_stable_which_was_unstable(case, rng):
    plant, (x, u), *_ = case()
    A, B = plant.linearize(x, u).A, plant.linearize(x, u).B
    result = found(case, rng)
    assert np.abs(np.linalg.eigvals(A)).max() > 1.01
    assert np.abs(np.linalg.eigvals(A - B @ result.K)).max() < 0.999
    assert result.held >= 0.95


@pytest.mark.parametrize("case", PLANTS)
def test_inputs_keep_their_bounds_and_episodes_end_where_they_leave_the_reach(case):
    _, (x, _), reach, low, high = case()
    for episode in found(case).data:
        assert episode.U.min() >= low
        assert episode.U.max() <= high
        assert (np.abs(episode.X[:-1] - x) <= np.asarray(reach) + 1e-12).all()


def test_the_same_seed_gives_the_same_feedback_and_data():
    assert found(pendulum) == found(pendulum)


def test_the_input_that_holds_the_plant_is_found_where_it_was_guessed_wrong():
    plant, (x, u), reach, low, high = magnet()
    result = km.stabilise(plant, (x, [u[0] - 1.0]), reach=reach, u_min=low, u_max=high)
    assert result.feedback.u_ref[0] == pytest.approx(u[0], abs=0.3)


def test_a_plant_that_holds_its_state_is_taken_as_well():
    plant, equilibrium, reach, low, high = pendulum()
    simulated = km.plants.SimulatedPlant(plant)
    result = km.stabilise(simulated, equilibrium, reach=reach, u_min=low, u_max=high)
    assert result == found(pendulum)


def test_its_data_are_enough_for_a_model_whose_controller_holds_the_plant():
    plant, _, _, low, high = pendulum()
    model = km.edmd(found(pendulum).data, km.State() + km.Constant())
    controller = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=low, u_max=high), 15)
    run = km.simulate(plant, controller, x0=[0.3, 0.0], reference=[0, 0], steps=100)
    assert np.abs(run.X[-1]).max() < 0.02


@pytest.mark.slow
def test_its_data_are_enough_for_a_design_that_holds_the_plant():
    plant, _, _, low, high = pendulum()
    cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=low, u_max=high)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)
        made = design(
            found(pendulum).data,
            cost,
            limits,
            horizon=15,
            reference=[0, 0],
            candidates=[km.State() + km.Constant()],
            delays=[0],
            bilinear=False,
            loops=0,
            smooth=False,
        )
    run = km.simulate(plant, made.controller, x0=[0.3, 0.0], reference=[0, 0], steps=100)
    assert np.abs(run.X[-1]).max() < 0.02


def test_an_input_too_weak_to_hold_the_plant_is_told():
    plant, equilibrium, reach, *_ = pendulum()
    with pytest.warns(km.FitWarning, match="give the inputs a wider range"):
        km.stabilise(plant, equilibrium, reach=reach, u_min=-0.05, u_max=0.05, rounds=3)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"reach": [0.8, 0.0]}, "a distance above zero"),
        ({"reach": [0.8]}, "reach"),
        ({"u_min": 1.0}, "the equilibrium's input is"),
        ({"u_min": 20.0}, "u"),
        ({"u_max": np.inf}, "u_max"),
        ({"equilibrium": ([0, 0, 0], [0])}, "the equilibrium has 3 states and the plant measures 2"),
        ({"episodes": 0}, "episodes"),
    ],
)
def test_bad_arguments_are_refused_in_a_sentence(change, sentence):
    plant, equilibrium, reach, low, high = pendulum()
    given = {"equilibrium": equilibrium, "reach": reach, "u_min": low, "u_max": high} | change
    with pytest.raises(km.KoopmpcError, match=sentence):
        km.stabilise(plant, **given)


@dataclass(frozen=True)
class ReactionWheel(km.Dynamics):
    """A pendulum upright, held by the torque on a wheel at its end."""

    states = ("tilt [rad]", "rate [rad/s]", "wheel [rad/s]")
    inputs = ("torque [N m]",)

    def rhs(self, x, u):
        turn = (0.981 * ca.sin(x[0]) - u[0]) / 0.025
        return ca.vertcat(x[1], turn, u[0] / 0.004 - turn)


@pytest.mark.slow
def test_a_design_of_short_and_long_episodes_is_as_good_as_nonlinear_mpc():
    """The short episodes are larger motions, which no lifted model of the long ones holds; they take no part."""
    plant = km.discretize(ReactionWheel(), 0.02)
    data = km.stabilise(plant, ([0, 0, 0], [0]), reach=[0.4, 3, 150], u_min=-1, u_max=1).data
    assert min(map(len, data)) < 50 < max(map(len, data))
    cost, limits = km.Cost(Q=[10, 0.1, 1e-4], R=1.0), km.Limits(u_min=-1, u_max=1, x_max=[0.3, np.inf, 120])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)
        design = km.design(data, cost, limits, horizon=50, reference=[0, 0, 0])
    loop = {"x0": [0.2, 0, 0], "reference": [0, 0, 0], "steps": 300, "cost": cost, "limits": limits}
    own, best = (
        km.metrics(km.simulate(plant, one, **loop)).cost
        for one in (design.controller, km.NonlinearMPC(plant, cost, limits, 50))
    )
    assert own < 1.02 * best
