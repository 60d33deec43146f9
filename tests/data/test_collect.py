"""Collected data obey the plant, whichever way it is run."""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km

SEEDS = st.integers(0, 2**32 - 1)


@dataclass(frozen=True)
class Pendulum(km.Dynamics):
    """Hanging, driven, damped."""

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        return ca.vertcat(x[1], -9.81 * ca.sin(x[0]) - 0.1 * x[1] + u[0])


@dataclass(frozen=True)
class SeenAngle(Pendulum):
    """Only sin θ and ω are measured."""

    def measure(self, x: ca.SX) -> ca.SX:
        return ca.vertcat(ca.sin(x[0]), x[1])


class Unseen:
    """A plant of somebody else: y = 2 x, x⁺ = x + u; it counts its resets."""

    dt, states, inputs, outputs = 0.5, ("x",), ("u",), ("twice x",)
    state = None

    def __init__(self) -> None:
        self.x, self.resets = np.zeros(1), 0

    def reset(self, x0: np.ndarray, rng: np.random.Generator | int) -> np.ndarray:
        self.x, self.resets = np.array(x0), self.resets + 1
        return 2 * self.x

    def step(self, u: np.ndarray) -> np.ndarray:
        self.x = self.x + u
        return 2 * self.x


PENDULUM = km.discretize(Pendulum(), 0.05)
BOX = km.Uniform([-3, -4], [3, 4])
EXCITATIONS = {
    "noise": km.Noise(-8, 8, 3),
    "prbs": km.data.PRBS(-8, 8),
    "multisine": km.data.Multisine(8, 0.5, 4),
    "chirp": km.data.Chirp(8, 0.1, 5, 1),
    "feedback": km.Feedback([[5, 1]], km.Noise(-2, 2), u_min=-6, u_max=6),
    "function": lambda k, y, rng: -y[1] + k * rng.normal(),
}


def unstable() -> km.StepMap:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    return km.StepMap(ca.Function("F", [x, u], [x**3 + u]), 0.1)


@pytest.mark.parametrize("excitation", EXCITATIONS.values(), ids=EXCITATIONS)
def test_every_step_is_one_of_the_plant(excitation: Callable[..., object]) -> None:
    data = km.collect(PENDULUM, BOX, excitation, episodes=4, steps=25)
    assert [run.X.shape for run in data] == [(26, 2)] * 4
    for run in data:
        for x, u, x_next in zip(run.X, run.U, run.X[1:], strict=False):
            np.testing.assert_allclose(PENDULUM(x, u), x_next, rtol=1e-12, atol=1e-12)


@settings(max_examples=10)
@pytest.mark.parametrize("excitation", EXCITATIONS.values(), ids=EXCITATIONS)
@given(seed=SEEDS)
def test_the_batch_and_the_stepwise_way_agree(excitation: Callable[..., object], seed: int) -> None:
    batch = km.collect(PENDULUM, BOX, excitation, episodes=3, steps=20, rng=seed)
    stepwise = km.collect(km.plants.SimulatedPlant(PENDULUM), BOX, excitation, episodes=3, steps=20, rng=seed)
    assert (batch.dt, batch.states, batch.inputs) == (stepwise.dt, stepwise.states, stepwise.inputs)
    for a, b in zip(batch, stepwise, strict=True):
        np.testing.assert_allclose(a.X, b.X, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.U, b.U, rtol=0, atol=1e-9)


@given(SEEDS)
def test_the_same_seed_gives_the_same_data(seed: int) -> None:
    def run(rng: np.random.Generator | int) -> km.Episodes:
        return km.collect(PENDULUM, BOX, km.Noise(-8, 8), episodes=2, steps=5, rng=rng)

    assert run(seed) == run(seed) == run(np.random.default_rng(seed))
    assert run(seed) != run(seed + 1)
    assert run(seed)[0] != run(seed)[1]


def test_names_and_dt_come_from_the_plant() -> None:
    data = km.collect(PENDULUM, BOX, km.Noise(-8, 8), episodes=1, steps=2)
    assert (data.states, data.inputs, data.dt) == (Pendulum.states, Pendulum.inputs, 0.05)


@given(SEEDS)
def test_uniform_stays_in_its_box(seed: int) -> None:
    X = km.Uniform([-1, 2], [1, 2.5]).sample(40, np.random.default_rng(seed))
    assert X.shape == (40, 2)
    assert (X >= [-1, 2]).all()
    assert (X <= [1, 2.5]).all()


def test_each_episode_begins_at_the_given_state() -> None:
    one = km.collect(PENDULUM, [0.1, 0.2], km.Noise(-8, 8), episodes=3, steps=2)
    assert [run.X[0].tolist() for run in one] == [[0.1, 0.2]] * 3
    each = km.collect(PENDULUM, [[1, 2], [3, 4]], km.Noise(-8, 8), episodes=2, steps=2)
    assert [run.X[0].tolist() for run in each] == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    "excitation", [km.Noise(-8, 8), km.Feedback([[1, 1]], km.Noise(-1, 1))], ids=["open", "closed"]
)
def test_the_measured_is_what_is_kept(excitation: km.Noise | km.Feedback) -> None:
    whole = km.discretize(Pendulum(), 0.05)
    partly = km.discretize(SeenAngle(), 0.05)
    seen = km.collect(partly, BOX, excitation, episodes=3, steps=10)
    driven = km.collect(km.plants.SimulatedPlant(partly), BOX, excitation, episodes=3, steps=10)
    assert seen.states == ("y0", "omega [rad/s]")
    rng = np.random.default_rng(0)
    for start, run, other in zip(BOX.sample(3, rng), seen, driven, strict=True):
        X = whole.rollout(start, run.U)
        np.testing.assert_allclose(run.X, np.column_stack([np.sin(X[:, 0]), X[:, 1]]), rtol=0, atol=1e-10)
        np.testing.assert_allclose(run.X, other.X, rtol=0, atol=1e-10)


def test_somebody_elses_plant() -> None:
    plant = Unseen()
    calls: list[tuple[int, float]] = []

    def count(k: int, y: np.ndarray, rng: np.random.Generator) -> float:
        calls.append((k, float(y[0])))
        return 1.0

    data = km.collect(plant, [3.0], count, episodes=2, steps=3)
    assert plant.resets == 2
    assert calls == [(0, 6), (1, 8), (2, 10)] * 2
    assert data[1].X.ravel().tolist() == [6, 8, 10, 12]
    assert (data.states, data.inputs, data.dt) == (("twice x",), ("u",), 0.5)


def test_an_autonomous_plant_needs_no_input() -> None:
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 0)
    plant = km.StepMap(ca.Function("F", [x, u], [0.5 * x]), 0.1)
    data = km.collect(plant, [1, 2], lambda k, y, rng: [], episodes=1, steps=2)
    assert data[0].X.tolist() == [[1, 2], [0.5, 1], [0.25, 0.5]]
    assert data[0].U.shape == (2, 0)


def test_a_plant_that_diverges_is_told_with_the_episode_and_the_step() -> None:
    """One of two states is enough."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    ahead = ca.vertcat(x[0], ca.if_else(x[1] > 6, ca.inf, x[1] + u[0]))
    plant = km.StepMap(ca.Function("F", [x, u], [ahead]), 0.1)
    for excitation in (km.Noise(1, 1), lambda k, y, rng: [1.0]):
        with pytest.raises(km.errors.DataError, match="episode 1 is NaN or infinite from step 5 on"):
            km.collect(plant, [[0.0, -9.0], [0.0, 3.0]], excitation, episodes=2, steps=8)
    driven = km.plants.SimulatedPlant(plant)
    with pytest.raises(km.errors.DataError, match="episode 1 is NaN or infinite from step 5 on"):
        km.collect(driven, [[0.0, -9.0], [0.0, 3.0]], km.Noise(1, 1), episodes=2, steps=8)


def test_a_step_map_needs_a_start_and_a_plant_that_ends_is_cut() -> None:
    with pytest.raises(km.errors.DataError, match="a step map has no state of its own to begin in; pass x0"):
        km.collect(PENDULUM, None, km.Noise(-8, 8), episodes=1, steps=2)

    class Short(Unseen):
        """It ends after its second step."""

        ended = ""

        def reset(self, x0, rng):
            self.taken, self.ended = 0, ""
            return super().reset(x0, rng)

        def step(self, u):
            self.taken += 1
            self.ended = "done" if self.taken == 2 else ""
            return super().step(u)

    data = km.collect(Short(), [3.0], km.Noise(1, 1), episodes=2, steps=5)
    assert [len(run) for run in data] == [2, 2]
    assert [run.X.ravel().tolist() for run in data] == [[6, 8, 10]] * 2
    assert [run.U.ravel().tolist() for run in data] == [[1, 1]] * 2
