"""Gymnasium's environments as plants: km.plants.GymPlant."""

import numpy as np
import pytest

import koopmpc as km

gymnasium = pytest.importorskip("gymnasium", reason="the extra gym is not installed")

PENDULUM = {"sin_cos": [(1, 0)], "states": ("theta [rad]", "omega [rad/s]"), "inputs": ("torque [N m]",)}
G, M, L = 10.0, 1.0, 1.0  # the environment's own numbers


def pendulum_step(x, u, dt=0.05):
    """Semi-implicit Euler as the documentation of Pendulum-v1 states it; the rate is cut at 8 rad/s."""
    omega = np.clip(x[1] + (3 * G / (2 * L) * np.sin(x[0]) + 3 / (M * L**2) * u[0]) * dt, -8, 8)
    return np.array([x[0] + omega * dt, omega])


@pytest.fixture
def pendulum():
    return km.plants.GymPlant("Pendulum-v1", **PENDULUM)


def test_the_pendulum_moves_as_its_documentation_says_with_an_angle_that_never_jumps(pendulum):
    rng = np.random.default_rng(0)
    x = np.array([1.0, 6.0])
    assert pendulum.reset(x) == pytest.approx(x, abs=1e-6)
    assert isinstance(pendulum, km.plants.Plant)
    assert pendulum.dt == 0.05
    for _ in range(100):
        u = rng.uniform(-2, 2, 1)
        x = pendulum_step(x, u)
        assert pendulum.step(u) == pytest.approx(x, abs=2e-5)
    assert x[0] > 2 * np.pi  # it went round: an angle of sin and cos alone would have jumped


def test_without_x0_an_episode_begins_where_the_environment_does_and_the_seed_decides_where(pendulum):
    starts = [pendulum.reset(None, seed) for seed in (1, 1, 2)]
    assert starts[0].tolist() == starts[1].tolist() != starts[2].tolist()
    data = km.collect(pendulum, None, km.Noise(-2, 2), episodes=4, steps=20, rng=3)
    assert len({episode.X[0, 0] for episode in data}) == 4
    assert data == km.collect(pendulum, None, km.Noise(-2, 2), episodes=4, steps=20, rng=3)


def test_a_time_limit_ends_an_episode_and_the_run_and_says_so(pendulum):
    data = km.collect(pendulum, None, km.Noise(-2, 2), episodes=2, steps=250)
    assert [len(episode) for episode in data] == [200, 200]
    assert pendulum.ended == "truncated"
    with pytest.raises(km.KoopmpcError, match=r"has ended \(truncated\); call reset"):
        pendulum.step([0.0])


def test_an_input_that_the_environment_would_cut_in_silence_is_refused(pendulum):
    pendulum.reset([0.0, 0.0])
    with pytest.raises(km.KoopmpcError, match=r"u = \[3\.\] is beyond the actions of Pendulum-v1"):
        pendulum.step([3.0])


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("CartPole-v1", {}, r"the actions of CartPole-v1 are Discrete\(2\); koopmpc needs vectors"),
        ("MountainCarContinuous-v0", {}, "does not tell its sample time; pass dt= in s"),
        ("Pendulum-v1", {"sin_cos": [(1, 3)]}, "pass pairs of different observations"),
        ("Pendulum-v1", {"sin_cos": [(1, 1)]}, "pass pairs of different observations"),
        ("Pendulum-v1", {"states": ("a", "b")}, "states"),
        ("Pendulum-v1", {"dt": -1}, "dt is -1 s; it must be above zero"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_name_of_the_environment(name, settings, message):
    with pytest.raises(km.KoopmpcError, match=message):
        km.plants.GymPlant(name, **settings)


def test_what_is_no_environment_is_refused():
    with pytest.raises(km.KoopmpcError, match="env is an int, expected an Env"):
        km.plants.GymPlant(3)


def test_an_x0_that_the_environment_cannot_take_is_refused_and_a_function_helps():
    seen = km.plants.GymPlant("Pendulum-v1")  # x is (cos, sin, rate), and the environment's own state has two entries
    with pytest.raises(km.KoopmpcError, match="does not tell how to begin at x0"):
        seen.reset([1.0, 0.0, 0.5])

    def start(env, x0):
        env.unwrapped.state = np.array([np.arctan2(x0[1], x0[0]), x0[2]])

    helped = km.plants.GymPlant("Pendulum-v1", start=start)
    assert helped.reset([0.6, 0.8, 0.5]) == pytest.approx([0.6, 0.8, 0.5], abs=1e-6)


def test_wrappers_of_observations_are_seen_in_the_first_observation_too():
    env = gymnasium.wrappers.TransformObservation(gymnasium.make("Pendulum-v1"), lambda y: y * [1, 1, 10], None)
    plant = km.plants.GymPlant(env, **PENDULUM)
    with pytest.raises(km.KoopmpcError, match="was put into x0"):
        plant.reset([0.1, 0.5])
    assert plant.reset([0.1, 0.0]) == pytest.approx([0.1, 0.0], abs=1e-6)


class Still:
    """A controller that does nothing."""

    nu, horizon = 1, 0

    def __init__(self, dt):
        self.dt = dt

    def reset(self, x0=None, u_prev=None):
        pass

    def __call__(self, y, reference, applied=None):
        return km.Move(np.zeros(1), km.Status.OPTIMAL, km.control.Fallback.NONE, 0.0, 0)


class TestMujoco:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")

    @pytest.fixture
    def cart(self):
        return km.plants.GymPlant("InvertedPendulum-v5", states=("x [m]", "theta [rad]", "v [m/s]", "omega [rad/s]"))

    def test_an_episode_ends_where_the_pole_falls_and_the_next_begins_apart(self, cart):
        data = km.collect(cart, None, km.Noise(-3, 3), episodes=5, steps=300)
        assert cart.ended == "terminated"
        assert all(len(episode) < 300 for episode in data)
        for episode in data:
            assert np.abs(episode.X[:-1, 1]).max() <= 0.2 < abs(episode.X[-1, 1])  # MuJoCo's own rule
            assert np.abs(episode.X[0]).max() <= 0.01
        pairs = data.snapshots()
        assert len(pairs.X) == sum(map(len, data))

    def test_a_learned_controller_holds_the_pole_from_an_x0_that_is_taken_exactly(self, cart):
        data = km.collect(cart, km.Uniform([-0.5, -0.15, -0.5, -0.5], [0.5, 0.15, 0.5, 0.5]), km.Noise(-3, 3),
                          episodes=100, steps=30)  # fmt: skip
        model = km.edmd(data, km.State())
        cost, limits = km.Cost(Q=[10, 100, 1, 1], R=0.1), km.Limits(cart.u_min, cart.u_max)
        run = km.simulate(cart, km.KoopmanMPC(model, cost, limits, 30), x0=[0.3, 0.1, 0, 0], reference=[0, 0, 0, 0],
                          steps=150, cost=cost, limits=limits)  # fmt: skip
        assert run.X[0].tolist() == [0.3, 0.1, 0, 0]
        assert np.abs(run.X[-1]).max() < 0.02

    def test_a_run_that_the_environment_ends_is_shorter_and_says_why(self, cart):
        with pytest.warns(UserWarning, match=r"the plant ended the run after \d+ of 200 steps: terminated"):
            run = km.simulate(cart, Still(cart.dt), x0=[0, 0.1, 0, 0], reference=[0, 0, 0, 0], steps=200)
        assert run.metadata["ended"] == "terminated"
        assert run.steps < 200
