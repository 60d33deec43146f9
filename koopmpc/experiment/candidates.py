"""Candidate excitations: random steps, sums of sines, and loops with moved set points and dither, at several sizes."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from koopmpc.control.limits import Interval

SCALES = (1.0, 0.7, 0.45, 0.25, 0.12, 0.05)  # shares of the range of inputs, or of set points
DRAWS = 2  # candidates of each kind and size
_HOLDS = (1, 2, 4, 8, 16, 32)  # steps for which a level is held
_LINES = 8  # sines of a sum
_DITHER = 0.4  # share of a loop's size that its dither has


@dataclass(frozen=True, eq=False)
class CandidateBatch:
    """Candidates, one a row: u = base − on · K (ζ − target), before limits.

    Attributes
    ----------
    base
        (T, loops, nu) inputs.
    target
        (T, loops, nx) states that a loop is to reach.
    on
        (loops,) 1 for a loop, 0 for a plan of inputs.
    names
        What each one is.
    """

    base: Float[np.ndarray, "T loops nu"]
    target: Float[np.ndarray, "T loops nx"]
    on: Float[np.ndarray, " loops"]
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ExperimentRoom:
    """The room of an experiment: rest (x, u), ranges of inputs and of set points around it.

    Attributes
    ----------
    x, u
        (nx,) and (nu,): the middle of the visits.
    inputs, states
        Ranges of inputs, and of states to which set points may move.
    """

    x: Float[np.ndarray, " nx"]
    u: Float[np.ndarray, " nu"]
    inputs: Interval
    states: Interval


def draw_candidates(rooms: Sequence[ExperimentRoom], steps: int, rng: np.random.Generator) -> CandidateBatch:
    """Return the library of candidates for one episode, around the middle of each room."""
    nu, nx = len(rooms[0].u), len(rooms[0].x)
    base: list[np.ndarray] = []
    target: list[np.ndarray] = []
    on: list[float] = []
    names: list[str] = []

    def add(U: np.ndarray, X: np.ndarray, loop: float, name: str) -> None:
        base.append(U)
        target.append(X)
        on.append(loop)
        names.append(name)

    for room, scale in product(rooms, SCALES):
        rest_x = np.tile(room.x, (steps, 1))
        for _ in range(DRAWS):
            add(spread_levels(draw_steps(steps, nu, rng), room.u, room.inputs, scale), rest_x, 0.0, "random steps")
            add(spread_levels(draw_sines(steps, nu, rng), room.u, room.inputs, scale), rest_x, 0.0, "a sum of sines")
            dither = draw_steps(steps, nu, rng, _HOLDS[:3])
            small = spread_levels(dither, room.u, room.inputs, _DITHER * scale)
            moved = spread_levels(draw_steps(steps, nx, rng, _HOLDS[3:]), room.x, room.states, scale)
            add(small, moved, 1.0, "the loop with moved set points and dither")
            full = spread_levels(dither, room.u, room.inputs, scale)
            add(full, rest_x, 1.0, "the loop with dither")
    for room in rooms:
        add(np.tile(room.u, (steps, 1)), np.tile(room.x, (steps, 1)), 1.0, "the loop alone")
    return CandidateBatch(
        np.array(base).transpose(1, 0, 2), np.array(target).transpose(1, 0, 2), np.array(on), tuple(names)
    )


def draw_steps(
    steps: int, n: int, rng: np.random.Generator, holds: tuple[int, ...] = _HOLDS
) -> Float[np.ndarray, "T n"]:
    """Return levels in −1 … 1 that are held for times drawn from `holds`, each column by itself."""
    columns = np.empty((steps, n))
    for i in range(n):
        k = 0
        while k < steps:
            hold = int(rng.choice(holds))
            columns[k : k + hold, i] = rng.uniform(-1, 1)
            k += hold
    return columns


def draw_sines(steps: int, n: int, rng: np.random.Generator) -> Float[np.ndarray, "T n"]:
    """Return sums of sines with random phases and a peak of 1, periods from four steps to the whole experiment."""
    slowest, fastest = 1.0 / max(steps, 8), 0.25
    k = np.arange(steps)[:, None, None]
    frequency = np.exp(rng.uniform(np.log(slowest), np.log(fastest), (n, _LINES)))
    wave = np.sin(2 * np.pi * (frequency * k + rng.uniform(size=(n, _LINES)))).sum(axis=2)
    return wave / np.maximum(np.abs(wave).max(axis=0), 1e-12)


def spread_levels(
    levels: Float[np.ndarray, "T n"], middle: Float[np.ndarray, " n"], box: Interval, scale: float
) -> Float[np.ndarray, "T n"]:
    """Return levels of −1 … 1 as values of a box, `scale` of the way from the middle to its ends."""
    up, down = np.maximum(box.high - middle, 0.0), np.maximum(middle - box.low, 0.0)
    return middle + scale * np.where(levels > 0, levels * up, levels * down)


@dataclass(eq=False)
class InputLimiter:
    """Clips the inputs of many loops to their limits and rates; `last` are the inputs before, None at the start."""

    box: Interval
    rates: Interval
    last: Float[np.ndarray, "*batch nu"] | None = None

    def __call__(self, u: Float[np.ndarray, "*batch nu"]) -> Float[np.ndarray, "*batch nu"]:
        """Return the inputs that the limits allow."""
        if self.last is not None:
            u = np.clip(u, self.last + self.rates.low, self.last + self.rates.high)
        self.last = np.clip(u, self.box.low, self.box.high)
        return self.last
