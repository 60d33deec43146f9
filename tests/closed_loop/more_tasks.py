"""Twelve more tasks, each made after a cause for which a design once failed on a plant that nobody had tuned for.

A thirteenth has a measured disturbance.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

import koopmpc as km
from tests.closed_loop import more_plants, plants
from tests.closed_loop.tasks import TASKS, Task

PI = (0.8, 0.05)  # gains of the loop under which logs were taken: proportional, integral per step
SMALL = 0.02  # noise that the operators put on top of the PI loop, as a share of the input's range


@dataclass(frozen=True)
class LoggedTask(Task):
    """A task whose training data may be logs of a working PI loop with a few changes of its set point."""

    logged: Callable[["LoggedTask", int], km.Episodes] | None = None
    gains: tuple[float, float] = PI

    def data(self, seed: int) -> km.Episodes:
        """Return the logs of one seed."""
        return super().data(seed) if self.logged is None else self.logged(self, seed)


def _log_under_pi(task: LoggedTask, seed: int) -> km.Episodes:
    """Return episodes in which a PI loop follows a set point of the last state that steps every third of an episode."""
    rng, plant, t = np.random.default_rng(seed), task.equations, task.training
    low, high = np.asarray(t.x0.low), np.asarray(t.x0.high)
    u_low, u_high = float(np.min(task.limits.u_min)), float(np.max(task.limits.u_max))
    episodes = []
    for _ in range(t.episodes):
        x, integral = rng.uniform(low, high), rng.uniform(u_low, u_high)
        goals = np.repeat(rng.uniform(low[-1], high[-1], 3), -(-t.steps // 3))[: t.steps]
        X, U = [x], []
        for goal in goals:
            error = goal - x[-1]
            integral = np.clip(integral + PI[1] * error, u_low, u_high)
            noise = SMALL * (u_high - u_low) * rng.standard_normal()
            u = np.clip(np.array([integral + PI[0] * error + noise]), u_low, u_high)
            x = np.asarray(plant(x, u))
            X.append(x)
            U.append(u)
        episodes.append(km.Episode(X=np.array(X), U=np.array(U)))
    return km.Episodes(episodes, task.dt, plant.states, plant.inputs)


def _record_under_pi(task: LoggedTask, seed: int) -> km.Episodes:
    """Return one record of the sensor alone, under a PI loop whose set point steps every 40 rows."""
    rng, plant, t = np.random.default_rng(seed), task.equations, task.training
    low, high = np.asarray(t.x0.low), np.asarray(t.x0.high)
    u_low, u_high = float(np.min(task.limits.u_min)), float(np.max(task.limits.u_max))
    of = plant.states.index(plant.outputs[0])
    rows = t.episodes * t.steps
    goals = np.repeat(rng.uniform(low[of], high[of], -(-rows // 40)), 40)[:rows]
    x, integral = (low + high) / 2, (u_low + u_high) / 2
    Y, U = np.empty((rows + 1, 1)), np.empty((rows, 1))
    for k in range(rows + 1):
        Y[k] = x[of] + task.noise * (high[of] - low[of]) * rng.standard_normal()
        if k < rows:
            error = goals[k] - Y[k, 0]
            integral = np.clip(integral + task.gains[1] * error, u_low, u_high)
            noise = 2 * SMALL * (u_high - u_low) * rng.standard_normal()
            U[k] = np.clip(integral + task.gains[0] * error + noise, u_low, u_high)
            x = np.asarray(plant(x, U[k]))
    return km.Episodes([km.Episode(X=Y, U=U)], task.dt, plant.outputs, plant.inputs)


def _sine(amplitude: float, period: float, steps: int, column: int) -> np.ndarray:
    """Return rows of two states, of which one follows a sine of this period in steps."""
    rows = np.zeros((steps + 1, 2))
    rows[:, column] = amplitude * np.sin(2 * np.pi * np.arange(steps + 1) / period)
    return rows


_TWO_HIDDEN = LoggedTask(
    name="two hidden",  # of mass and drive the position alone is measured
    truth=more_plants.LaggedSpring(),
    dt=0.1,
    around=([0.0, 0.0, 0.0], [0.0]),
    training=km.Training(
        x0=km.Uniform([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]),
        excitation=km.Noise(-2.5, 2.5, hold=4),
        episodes=50,
        steps=60,
    ),
    Q=[10.0],
    R=[0.1],
    limits=km.Limits(u_min=-2.5, u_max=2.5),
    horizon=20,
    tracked=["x [m]"],
    reference=np.array([0.7]),
    starts=[[-0.5, 0.0, 0.0]],
    steps=120,
    noise=1e-3,
)

_MORE = (
    replace(
        TASKS["sine"],
        name="short preview",  # the beam follows a sine of which it sees a sixth of a period
        Q=[5.0, 0.01],
        R=[0.1],
        limits=km.Limits(u_min=-4.0, u_max=4.0),
        horizon=10,
        reference=_sine(1.0, 60.0, 150, 0),
    ),
    replace(
        TASKS["beyond"],
        name="preview beyond",  # the rate of an oscillator follows a sine past its limit, seen a sixth of a period
        Q=[0.1, 10.0],
        limits=km.Limits(u_min=-4.0, u_max=4.0, x_min=[-np.inf, -0.8], x_max=[np.inf, 0.8]),
        horizon=10,
        reference=_sine(1.0, 60.0, 150, 1),
        starts=[[0.5, 0.0]],
        steps=150,
    ),
    Task(
        name="cliff",  # a tank is filled across a ledge, above which it is four times as wide
        truth=more_plants.Funnel(),
        dt=0.1,
        around=([1.0, 1.0], [1.0]),
        training=km.Training(
            x0=km.Uniform([0.1, 0.1], [1.8, 1.6]), excitation=km.Noise(0.0, 2.0, hold=5), episodes=50, steps=50
        ),
        Q=[0.1, 10.0],
        R=[0.1],
        limits=km.Limits(u_min=0.0, u_max=2.0, x_min=[0.0, 0.0], x_max=[2.2, 1.7]),
        horizon=20,
        reference=np.array([1.4, 1.4]),
        starts=[[0.2, 0.2]],
        steps=120,
    ),
    Task(
        name="hidden lag",  # a tank is warmed by a heater whose element nobody measures
        truth=more_plants.Heated(),
        dt=4.0,
        around=([0.64, 30.0, 25.0], [0.4, 25.0]),
        training=km.Training(
            x0=km.Uniform([0.3, 20.0, 5.0], [1.0, 40.0, 40.0]),
            excitation=km.Noise([0.2, 0.0], [0.6, 50.0], hold=6),
            episodes=12,
            steps=60,
        ),
        Q=[10.0, 1.0],
        R=[0.1, 0.001],
        limits=km.Limits(u_min=[0.0, 0.0], u_max=[0.8, 50.0]),
        horizon=20,
        tracked=["level [m]", "temperature [°C]"],
        reference=np.array([0.64, 32.0]),
        starts=[[0.9, 22.0, 0.0], [0.35, 38.0, 40.0]],
        steps=100,
        noise=1e-3,
    ),
    Task(
        name="off the diagonal",  # each level is inside its range, and no log has them so far apart
        truth=more_plants.Coupled(),
        dt=0.1,
        around=([1.0, 0.9], [0.38]),
        training=km.Training(
            x0=km.Uniform([0.7, 0.65], [0.8, 0.7]), excitation=km.Noise(0.0, 1.2, hold=15), episodes=40, steps=60
        ),
        Q=[1.0, 10.0],
        R=[0.5],
        limits=km.Limits(u_min=0.0, u_max=1.2, x_min=[0.1, 0.1], x_max=[2.8, 2.5]),
        horizon=20,
        reference=np.array([0.9347, 0.845]),
        starts=[[0.6, 1.4], [1.5, 0.6]],
        steps=100,
    ),
    Task(
        name="short horizon",  # a sled is stopped 5 cm before a buffer; braking takes three horizons
        truth=more_plants.Sled(),
        dt=0.1,
        around=([0.0, 0.0], [0.0]),
        training=km.Training(
            x0=km.Uniform([-2.0, -1.5], [2.0, 1.5]), excitation=km.Noise(-1.0, 1.0, hold=4), episodes=40, steps=50
        ),
        Q=[10.0, 0.0],
        R=[0.01],
        limits=km.Limits(u_min=-1.0, u_max=1.0, x_max=[1.0, np.inf]),
        horizon=6,
        reference=np.array([0.95, 0.0]),
        starts=[[-1.5, 0.0]],
        steps=100,
    ),
    replace(
        TASKS["two inputs"],
        name="leaks",  # four tanks with other outlets than in the logs and a leak in two of them, measured exactly
        truth=more_plants.LeakyTanks(a1=0.0781, a2=0.0513),
        model=plants.Tanks(),
        reference=np.array([12.0, 13.0]),
        starts=[[8.0, 15.0, 1.5, 1.5]],
    ),
    Task(
        name="turning gain",  # a reactor with two inputs comes near to the most that it can make of B
        truth=more_plants.Vusse(),
        dt=0.01,
        integrator=km.RK4(substeps=10),
        around=([2.14, 1.09, 387.2, 386.1], [14.19, -1.113]),
        training=km.Training(
            x0=km.Uniform([1.4, 0.8, 376.0, 374.0], [3.0, 1.1, 394.0, 393.0]),
            excitation=km.Noise([3.0, -2.5], [35.0, 0.0], hold=4),
            episodes=60,
            steps=40,
        ),
        Q=[0.0, 100.0, 0.1, 0.0],
        R=[1e-4, 0.01],
        limits=km.Limits(
            u_min=[3.0, -3.0],
            u_max=[35.0, 0.0],
            x_min=[-np.inf, -np.inf, 370.0, -np.inf],
            x_max=[np.inf, np.inf, 400.0, np.inf],
        ),
        horizon=20,
        reference=np.array([0.0, 1.08, 387.0, 0.0]),
        starts=[[2.8, 0.85, 380.0, 377.0]],
        steps=80,
    ),
    LoggedTask(
        name="under PI",  # the funnel's work below its ledge was logged under a PI loop
        truth=more_plants.Funnel(),
        dt=0.2,
        around=([0.5, 0.5], [0.7]),
        training=km.Training(
            x0=km.Uniform([0.2, 0.2], [0.9, 0.9]), excitation=km.Noise(0.0, 2.0, hold=5), episodes=30, steps=60
        ),
        logged=_log_under_pi,
        Q=[0.1, 10.0],
        R=[0.1],
        limits=km.Limits(u_min=0.0, u_max=2.0, x_min=[0.0, 0.0], x_max=[1.6, 0.9]),
        horizon=15,
        reference=np.array([0.75, 0.75]),
        starts=[[0.3, 0.3], [0.8, 0.4]],
        steps=80,
    ),
    _TWO_HIDDEN,
    replace(
        _TWO_HIDDEN,
        name="one record of a drive",  # of the same plant there is one record of a working PI loop
        training=replace(_TWO_HIDDEN.training, excitation=km.Noise(-2.5, 2.5), episodes=1, steps=2000),
        logged=_record_under_pi,
        gains=(0.1, 0.04),
    ),
    LoggedTask(
        name="one record of a tank",  # the upper level is hidden; there is one record of a working PI loop
        truth=more_plants.BlindFunnel(),
        dt=0.2,
        around=([0.5, 0.5], [0.7]),
        training=km.Training(
            x0=km.Uniform([0.2, 0.2], [0.9, 0.9]), excitation=km.Noise(0.0, 2.0), episodes=1, steps=2000
        ),
        logged=_record_under_pi,
        Q=[10.0],
        R=[0.1],
        limits=km.Limits(u_min=0.0, u_max=2.0),
        horizon=15,
        tracked=["lower [m]"],
        reference=np.array([0.75]),
        starts=[[0.3, 0.3], [0.8, 0.4]],
        steps=80,
        noise=1e-3,
    ),
)

_HEAT_PUMP = km.load_problem("heat_pump")

_WEATHER = Task(
    name="weather",  # a room is warm by day and cool at night; the temperature outside is measured and forecast
    truth=_HEAT_PUMP.dynamics,
    dt=_HEAT_PUMP.dt,
    around=([21.0, 25.75], [1.2331], [2.0]),
    training=_HEAT_PUMP.training,
    Q=[1.0],
    R=[0.02],
    limits=_HEAT_PUMP.limits,
    horizon=_HEAT_PUMP.horizon,
    tracked=["room [°C]"],
    reference=np.asarray(_HEAT_PUMP.cases["track"].reference)[:145],
    starts=[[17.0, 18.0], [22.0, 27.0]],
    steps=144,
    u_target="zero",
    noise=1e-3,
    weather=_HEAT_PUMP.measured_of("track")[:144],
)

MORE = {task.name: task for task in _MORE}
ALL = TASKS | MORE
TABLE = TASKS | {_WEATHER.name: _WEATHER}  # tasks of the stored table
JUDGED = ALL | TABLE
