"""collect: excite a plant and return the episodes that it gives."""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value, freeze
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.excitation import Excitation, OpenLoop, Policy
from koopmpc.plants.plant import Plant, read_measurement, require_plant
from koopmpc.plants.step_map import StepMap

# u = function(k, y, rng): a user's own excitation
InputFunction = Callable[[int, Float[np.ndarray, " ny"], np.random.Generator], ArrayLike]


@dataclass(frozen=True, eq=False, init=False)
class Uniform(Value):
    """Initial states uniform in the box from `low` to `high`.

    Parameters
    ----------
    low, high
        (nx,) in the units of the states; one number for `high` serves all states.

    Raises
    ------
    ShapeError, DataError
        The two have other lengths, or an end of `low` is above that of `high`.
    """

    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        lows = np.atleast_1d(checks.array(low, "low"))
        freeze(self, low=checks.array(lows, "low", (None,)), high=checks.vector(high, "high", len(lows)))
        checks.refuse_crossed(self.low, self.high, "initial state")

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count nx"]:
        """Return `count` draws, a row each."""
        return rng.uniform(self.low, self.high, (count, len(self.low)))


def collect(
    plant: StepMap | Plant,
    x0: Uniform | ArrayLike | None,
    excitation: Excitation | InputFunction,
    *,
    episodes: int,
    steps: int,
    rng: np.random.Generator | int = 0,
    measured: OpenLoop | ArrayLike | None = None,
) -> Episodes:
    """Run x_{k+1} = F(x_k, u_k, w_k) from x0 under the excitation, and return the episodes as measured.

    Parameters
    ----------
    plant
        A step map, or a plant that holds its state; then X holds y.
    x0
        `Uniform`, or (E, nx), or one (nx,) for all episodes. None: each begins where the plant itself begins.
    excitation
        An `Excitation`, or a function ``(k, y, rng) -> u``, called in the order of k.
    episodes, steps
        Number of episodes, and steps of each: X is (steps+1, ny), or less where the plant itself ends an episode.
    rng
        Generator or seed; the same seed gives the same data, whichever way the plant is run.
    measured
        w of a step map with measured disturbances: (nw,), (steps, nw) or (E, steps, nw), or an excitation without
        feedback. Its values stand in W of the episodes.

    Raises
    ------
    ShapeError
        x0, the excitation or the measured disturbances do not fit the plant.
    DataError
        A state became NaN or infinite, or the plant lacks a method.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=60, steps=30)
    >>> len(data), data[0].X.shape, data[0].U.shape
    (60, (31, 2), (30, 1))
    """
    if not isinstance(plant, StepMap):
        require_plant(plant)
    count, length = checks.count(episodes, "episodes"), checks.count(steps, "steps")
    source = checks.generator(rng)
    nu = len(plant.inputs)
    starts = None if x0 is None else _starts(x0, len(plant.states), count, source)
    streams = source.spawn(count)
    W = _measured_rows(plant, measured, length, streams)
    if isinstance(excitation, Excitation) and excitation.nu != nu:
        raise ShapeError(
            f"the excitation gives {excitation.nu} inputs, the plant takes {nu} ({', '.join(plant.inputs)}); "
            "pass one level for each input"
        )
    with np.errstate(over="ignore", invalid="ignore"):  # `_finite` reports a plant that diverges
        if not isinstance(plant, StepMap):
            policies = [_start(excitation, e, length, plant.dt, nu, own) for e, own in enumerate(streams)]
            begins = [None] * count if starts is None else starts
            runs = [_drive(plant, *each, length) for each in zip(range(count), begins, policies, streams, strict=True)]
        elif starts is None:
            raise DataError("a step map has no state of its own to begin in; pass x0, such as km.Uniform(low, high)")
        else:
            X, U = _batch(plant, starts, excitation, length, streams, W)
            Y = _measure_rows(plant, X)
            _finite(Y)
            runs = [Episode(X=y, U=u, W=w) for y, u, w in zip(Y, U, W, strict=True)]
    return Episodes(runs, plant.dt, plant.outputs, plant.inputs, getattr(plant, "disturbances", ()))


def _measured_rows(
    plant: StepMap | Plant, measured: OpenLoop | ArrayLike | None, steps: int, streams: list[np.random.Generator]
) -> Float[np.ndarray, "E T nw"]:
    """Return the measured disturbances of all episodes; (E, T, 0) for a plant without."""
    nw, count = getattr(plant, "nw", 0), len(streams)
    if not isinstance(plant, StepMap) or not nw:
        if measured is not None or nw:
            raise DataError("measured goes with a StepMap F(x, u, w); any other plant makes its own disturbances")
        return np.zeros((count, steps, 0))
    names = ", ".join(plant.disturbances)
    if measured is None:
        raise DataError(f"the plant has measured disturbances ({names}); pass measured=, such as km.Noise(low, high)")
    if isinstance(measured, OpenLoop):
        W = np.stack([measured.sequence(steps, plant.dt, own.spawn(1)[0]) for own in streams])
    else:
        W = checks.array(measured, "measured")
    if W.shape not in ((nw,), (steps, nw), (count, steps, nw)):
        raise ShapeError(
            f"measured has shape {W.shape}, expected ({nw},), ({steps}, {nw}) or ({count}, {steps}, {nw}): "
            f"a column for {names}"
        )
    return np.broadcast_to(W, (count, steps, nw))


def _drive(
    plant: Plant, e: int, x0: Float[np.ndarray, " nx"] | None, policy: Policy, rng: np.random.Generator, steps: int
) -> Episode:
    """Run one episode of a plant that holds its state, until the plant ends it."""
    ny = len(plant.outputs)
    Y, U = np.empty((steps + 1, ny)), np.empty((steps, len(plant.inputs)))
    Y[0] = read_measurement(plant.reset(x0, rng), ny, 0)
    for k in range(steps):
        U[k] = policy(k, Y[k])
        Y[k + 1] = read_measurement(plant.step(U[k]), ny, k + 1)
        _finite(Y[None, k + 1 : k + 2], e, k + 1)
        if getattr(plant, "ended", ""):
            return Episode(X=Y[: k + 2], U=U[: k + 1])
    return Episode(X=Y, U=U)


def _batch(
    plant: StepMap,
    starts: Float[np.ndarray, "E nx"],
    excitation: Excitation | InputFunction,
    steps: int,
    streams: list[np.random.Generator],
    W: Float[np.ndarray, "E T nw"],
) -> tuple[Float[np.ndarray, "E rows nx"], Float[np.ndarray, "E T nu"]]:
    """Run all episodes at once; an excitation that depends on y is called step by step."""
    if isinstance(excitation, OpenLoop):
        U = np.stack([excitation.sequence(steps, plant.dt, own) for own in streams])
        return plant.rollouts(starts, U, W), U
    policies = [_start(excitation, e, steps, plant.dt, plant.nu, own) for e, own in enumerate(streams)]
    X = np.empty((len(starts), steps + 1, plant.nx))
    moves = np.empty((len(starts), steps, plant.nu))
    X[:, 0] = starts
    for k in range(steps):
        Y = _measure_rows(plant, X[:, k : k + 1])
        _finite(Y, step=k)
        for e, policy in enumerate(policies):
            moves[e, k] = policy(k, Y[e, 0])
        X[:, k + 1] = plant.rollouts(X[:, k], moves[:, k : k + 1], W[:, k : k + 1])[:, 1]
    return X, moves


@raise_swallowed()
def _measure_rows(plant: StepMap, X: Float[np.ndarray, "E rows nx"]) -> Float[np.ndarray, "E rows ny"]:
    """Return y = h(x) for each row; X itself where all is measured."""
    x = ca.SX.sym("x", plant.nx)
    if plant.ny == plant.nx and ca.is_equal(plant.h(x), x):
        return X
    return np.stack([plant.measure(row) for row in X.reshape(-1, plant.nx)]).reshape(*X.shape[:2], plant.ny)


def _start(
    excitation: Excitation | InputFunction, episode: int, steps: int, dt: float, nu: int, rng: np.random.Generator
) -> Policy:
    """Return the policy of one episode."""
    if isinstance(excitation, Excitation):
        return excitation.choose_episode(episode).start(steps, dt, rng)
    checks.members(excitation, "excitation", ("__call__",), "pass Noise(low, high), or a function (k, y, rng) -> u")
    checks.takes(excitation, "excitation", 3, "pass a function (k, y, rng) -> u")
    return lambda k, y: checks.vector(excitation(k, y, rng), "the excitation's u", nu)


def _starts(x0: Uniform | ArrayLike, nx: int, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count nx"]:
    """Return one initial state for each episode."""
    rows = x0.sample(count, rng) if isinstance(x0, Uniform) else checks.array(x0, "x0")
    if rows.ndim == 1:
        rows = np.tile(rows, (count, 1))
    if rows.shape != (count, nx):
        raise ShapeError(
            f"x0 gives shape {rows.shape}, expected ({count}, {nx}): an episode a row, a state a column; "
            "pass Uniform(low, high), one state, or one for each episode"
        )
    return rows


def _finite(Y: Float[np.ndarray, "E rows ny"], episode: int = 0, step: int = 0) -> None:
    """Raise if a row is not finite; Y[0, 0] belongs to `episode` and `step`."""
    bad = np.argwhere(~np.isfinite(Y).all(axis=2))
    if len(bad):
        raise DataError(
            f"episode {episode + int(bad[0, 0])} is NaN or infinite from step {step + int(bad[0, 1])} on: the plant "
            "diverged; start nearer, excite less, take fewer steps, or hold it with Feedback"
        )
