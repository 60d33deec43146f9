"""The bilinear motor of Korda & Mezić: control from its speed alone, beside MPC linearised anew at every step."""

from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.bench.library import load_problem
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.linear.koopman_mpc import KoopmanMPC, LinearMPC
from koopmpc.control.move import Status
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import unwarned
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.radial import ThinPlate
from koopmpc.lifting.state import State
from koopmpc.papers.registry import Claim, Tell, compared, judged, show
from koopmpc.plants.step_map import StepMap, discretize
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.recording.page import Page

DT, STEPS, HORIZON, LIMIT = 0.01, 300, 100, 0.4
K = np.arange(STEPS + 1)
STEP, COSINE = np.where(K <= 150, -0.3, 0.3), 0.5 * np.cos(2 * np.pi * K / STEPS)
SOLVED = (Status.UNCONSTRAINED, Status.OPTIMAL)


class Loop(NamedTuple):
    """A closed loop: speed and input, Σ (y − r)² + 0.01 u², the status of each step, and its median time [s]."""

    y: Float[np.ndarray, " T"]
    u: Float[np.ndarray, " T"]
    cost: float
    statuses: list[Status]
    time: float

    @property
    def solved(self) -> int:
        """How many steps ended with every limit kept."""
        return sum(status in SOLVED for status in self.statuses)


def motor(page: Page, quick: bool, tell: Tell) -> list[Claim]:
    """Follow a step and a cosine, with lifted models of several draws and with local linearisations."""
    tell("motor: models")
    plant = discretize(load_problem("bilinear_motor").dynamics, DT)
    seeds, episodes = (1, 50) if quick else (3, 200)
    models = [_model(plant, seed, episodes) for seed in range(seeds)]
    tell("motor: closed loops")
    free = Limits(u_min=-1, u_max=1)
    cost = Cost(Q=1.0, R=0.01, tail=0, u_target="zero")
    on_speed = Cost(Q=1.0, R=0.01, tail=0, of=State("speed"), u_target="zero")
    narrow = Limits(u_min=-1, u_max=1, x_min=[-LIMIT], x_max=[LIMIT], slack=None)
    wide = Limits(u_min=-1, u_max=1, x_min=[-np.inf, -LIMIT], x_max=[np.inf, LIMIT], slack=None)
    steps = [loop(plant, KoopmanMPC(m, cost, free, HORIZON), [0.0, 0.6], STEP) for m in models]
    turns = [loop(plant, KoopmanMPC(m, cost, narrow, HORIZON), [-0.1, 0.1], COSINE) for m in models]
    local_step = loop(plant, linearised(plant, [0.0, 0.6], on_speed, free), [0.0, 0.6], STEP)
    local_turn = loop(plant, linearised(plant, [-0.1, 0.1], on_speed, wide), [-0.1, 0.1], COSINE)
    lost = next((k for k, status in enumerate(local_turn.statuses) if status not in SOLVED), None)
    page.text(
        "## The motor: control from the speed alone",
        f"""{seeds} draws of data and centres. The local MPC knows the equations and both states, and is linearised
        anew at every step, at the state and the last input. Both have hard limits; where no input
        keeps them, the last plan goes on.""",
    )
    page.table(
        ("case", "controller", "cost", "steps solved", "max |y|", "median step"),
        [
            (
                case,
                name,
                f"{one.cost:.3f}",
                f"{one.solved} of {STEPS}",
                f"{np.abs(one.y).max():.4f}",
                f"{1e3 * one.time:.2g} ms",
            )
            for case, name, one in (
                *(("step", f"Koopman MPC, draw {i}", one) for i, one in enumerate(steps)),
                ("step", "local MPC", local_step),
                *(("cosine", f"Koopman MPC, draw {i}", one) for i, one in enumerate(turns)),
                ("cosine", "local MPC", local_turn),
            )
        ],
    )
    for name, caption, reference, lifted, other in (
        ("motor-step", "The motor: step", STEP, steps[0], local_step),
        ("motor-cosine", f"The motor: cosine, with |y| ≤ {LIMIT}", COSINE, turns[0], local_turn),
    ):
        curves = {
            "reference": np.column_stack([reference[1:], np.full(STEPS, np.nan)]),
            "Koopman MPC": np.column_stack([lifted.y, lifted.u]),
            "local MPC": np.column_stack([other.y, other.u]),
        }
        show(page, name, caption, DT, ("speed y", "field u"), curves)
    totals = [one.cost for one in steps]
    spread = f"{min(totals):.3f} to {max(totals):.3f}" if seeds > 1 else f"{totals[0]:.3f}"
    widest, worst = max(float(np.abs(one.y).max()) for one in turns), min(one.solved for one in turns)
    return [
        judged(
            "motor, step: cost",
            "3.31 to 3.34",
            holds=min(totals) >= 3.305 and max(totals) <= 3.345,
            in_part=min(totals) >= 3.28 and max(totals) <= 3.36,
            why=spread,
            required=True,
        ),
        compared("motor, step: cost of the local MPC", 3.318, local_step.cost, 0.005, digits=4),
        judged(
            "motor, cosine: solved",
            "all 300 of 300 steps",
            holds=worst == STEPS,
            why=f"{worst} of {STEPS}",
            required=True,
        ),
        judged("motor, cosine: |y|", "never beyond 0.41", holds=widest <= 0.41, why=f"{widest:.4f}", required=True),
        compared("motor, cosine: cost", 2.36, float(np.mean([one.cost for one in turns])), 0.05 * 2.36, digits=3),
        judged(
            "motor, cosine: local MPC",
            "infeasible at about 0.2 s",
            holds=lost is not None and 0.1 <= (lost + 1) * DT <= 0.3,
            in_part=lost is not None,
            why="never" if lost is None else f"at {(lost + 1) * DT:.2f} s",
            required=True,
        ),
        judged(
            "motor: time of a step",
            "6.86 ms, local MPC 103 ms",
            holds=steps[0].time < 6.86e-3 and steps[0].time < local_step.time,
            why=f"{1e3 * steps[0].time:.2g} ms, local MPC {1e3 * local_step.time:.2g} ms",
        ),
    ]


def linearised(plant: StepMap, x: list[float], cost: Cost, limits: Limits) -> LinearMPC:
    """Return MPC with the horizon of the motor that `loop` linearises at every step."""
    return LinearMPC(plant, x, [0.0], cost, limits, HORIZON)


def loop(plant: StepMap, controller: KoopmanMPC, x0: list[float], reference: Float[np.ndarray, " T1"]) -> Loop:
    """Run 300 steps after one with u = 0, which fills the delay; the reference is held over the horizon.

    A `LinearMPC` measures both states, and is linearised anew at every step.
    """
    local = isinstance(controller, LinearMPC)
    controller.reset(u_prev=[0.0])
    x, u = np.array(x0), np.zeros(1)
    if not local:
        controller(x[1:], reference[:1])
    x = plant(x, u)
    Y, U, statuses, times = np.empty(STEPS), np.empty(STEPS), list[Status](), list[float]()
    for k in range(STEPS):
        own = 0.0
        if local:
            began = perf_counter()
            controller.update(LinearPredictor.local(plant, x, u))
            own = perf_counter() - began
        move = controller(x if local else x[1:], reference[k + 1 : k + 2], applied=u)
        u = move.u
        Y[k], U[k] = x[1], u[0]
        statuses.append(move.status)
        times.append(own + move.solve_time)
        x = plant(x, u)
    cost = float(np.sum((Y - reference[1:]) ** 2 + 0.01 * U**2))
    return Loop(Y, U, cost, statuses, float(np.median(times)))


def _model(plant: StepMap, seed: int, episodes: int) -> LinearPredictor:
    rng = np.random.default_rng(seed)
    U = rng.uniform(-1, 1, (episodes, 1000, 1))
    X = plant.rollouts(rng.uniform(-1, 1, (episodes, 2)), U)
    each = [Episode(X=x[:, 1:], U=u) for x, u in zip(X, U, strict=True)]
    data = Episodes(each, DT, plant.states[1:], plant.inputs)
    with unwarned():
        return edmd(data, State() + ThinPlate(rng.uniform(-1, 1, (100, 3))), embedding=Delay(1))
