"""stabilise: from short episodes near an equilibrium to a feedback that holds an unstable plant, and to data."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, FitWarning, KoopmpcError, ShapeError
from koopmpc.base.values import Value
from koopmpc.control.kinds.lqr import dlqr
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.excitation import Excitation, Feedback, Noise
from koopmpc.plants.plant import Plant, SimulatedPlant, require_plant
from koopmpc.plants.step_map import StepMap

FIRST = 0.05  # share of `reach` from which the first episodes start
WIDEST = 0.5  # share of `reach` from which the last ones may start
LOUD = (1.0, 0.5, 0.25, 0.1)  # shares of the input range that the noise of the first episodes has, tried in turn
GROWTH = 2.0  # from round to round, of starts and of lengths, while nothing is lost
HELD = 20  # runs without noise that the feedback is judged by, from nearer where too few of them stay
ENOUGH = 0.95  # share of them that must stay


@dataclass(frozen=True, eq=False)
class Stabilised(Value):
    """A feedback u = u_ref − K (x − x_ref) inside the input bounds, and the data that it took.

    Attributes
    ----------
    feedback
        An excitation for `collect`: the feedback with noise on top, so that its data tell what inputs do.
    data
        All episodes; those that were lost end where they left `reach`.
    held
        Share of the runs without noise that stayed within `reach` for all their steps.
    start
        Share of `reach` from which these runs started.
    lost
        Episodes that left `reach`.
    """

    feedback: Feedback
    data: Episodes
    held: float
    start: float
    lost: int

    @property
    def K(self) -> Float[np.ndarray, "nu nx"]:
        """The gain."""
        return self.feedback.K

    def __str__(self) -> str:
        """Return what was reached, in a sentence."""
        steps = sum(map(len, self.data))
        return (
            f"held in {self.held:.0%} of {HELD} runs from within {self.start:.0%} of the reach, after "
            f"{len(self.data)} episodes of {steps} steps in all, {self.lost} of which were lost"
        )


def stabilise(
    plant: StepMap | Plant,
    equilibrium: tuple[ArrayLike, ArrayLike],
    *,
    reach: ArrayLike,
    u_min: ArrayLike,
    u_max: ArrayLike,
    episodes: int = 12,
    steps: int = 60,
    rounds: int = 8,
    rng: np.random.Generator | int = 0,
) -> Stabilised:
    """Find a feedback that holds a plant at an unstable equilibrium, and data for `design`, without a model or a gain.

    The first episodes start close to the equilibrium under noise alone, and end where a state leaves `reach`: a plant
    that falls over has to be reset often, and each fall tells how it falls. An affine model x⁺ = A x + B u + c of all
    steps so far gives the LQR gain, with Q = 1/reach² and R = 1/(input range)², and the input that holds the
    equilibrium. The next episodes run under this feedback with noise on top, longer and from further away where none
    was lost, with half of the noise and from nearer where some were. Inputs never leave their bounds.

    Parameters
    ----------
    plant
        A step map, or a plant whose `reset` goes to the state that it is given, or near it; all states are measured.
    equilibrium
        (x, u): the state to hold, and about the input that holds it.
    reach
        (nx,) how far each state may go from the equilibrium. An episode ends there: choose what the plant survives.
    u_min, u_max
        (nu,) finite bounds of the inputs.
    episodes, steps
        Episodes of each round, and the most steps of one.
    rounds
        How many rounds there are, at most.
    rng
        Draws starts and noise.

    Raises
    ------
    DataError
        A bound is missing, the equilibrium's input is outside of it, or a reach is not above zero.
    ShapeError
        Sizes do not fit the plant.

    Warns
    -----
    FitWarning
        The feedback holds the plant in less than 95 % of the runs, even from 5 % of the reach: the input range is too
        small, the sample time too long, a state is not measured, or the plant is far from linear within the reach.
    """
    if isinstance(plant, StepMap):
        plant = SimulatedPlant(plant)
    require_plant(plant)
    draw = checks.generator(rng)
    near = _check_surroundings(plant, equilibrium, reach, u_min, u_max)
    episodes, steps, rounds = (
        checks.count(value, name) for value, name in ((episodes, "episodes"), (steps, "steps"), (rounds, "rounds"))
    )
    trials = _Trials(plant, near, draw)
    room = np.minimum(near.u - near.low, near.high - near.u)
    room = np.where(room > 0, room, (near.high - near.low) / 2)
    loud = [LOUD[i % len(LOUD)] * room for i in range(episodes)]
    shaken = [Noise(np.maximum(near.u - one, near.low), np.minimum(near.u + one, near.high), hold=2) for one in loud]
    trials.record(shaken, FIRST, max(steps // 4, 5))
    start, share, length, feedback = FIRST, 0.5, max(steps // 2, 5), None
    for _ in range(rounds):
        again = _find_feedback(trials.made, near, share * room)
        if again is None:
            continue
        feedback = again
        if trials.record([feedback] * episodes, start, length):
            share, start = share / 2, max(start / GROWTH, FIRST)
        elif length == steps and start == WIDEST:
            break
        else:
            length, start = min(int(GROWTH * length), steps), min(GROWTH * start, WIDEST)
    if feedback is None:
        raise KoopmpcError(
            f"{len(trials.made)} episodes near the equilibrium gave no model with a stabilising gain; pass wider input "
            "bounds or a larger reach, or more episodes"
        )
    held, start = trials.measure_hold(replace(feedback, noise=None), start, steps)
    kept = Episodes([e for e in trials.made if len(e)], plant.dt, plant.states, plant.inputs)
    result = Stabilised(feedback, kept, held, start, trials.lost)
    if held < ENOUGH:
        warnings.warn(
            f"{result}: give the inputs a wider range, sample faster, or measure what is not measured; a smaller reach "
            "keeps the plant where it is nearly linear",
            FitWarning,
            stacklevel=2,
        )
    return result


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """An equilibrium (x, u), how far each state may go from it, and the bounds of the inputs."""

    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    size: Float[np.ndarray, " nx"]
    low: Float[np.ndarray, " nu"]
    high: Float[np.ndarray, " nu"]

    def hold(self, y: Float[np.ndarray, " nx"]) -> bool:
        """Return whether a reading is within the reach."""
        return bool((np.abs(y - self.x) <= self.size).all())


def _check_surroundings(
    plant: Plant, equilibrium: tuple[ArrayLike, ArrayLike], reach: ArrayLike, u_min: ArrayLike, u_max: ArrayLike
) -> _Surroundings:
    nu = len(plant.inputs)
    checks.kind(equilibrium, "equilibrium", (tuple, list), "pass (x, u) of the resting plant")
    if len(equilibrium) != 2:
        raise ShapeError(f"equilibrium has {len(equilibrium)} parts; pass (x, u) of the resting plant")
    x = np.atleast_1d(checks.array(equilibrium[0], "the equilibrium's state"))
    if len(plant.outputs) != len(x):
        raise DataError(
            f"the equilibrium has {len(x)} states and the plant measures {len(plant.outputs)}: pass all that is "
            "measured; a feedback of states needs every one of them"
        )
    u, size = checks.vector(equilibrium[1], "the equilibrium's input", nu), checks.vector(reach, "reach", len(x))
    low, high = checks.vector(u_min, "u_min", nu), checks.vector(u_max, "u_max", nu)
    checks.refuse_crossed(low, high, "input")
    if (size <= 0).any():
        raise DataError(f"reach is {size}; pass a distance above zero for each state, beyond which an episode ends")
    if ((u < low) | (u > high)).any() or (low == high).any():
        raise DataError(f"the equilibrium's input is {u}; it must lie inside u_min {low} and u_max {high}")
    return _Surroundings(x, u, size, low, high)


class _Trials:
    """Runs of a plant near an equilibrium, which end where it leaves the reach."""

    def __init__(self, plant: Plant, near: _Surroundings, draw: np.random.Generator) -> None:
        self._plant, self._near, self._draw = plant, near, draw
        self.made, self.lost = list[Episode](), 0

    def record(self, policies: Sequence[Excitation], start: float, steps: int) -> int:
        """Keep an episode of each policy, and return how many did not stay."""
        ran = [self.run(policy, start, steps) for policy in policies]
        self.made += [episode for episode, _ in ran]
        fallen = sum(not whole for _, whole in ran)
        self.lost += fallen
        return fallen

    def measure_hold(self, feedback: Feedback, start: float, steps: int) -> tuple[float, float]:
        """Return the share of runs that stay, and from where: nearer until enough of them do."""
        held, start = 0.0, GROWTH * start
        while held < ENOUGH and start > FIRST:
            start = max(start / GROWTH, FIRST)
            held = float(np.mean([self.run(feedback, start, steps)[1] for _ in range(HELD)]))
        return held, start

    def run(self, excitation: Excitation, start: float, steps: int) -> tuple[Episode, bool]:
        """Return an episode from within `start` of the reach, and whether it stayed for all steps."""
        plant, near = self._plant, self._near
        policy = excitation.start(steps, plant.dt, self._draw)
        x0 = near.x + start * near.size * self._draw.uniform(-1, 1, len(near.size))
        y = np.asarray(plant.reset(x0, self._draw), dtype=np.float64)
        X, U, inside = [y], list[Float[np.ndarray, " nu"]](), near.hold(y)
        while len(U) < steps and inside and not getattr(plant, "ended", ""):
            u = np.asarray(policy(len(U), y), dtype=np.float64)
            y = np.asarray(plant.step(u.copy()), dtype=np.float64)
            inside = near.hold(y)
            if not np.isfinite(y).all():
                break
            X.append(y)
            U.append(u)
        episode = Episode(X=np.array(X), U=np.array(U).reshape(len(U), len(plant.inputs)))
        return episode, inside and len(U) == steps


def _find_feedback(made: Sequence[Episode], near: _Surroundings, loud: Float[np.ndarray, " nu"]) -> Feedback | None:
    """Return the LQR of the affine model of all steps around the input that holds x, with noise; None without one.

    A step weighs exp(−d²), d its distance to the equilibrium in units of the reach, so that the model tells how the
    plant leaves the equilibrium.
    """
    room = (near.high - near.low) / 2
    X, X_next = (np.concatenate([episode.X[rows] for episode in made]) for rows in (slice(-1), slice(1, None)))
    U = np.concatenate([episode.U for episode in made])
    Z, V, Z_next = (X - near.x) / near.size, (U - near.u) / room, (X_next - near.x) / near.size
    nx, nu = Z.shape[1], V.shape[1]
    P = np.hstack([Z, V, np.ones((len(Z), 1))])
    if len(P) < 2 * P.shape[1]:
        return None
    weight = np.exp(-(Z**2).sum(axis=1) / 2)[:, None]  # its square is the weight
    ridge = np.sqrt(1e-9 * len(P)) * np.eye(P.shape[1])
    theta = np.linalg.lstsq(
        np.vstack([P * weight, ridge]), np.vstack([(Z_next - Z) * weight, np.zeros((len(ridge), nx))]), rcond=None
    )[0]
    A, B, c = np.eye(nx) + theta[:nx].T, theta[nx : nx + nu].T, theta[-1]
    try:
        K = dlqr(A, B, np.eye(nx), np.eye(nu)).K
    except KoopmpcError:
        return None
    hold = np.clip(near.u - room * (np.linalg.pinv(B, rcond=1e-6) @ c), near.low, near.high)
    return Feedback(room[:, None] * K / near.size, Noise(-loud, loud, hold=2), near.x, hold, near.low, near.high)
