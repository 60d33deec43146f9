"""Ten control tasks: a plant, the data that an engineer would take of it, and what a controller shall do with it."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

import koopmpc as km
from tests.closed_loop import plants

UTarget = Literal["equilibrium", "zero", "given"]


@dataclass(frozen=True)
class Task:
    """One task; the controllers learn `truth` from its training data, or are given the equations of `model`.

    Attributes
    ----------
    truth, model
        The plant that is driven, whose optimum is the measure; the one that the training data and the equations are
        of, None where it is the same.
    around
        (x, u), or (x, u, w), at which LQR and LinearMPC linearise the model.
    training
        Its seed is replaced by that of the run.
    Q, R
        Weights of the tracked states and of the inputs.
    tracked
        Names of the tracked states, in the order of Q and of the reference; None for all.
    reference, starts
        (nr,) or (steps+1, nr); initial states, each of which is one run.
    u_target
        Which inputs cost nothing: those that hold the reference, or zero.
    noise
        Standard deviation of the training data's measurement noise, as a share of the range of the initial states.
    weather
        (steps, nw) measured disturbances of the runs; None for a plant without.
    """

    name: str
    truth: km.Dynamics
    dt: float
    around: tuple[list[float], ...]
    training: km.Training
    Q: list[float]
    R: list[float]
    limits: km.Limits
    horizon: int
    reference: np.ndarray
    starts: list[list[float]]
    steps: int
    integrator: km.RK4 = field(default_factory=km.RK4)
    model: km.Dynamics | None = None
    tracked: list[str] | None = None
    u_target: UTarget = "equilibrium"
    noise: float = 0.0
    weather: np.ndarray | None = None

    @cached_property
    def plant(self) -> km.StepMap:
        """The true plant."""
        return km.discretize(self.truth, self.dt, self.integrator)

    @cached_property
    def equations(self) -> km.StepMap:
        """The plant that the controllers are told of, by equations or by data."""
        return self.plant if self.model is None else km.discretize(self.model, self.dt, self.integrator)

    @property
    def of(self) -> km.Lifting:
        """The tracked states as a lifting."""
        return km.State() if self.tracked is None else km.State(self.tracked)

    @property
    def measured(self) -> bool:
        """Whether the whole state is measured."""
        return len(self.plant.outputs) == len(self.plant.states)

    @property
    def rows(self) -> np.ndarray:
        """(steps+1, nr) references."""
        return np.array(np.broadcast_to(self.reference, (self.steps + 1, len(self.Q))), dtype=float)

    def data(self, seed: int) -> km.Episodes:
        """Return the training data of one seed."""
        t = self.training
        asked = {"episodes": t.episodes, "steps": t.steps, "measured": t.measured}
        clean = km.collect(self.equations, t.x0, t.excitation, rng=seed, **asked)
        rng, names = np.random.default_rng(seed), self.plant.states
        seen = [names.index(name) for name in clean.states]
        spread = self.noise * (np.asarray(t.x0.high) - np.asarray(t.x0.low))[seen]
        noisy = [km.Episode(X=e.X + spread * rng.standard_normal(e.X.shape), U=e.U, W=e.W) for e in clean]
        return km.Episodes(noisy, clean.dt, clean.states, clean.inputs, clean.disturbances)

    def but(self, u_target: UTarget | None) -> "Task":
        """Return the task with another u_target; itself for None."""
        return self if u_target is None else replace(self, u_target=u_target)


def _sine(amplitude: float, period: float, dt: float, steps: int) -> np.ndarray:
    """Return rows [amplitude sin(2π t / period), 0]: a position that moves with a velocity target of zero."""
    t = dt * np.arange(steps + 1)
    return np.column_stack([amplitude * np.sin(2 * np.pi * t / period), np.zeros(steps + 1)])


_cart_pole = km.load_problem("cart_pole")

_ALL = (
    Task(
        name="unstable",  # a cart moves 2 m with its pole upright, and catches the pole when it leans
        truth=_cart_pole.dynamics,
        dt=0.05,
        around=([0.0, 0.0, np.pi, 0.0], [0.0]),
        training=km.Training(
            x0=km.Uniform([-2.0, -1.0, np.pi - 0.5, -0.5], [2.0, 1.0, np.pi + 0.5, 0.5]),
            excitation=km.Feedback(
                [[-2.2, -8.0, 176.0, 75.0]], km.Noise(-10.0, 10.0, hold=2), x_ref=[0.0, 0.0, np.pi, 0.0]
            ),
            episodes=60,
            steps=60,
        ),
        Q=[5.0, 10.0, 50.0, 5.0],
        R=[0.01],
        limits=km.Limits(u_min=-40.0, u_max=40.0),
        horizon=25,
        reference=np.array([1.0, 0.0, np.pi, 0.0]),
        starts=[[-1.0, 0.0, np.pi, 0.0], [1.0, 0.0, np.pi - 0.4, 0.0]],
        steps=160,
    ),
    Task(
        name="integrating",  # a crane moves its load by 2 m within limits of speed and swing
        truth=plants.Crane(),
        dt=0.1,
        around=([0.0, 0.0, 0.0, 0.0], [0.0]),
        training=km.Training(
            x0=km.Uniform([-2.0, -0.8, -0.3, -0.6], [2.0, 0.8, 0.3, 0.6]),
            excitation=km.Noise(-1.5, 1.5, hold=3),
            episodes=40,
            steps=50,
        ),
        Q=[1.0, 0.1, 1.0, 0.1],
        R=[0.2],
        limits=km.Limits(u_min=-1.5, u_max=1.5, x_min=[-2.5, -0.7, -0.12, -np.inf], x_max=[2.5, 0.7, 0.12, np.inf]),
        horizon=20,
        reference=np.array([1.0, 0.0, 0.0, 0.0]),
        starts=[[-1.0, 0.0, 0.0, 0.0]],
        steps=120,
    ),
    Task(
        name="cyclic",  # an unbalanced rotor is turned by more than one and a half turns
        truth=plants.Rotor(),
        dt=0.1,
        around=([0.0, 0.0], [0.0]),
        training=km.Training(
            x0=km.Uniform([-np.pi, -3.0], [np.pi, 3.0]), excitation=km.Noise(-3.0, 3.0, hold=3), episodes=60, steps=50
        ),
        Q=[1.0, 0.1],
        R=[0.1],
        limits=km.Limits(u_min=-3.0, u_max=3.0),
        horizon=20,
        reference=np.array([10.5, 0.0]),
        starts=[[0.0, 0.0]],
        steps=120,
    ),
    Task(
        name="scaled",  # Pa and fractions of a millimetre in one state
        truth=plants.Bellows(),
        dt=0.02,
        integrator=km.RK4(substeps=2),
        around=([1.25e4, 1.433e-4, 0.0], [0.1155]),
        training=km.Training(
            x0=km.Uniform([0.0, 0.0, -1e-3], [2.5e4, 2.5e-4, 1e-3]),
            excitation=km.Noise(0.0, 1.0, hold=5),
            episodes=40,
            steps=60,
        ),
        Q=[0.0, 1e8, 1e2],
        R=[0.1],
        limits=km.Limits(u_min=0.0, u_max=1.0, x_min=[0.0, -np.inf, -np.inf], x_max=[2.3e4, np.inf, np.inf]),
        horizon=20,
        reference=np.array([2.1007e4, 2.2e-4, 0.0]),
        starts=[[0.0, 0.0, 0.0]],
        steps=120,
    ),
    Task(
        name="stiff",  # a tank reactor is brought to a hotter point, below a limit of its temperature
        truth=plants.Reactor(),
        dt=0.1,
        integrator=km.RK4(substeps=10),
        around=([0.877, 324.5, 300.0], [300.0]),
        training=km.Training(
            x0=km.Uniform([0.6, 320.0, 290.0], [0.95, 342.0, 310.0]),
            # it ignites when left to itself, so the temperature is held by hand, not well, while the coolant is moved
            excitation=km.Feedback(
                [[0.0, 3.0, 0.0]], km.Noise(-10.0, 10.0, hold=3), [0.0, 334.0, 0.0], 302.0, u_min=280.0, u_max=320.0
            ),
            episodes=50,
            steps=40,
        ),
        Q=[100.0, 0.1, 0.0],
        R=[0.01],
        limits=km.Limits(u_min=280.0, u_max=320.0, x_min=[-np.inf, 310.0, -np.inf], x_max=[np.inf, 344.0, np.inf]),
        horizon=20,
        reference=np.array([0.676, 340.0, 0.0]),
        starts=[[0.877, 324.5, 300.0]],
        steps=100,
    ),
    Task(
        name="output",  # only the position of an oscillator with a hardening spring is measured
        truth=plants.Spring(),
        dt=0.1,
        around=([0.0, 0.0], [0.0]),
        training=km.Training(
            x0=km.Uniform([-1.2, -1.0], [1.2, 1.0]), excitation=km.Noise(-2.5, 2.5, hold=4), episodes=50, steps=50
        ),
        Q=[10.0],
        R=[0.1],
        limits=km.Limits(u_min=-2.5, u_max=2.5),
        horizon=20,
        tracked=["x [m]"],
        reference=np.array([0.8]),
        starts=[[-0.5, 0.0], [0.0, 0.8]],
        steps=120,
        noise=1e-3,
    ),
    Task(
        name="sine",  # the position of an oscillator follows a sine, while the target of its speed stays zero
        truth=plants.Wells(),
        dt=0.1,
        around=([0.0, 0.0], [0.0]),
        training=km.Training(
            x0=km.Uniform([-1.8, -2.0], [1.8, 2.0]), excitation=km.Noise(-3.0, 3.0, hold=3), episodes=50, steps=50
        ),
        Q=[1.0, 0.01],
        R=[0.2],
        limits=km.Limits(u_min=-4.0, u_max=4.0, x_min=[-np.inf, -1.6], x_max=[np.inf, 1.6]),
        horizon=40,  # most of a period: with 20 steps the exact equations themselves cost 1.36
        reference=_sine(1.2, 5.0, 0.1, 150),
        starts=[[0.5, 0.0]],
        steps=150,
    ),
    Task(
        name="beyond",  # an unstable oscillator shall go where a limit forbids; its drive is charged from zero
        truth=plants.VanDerPol(),
        dt=0.1,
        around=([0.0, 0.0], [0.0]),
        training=km.Training(
            x0=km.Uniform([-2.0, -2.0], [2.0, 2.0]), excitation=km.Noise(-3.0, 3.0, hold=3), episodes=50, steps=50
        ),
        Q=[10.0, 1.0],
        R=[0.1],
        limits=km.Limits(u_min=-3.0, u_max=3.0, x_min=[-1.0, -1.2], x_max=[1.0, 1.2]),
        horizon=20,
        reference=np.array([1.8, 0.0]),
        starts=[[-0.8, 0.0], [0.9, -1.0]],
        steps=120,
        u_target="zero",
    ),
    Task(
        name="two inputs",  # four tanks, two pumps: the lower levels are exchanged
        truth=plants.Tanks(),
        dt=5.0,
        around=([12.4, 12.7, 1.8, 1.4], [3.0, 3.0]),
        training=km.Training(
            x0=km.Uniform([6.0, 6.0, 0.5, 0.5], [18.0, 18.0, 4.0, 4.0]),
            excitation=km.Noise([1.0, 1.0], [5.0, 5.0], hold=4),
            episodes=40,
            steps=50,
        ),
        Q=[1.0, 1.0],
        R=[0.1, 0.1],
        limits=km.Limits(u_min=0.5, u_max=6.0, x_min=[4.0, 4.0, 0.2, 0.2], x_max=[18.0, 18.0, 5.0, 5.0]),
        horizon=20,
        tracked=["h1 [cm]", "h2 [cm]"],
        reference=np.array([15.0, 11.0]),
        starts=[[8.0, 16.0, 1.5, 1.5]],
        steps=100,
    ),
    Task(
        name="wrong",  # the payload and the friction are 20 % above those of the training data and of the equations
        truth=plants.Arm(m=1.2, c=0.24),
        model=plants.Arm(),
        dt=0.05,
        around=([0.0, 0.0], [0.0]),
        training=km.Training(
            x0=km.Uniform([-1.2, -2.0], [1.2, 2.0]), excitation=km.Noise(-4.0, 4.0, hold=4), episodes=50, steps=50
        ),
        Q=[10.0, 0.1],
        R=[0.05],
        limits=km.Limits(u_min=-5.5, u_max=5.5),
        horizon=20,
        reference=np.array([0.8, 0.0]),
        starts=[[0.0, 0.0], [-0.8, 0.0]],
        steps=150,
        noise=1e-3,
    ),
)

TEN = tuple(task.name for task in _ALL)
# the last of the ten again, with data and equations of the plant that is driven: what knowing better is worth
TASKS = {task.name: task for task in (*_ALL, replace(_ALL[-1], name="wrong, told", model=None))}
