"""Past Snyder & Song (2021): data that show what the input does, and control on models of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.data.collect import Uniform, collect
from koopmpc.data.episodes import Episodes
from koopmpc.data.excitation import Feedback, Noise
from koopmpc.identify.fits.dmd import dmd, dmdc
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.fourier import Fourier
from koopmpc.lifting.monomials import Monomials
from koopmpc.lifting.state import Constant, State
from koopmpc.papers.contest import Contest, Prediction, centred, prediction
from koopmpc.papers.plants import CartPole, Pendulum
from koopmpc.papers.reconstruction import Scene, unwarned
from koopmpc.papers.snyder.settings import CART_POLE_WEIGHTS, PENDULUM_WEIGHTS, TARGET, UP, gains
from koopmpc.plants.dynamics import Dynamics
from koopmpc.plants.integrators import RK4
from koopmpc.plants.step_map import StepMap, discretize

DT = 0.05  # of the controllers [s]
LASTING = 3.0  # an exciting episode [s]
LIFTINGS: Mapping[str, Lifting] = {
    "DMDc": State() + Constant(),
    "Fourier 1": State() + Fourier(1) + Constant(),
    "monomials 3": State() + Monomials(3) + Constant(),
}


@dataclass(frozen=True)
class Shaking:
    """How a plant is excited for data: it starts in x ± spread, and u is shaken by ± noise."""

    spread: Sequence[float]
    noise: float


SHAKINGS: Mapping[str, Shaking] = {
    "pendulum": Shaking((1.0, 1.0), 4.0),
    "cart-pole": Shaking((1.0, 0.5, 0.1, 0.1), 10.0),
}


@dataclass(frozen=True)
class Task:
    """What a controller has to do, and how the plant is shaken for the data of its model.

    Attributes
    ----------
    dynamics, x_eq, K
        The plant; where it rests; the feedback that holds it while data are taken, None where it needs none.
    shaking
        Of the data, about x_eq.
    cost, limit
        The paper's weights; |u| in the runs with limits, below what LQR would take.
    x0, reference
        From where to where.
    """

    dynamics: Dynamics
    x_eq: Sequence[float]
    K: str | None
    shaking: Shaking
    cost: Cost
    limit: float
    x0: Sequence[float]
    reference: Sequence[float]


_DRIVEN, _CARRIED = Cost(*PENDULUM_WEIGHTS), Cost(*CART_POLE_WEIGHTS)
_REST, _START = (0.0, 0.0), (np.pi / 4, 0.0)
TASKS: Mapping[str, Task] = {
    "pendulum, hanging, π/4": Task(Pendulum(), _REST, None, Shaking((1.2, 2.0), 4.0), _DRIVEN, 2.0, _START, _REST),
    "pendulum, upright, π/4": Task(
        Pendulum(upright=True), _REST, "upright", Shaking((1.0, 1.0), 10.0), _DRIVEN, 20.0, _START, _REST
    ),
    "cart-pole, 2 m shift": Task(
        CartPole(),
        UP,
        "cart-pole",
        Shaking((2.0, 1.0, 0.1, 0.1), 5.0),
        _CARRIED,
        3.0,
        (-1.0, 0.0, np.pi, 0.0),
        TARGET,
    ),
    "cart-pole, 0.3 rad off": Task(
        CartPole(),
        UP,
        "cart-pole",
        Shaking((2.0, 1.0, 0.4, 0.4), 10.0),
        _CARRIED,
        40.0,
        (0.0, 0.0, np.pi + 0.3, 0.0),
        UP,
    ),
}


def contest(title: str, steps: int, horizon: int, episodes: int) -> Contest:
    """Return one of `TASKS` with its models, fitted to so many exciting episodes."""
    task = TASKS[title]
    plant = discretize(task.dynamics, DT, RK4(4))
    K = None if task.K is None else gains()[task.K]
    data = _excited(plant, task.x_eq, K, task.shaking, episodes=episodes, steps=round(LASTING / DT))
    with unwarned():
        models = {name: edmd(data, lifting) for name, lifting in LIFTINGS.items()}
    return Contest(
        title,
        plant,
        np.asarray(task.x_eq),
        models,
        task.cost,
        Limits(u_min=-task.limit, u_max=task.limit),
        np.asarray(task.x0),
        np.asarray(task.reference),
        steps,
        horizon,
    )


def predictions(scene: Scene, shaking: Shaking, episodes: int) -> dict[str, Prediction]:
    """Return what is predicted by fits of one trajectory under feedback, and by fits of exciting data, with inputs.

    Inputs are held over a sample; coordinates are x − x_ref, so that no origin is in the way.

    Parameters
    ----------
    scene
        The plant, its feedback and its start.
    shaking
        Of the exciting data, and of what is predicted, about x_ref.
    episodes
        How many exciting ones.
    """
    plant = discretize(scene.dynamics, scene.dt, RK4(2))
    K = scene.K
    assert K is not None
    x_ref = np.broadcast_to(scene.x_ref, plant.nx)
    law = Feedback(K, x_ref=x_ref)
    one = centred(collect(plant, scene.x0, law, episodes=1, steps=scene.steps), x_ref)
    steps = round(LASTING / scene.dt)
    rich = centred(_excited(plant, x_ref, K, shaking, episodes=episodes, steps=steps), x_ref)
    starts = Uniform(x_ref - shaking.spread, x_ref + shaking.spread)
    feedback = centred(collect(plant, starts, law, episodes=10, steps=200, rng=1), x_ref)
    excited = centred(_excited(plant, x_ref, K, shaking, episodes=10, steps=200, seed=2), x_ref)
    B = plant.linearize(x_ref, np.zeros(plant.nu)).B
    with unwarned():
        models = {
            "DMD, feedback data": dmd(one),
            "DMDc, feedback data": dmdc(one),
            "DMDc, exciting data": dmdc(rich),
            "EDMDc, exciting data": edmd(rich, State() + Fourier(1)),
        }
    return {name: prediction(name, model, feedback, excited, B) for name, model in models.items()}


def _excited(
    plant: StepMap,
    x_ref: ArrayLike,
    K: Float[np.ndarray, "nu nx"] | None,
    shaking: Shaking,
    *,
    episodes: int,
    steps: int,
    seed: int = 0,
) -> Episodes:
    """Return episodes from x_ref ± spread under noise, on top of feedback where there is K."""
    middle = checks.vector(x_ref, "x_ref", plant.nx)
    shaken = Noise(-shaking.noise, shaking.noise, hold=max(1, round(0.05 / plant.dt)))
    excitation = shaken if K is None else Feedback(K, shaken, x_ref=middle)
    starts = Uniform(middle - shaking.spread, middle + shaking.spread)
    return collect(plant, starts, excitation, episodes=episodes, steps=steps, rng=seed)
