"""Sixty random plants and twenty of textbooks, each with data, a goal and limits."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import casadi as ca
import numpy as np
import scipy.optimize

import koopmpc as km
from tests.closed_loop.more_tasks import ALL
from tests.closed_loop.optimum import held
from tests.guarantees.coverage.optimum import find_optimum

TEXTBOOK = tuple(name for name in ALL if name != "wrong, told")
LONGEST, FEW = 80, 10  # steps and runs of a plant of a textbook
EPISODES, STEPS = 40, 15  # of the data of a random plant
NOISE = (0.0, 0.005)  # of the measurements of random plants in turn, as a share of ±1


@dataclass(frozen=True, eq=False)
class RandomPlant(km.Dynamics):
    """ẋ = A x + B u + Σ c sin(w x_i) x_j e_k + D x u: mildly nonlinear, some of them unstable."""

    A: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    B: np.ndarray = field(default_factory=lambda: np.zeros((2, 1)))
    bends: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    mixed: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    states = ("a", "b")
    inputs = ("u",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ."""
        return self.A @ x + self.B @ u + self.bends @ ca.sin(2 * x) * x[0] + self.mixed @ x * u[0]


@dataclass(frozen=True, eq=False)
class CoverageTask:
    """What a design is given, and the plant on which its promise is judged.

    Attributes
    ----------
    gather
        The data.
    held
        (steps, nu) inputs from which the cost counts.
    spread
        (nx,) by which starts are moved at random.
    noise
        Of the measurements in loops.
    runs
        On the true plant.
    """

    name: str
    plant: km.StepMap
    gather: Callable[[], km.Episodes]
    cost: km.Cost
    limits: km.Limits
    horizon: int
    reference: np.ndarray
    starts: np.ndarray
    steps: int
    held: np.ndarray
    spread: np.ndarray
    noise: float = 0.0
    delays: tuple[int, ...] = (0,)
    runs: int = 20

    @property
    def rows(self) -> np.ndarray:
        """(steps+1, nr) references."""
        return np.array(np.broadcast_to(self.reference, (self.steps + 1, self.reference.shape[-1])), dtype=float)


def _collect(plant: km.StepMap, noise: float, seed: int) -> km.Episodes:
    clean = km.collect(
        plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-2, 2, hold=2), episodes=EPISODES, steps=STEPS, rng=seed
    )
    rng = np.random.default_rng(seed)
    noisy = [km.Episode(X=e.X + noise * rng.standard_normal(e.X.shape), U=e.U) for e in clean]
    return km.Episodes(noisy, clean.dt, clean.states, clean.inputs)


def _drift(x: np.ndarray, plant: km.StepMap, u: np.ndarray) -> np.ndarray:
    return np.asarray(plant(x, u)) - x


def draw_task(seed: int) -> CoverageTask:
    """Return a random plant with a goal that the true equations reach inside the limits from every start.

    The reference is an equilibrium. On two plants of three a state limit cuts off a share of what the optimum without
    it does; on the third it is beyond that. Plants without such an equilibrium, or without a way, are drawn again.
    """
    rng = np.random.default_rng([30, seed])
    while True:
        A = rng.normal(size=(2, 2))
        A += (rng.uniform(-1.5, 0.3) - np.linalg.eigvals(A).real.max()) * np.eye(2)
        dynamics = RandomPlant(
            A,
            rng.normal(size=(2, 1)) * rng.uniform(0.7, 1.5),
            0.3 * rng.normal(size=(2, 2)),
            0.2 * rng.normal(size=(2, 2)),
        )
        plant = km.discretize(dynamics, 0.1)
        u_r = rng.uniform(-0.5, 0.5, 1)
        x_r, _, ended, _ = scipy.optimize.fsolve(_drift, np.zeros(2), (plant, u_r), full_output=True)
        if ended != 1 or np.abs(x_r).max() > 0.6:
            continue
        free = CoverageTask(
            name=f"random {seed}",
            plant=plant,
            gather=partial(_collect, plant, NOISE[seed % 2], seed),
            cost=km.Cost(Q=rng.uniform(0.1, 2.0, 2), R=rng.uniform(0.02, 0.3, 1)),
            limits=km.Limits(u_min=-2, u_max=2),
            horizon=10,
            reference=x_r,
            starts=rng.uniform(-0.7, 0.7, (3, 2)),
            steps=30,
            held=np.tile(u_r, (30, 1)),
            spread=np.full(2, 0.05),
            noise=NOISE[seed % 2],
        )
        task = _limit(free, rng, touching=seed % 3 > 0)
        if task is not None and all(find_optimum(task, x0) is not None for x0 in task.starts):
            return task


def _limit(task: CoverageTask, rng: np.random.Generator, *, touching: bool) -> CoverageTask | None:
    """Return the task with a limit of one state, None where its optimum would not be touched as wished."""
    ways = [find_optimum(task, x0) for x0 in task.starts]
    if any(way is None for way in ways):
        return None
    for i in rng.permutation(2):
        for side in rng.permutation([1.0, -1.0]):
            most = max(float((side * way.X[1:, i]).max()) for way in ways if way is not None)
            least = max(side * task.reference[i], float((side * task.starts[:, i]).max()))
            if touching and most - least < 0.06:
                continue
            bound = least + rng.uniform(0.2, 0.9) * (most - least) if touching else max(most, least) + 0.15
            ends = np.full(2, np.inf)
            ends[i] = bound
            keep = {"x_max": ends} if side > 0 else {"x_min": -ends}
            return replace(task, limits=km.Limits(u_min=-2, u_max=2, **keep))
    return None


def take_textbook(name: str) -> CoverageTask:
    """Return a task of the judge of closed loops; its plants are of textbooks."""
    task = ALL[name]
    x0 = task.training.x0
    steps = min(task.steps, LONGEST)
    rows = task.rows[: steps + 1]
    return CoverageTask(
        name=name,
        plant=task.plant,
        gather=partial(task.data, 0),
        cost=km.Cost(Q=task.Q, R=task.R, of=task.of, u_target="zero" if task.u_target == "zero" else "equilibrium"),
        limits=task.limits,
        horizon=task.horizon,
        reference=rows if (rows != rows[0]).any() else rows[0],
        starts=np.array(task.starts),
        steps=steps,
        held=held(name)[:steps],
        runs=FEW,
        spread=0.02 * (np.asarray(x0.high) - np.asarray(x0.low)),
        noise=0.0,
        delays=(0,) if task.measured else (2,),
    )


def list_tasks() -> dict[str, Callable[[], CoverageTask]]:
    """Return all 88, by name."""
    tasks: dict[str, Callable[[], CoverageTask]] = {}
    for k, name in enumerate(TEXTBOOK):  # in turn, so that a measurement that ends early has some of both
        tasks |= {f"random {seed}": partial(draw_task, seed) for seed in range(3 * k, 3 * k + 3)}
        tasks[name] = partial(take_textbook, name)
    return tasks
