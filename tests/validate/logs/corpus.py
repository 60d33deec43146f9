"""Logs of varied plants, clean and with one fault each, for the tests of the audit."""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

import koopmpc as km
from tests.closed_loop.plants import Arm, Bellows, Crane, Rotor, Tanks, VanDerPol, Wells
from tests.example_plants import CartPole


@dataclass(frozen=True)
class Motor(km.Dynamics):
    """A DC motor with a flexible shaft."""

    states = ("angle [rad]", "speed [rad/s]", "current [A]")
    inputs = ("voltage [V]",)

    def rhs(self, x, u):
        return ca.vertcat(x[1], (0.5 * x[2] - 0.1 * x[1] - 2.0 * ca.sin(x[0])) / 0.05, (u[0] - x[2] - 0.5 * x[1]) / 0.1)


@dataclass(frozen=True)
class Oven(km.Dynamics):
    """Two chambers with a heater each, and losses that grow faster than the temperature."""

    states = ("T1 [K]", "T2 [K]")
    inputs = ("heater 1 [W]", "heater 2 [W]")

    def rhs(self, x, u):
        loss = [0.8 * (x[i] - 290) + 5e-3 * (x[i] - 290) ** 2 for i in (0, 1)]
        flow = 0.5 * (x[1] - x[0])
        return ca.vertcat((u[0] - loss[0] + flow) / 40, (u[1] - loss[1] - flow) / 60)


@dataclass(frozen=True)
class Mass(km.Dynamics):
    """A mass on a rail with linear friction."""

    states = ("p [m]", "v [m/s]")
    inputs = ("force [N]",)

    def rhs(self, x, u):
        return ca.vertcat(x[1], u[0] - 0.4 * x[1])


@dataclass(frozen=True)
class Lake(km.Dynamics):
    """Predator and prey, of which a part is taken out or put in."""

    states = ("prey", "predators")
    inputs = ("stocking",)

    def rhs(self, x, u):
        return ca.vertcat(x[0] * (1 - 0.5 * x[0] - x[1]) + u[0], x[1] * (x[0] - 0.4 - 0.3 * x[1]))


@dataclass(frozen=True)
class Bed:
    """A plant with the ranges in which it is run."""

    plant: km.Dynamics
    dt: float
    x0: tuple
    u: tuple
    K: tuple  # a feedback that is stable there


BEDS = {
    "arm": Bed(Arm(), 0.05, ([-1.2, -2], [1.2, 2]), ([-4], [4]), [[2.0, 0.6]]),
    "rotor": Bed(Rotor(), 0.1, ([-2, -2], [2, 2]), ([-2], [2]), [[1.0, 0.5]]),
    "crane": Bed(Crane(), 0.1, ([-2, -0.8, -0.3, -0.6], [2, 0.8, 0.3, 0.6]), ([-1.5], [1.5]), [[0.5, 1.0, -0.5, 0.0]]),
    "wells": Bed(Wells(), 0.1, ([-1.8, -2], [1.8, 2]), ([-2], [2]), [[2.0, 1.0]]),
    "van der pol": Bed(VanDerPol(), 0.1, ([-2, -2], [2, 2]), ([-2], [2]), [[1.0, 2.0]]),
    "tanks": Bed(Tanks(), 4.0, ([6, 6, 0.5, 0.5], [18, 18, 4, 4]), ([1, 1], [5, 5]), [[0.2, 0, 0, 0.1], [0, 0.2, 0.1, 0]]),
    "bellows": Bed(Bellows(), 0.02, ([0, 0, -1e-3], [2.5e4, 2.5e-4, 1e-3]), ([0], [1]), [[1e-5, 0.0, 0.0]]),
    "cart-pole": Bed(CartPole(), 0.04, ([-1, np.pi - 1, -1, -1], [1, np.pi + 1, 1, 1]), ([-4], [4]), [[1, 0, 2, 0]]),
    "motor": Bed(Motor(), 0.03, ([-2, -3, -1], [2, 3, 1]), ([-6], [6]), [[3.0, 0.4, 0.2]]),
    "oven": Bed(Oven(), 5.0, ([290, 290], [330, 330]), ([0, 0], [60, 60]), [[1.5, 0.0], [0.0, 1.5]]),
    "mass": Bed(Mass(), 0.1, ([-1, -1], [1, 1]), ([-2], [2]), [[1.0, 1.2]]),
    "lake": Bed(Lake(), 0.2, ([0.5, 0.3], [1.2, 0.9]), ([0], [0.2]), [[0.3, 0.1]]),
}  # fmt: skip

ANGLES = {"arm": 0, "rotor": 0, "cart-pole": 1, "motor": 0}  # beds whose angle turns over, and its column


@dataclass(frozen=True)
class Draw:
    """Everything that varies from one log to the next."""

    bed: str
    dt: float
    episodes: int
    steps: int
    noise: float  # of the sensors, as a share of the spread of each state
    process: float  # unmeasured inputs, as a share of the range of the inputs
    drive: str
    hold: int


def draw(
    rng: np.random.Generator, bed: str | None = None, drives=("noise", "prbs", "multisine", "chirp", "loop")
) -> Draw:
    bed = str(rng.choice(list(BEDS))) if bed is None else bed
    episodes = int(rng.choice([1, 4, 15, 40, 80]))
    steps = int(rng.integers(1500, 4000) / episodes) if episodes < 15 else int(rng.integers(40, 120))
    return Draw(
        bed,
        BEDS[bed].dt * float(rng.choice([0.5, 1.0, 1.5])),
        episodes,
        steps,
        float(rng.choice([0.0, 0.0, 1e-4, 1e-3, 5e-3, 2e-2])),
        float(rng.choice([0.0, 0.0, 0.02, 0.1])),
        str(rng.choice(list(drives))),
        int(rng.choice([1, 3, 5, 10])),
    )


def driven(of: Draw, rng: np.random.Generator) -> np.ndarray:
    """Return commands (episodes, steps, nu) inside the range of the bed."""
    bed = BEDS[of.bed]
    low, high = np.array(bed.u[0], float), np.array(bed.u[1], float)
    middle, half = (low + high) / 2, (high - low) / 2
    E, T, nu = of.episodes, of.steps, len(low)
    if of.drive in ("noise", "loop"):
        blocks = rng.uniform(-1, 1, (E, T // of.hold + 1, nu))
        V = np.repeat(blocks, of.hold, axis=1)[:, :T]
    elif of.drive == "prbs":
        blocks = rng.choice([-1.0, 1.0], (E, T // of.hold + 1, nu))
        V = np.repeat(blocks, of.hold, axis=1)[:, :T]
    else:
        t = np.arange(T) / T
        if of.drive == "chirp":
            f0, f1 = 1.0, max(T / 20, 4.0)
            phase = rng.uniform(0, 2 * np.pi, (E, 1, nu)) + (np.arange(nu) + 1) * np.pi
            V = np.sin(2 * np.pi * (f0 * t + (f1 - f0) * t**2 / 2)[None, :, None] * (1 + 0.3 * np.arange(nu)) + phase)
        else:
            tones = np.arange(1, max(T // 15, 8))[:12]
            phase = rng.uniform(0, 2 * np.pi, (E, 1, nu, len(tones)))
            V = np.sin(2 * np.pi * t[None, :, None, None] * tones + phase).sum(axis=-1) / np.sqrt(2 * len(tones))
            V = np.clip(V, -1, 1) if rng.random() < 0.5 else V / np.abs(V).max()
    return middle + half * V


def simulated(
    of: Draw,
    rng: np.random.Generator,
    applied: Callable[[np.ndarray], np.ndarray] = lambda U: U,
    dt: float | None = None,
    share: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return X (E, T+1, nx) as measured and U (E, T, nu) as commanded; `applied` is what the actuator makes of it.

    With `share` the input is a feedback of the noisy measurement, and that share of its range is excitation.
    """
    bed = BEDS[of.bed]
    plant = km.discretize(bed.plant, of.dt if dt is None else dt, km.RK4(substeps=4))
    low, high = np.array(bed.x0[0], float), np.array(bed.x0[1], float)
    ulow, uhigh = np.array(bed.u[0], float), np.array(bed.u[1], float)
    U = driven(of, rng)
    X0 = rng.uniform(low, high, (of.episodes, len(low)))
    push = of.process * (uhigh - ulow) / 2 * rng.standard_normal(U.shape)
    spread = (high - low) / 4
    if share is None and of.drive == "loop":
        share = 0.6
    noise = of.noise * spread * rng.standard_normal((of.episodes, of.steps + 1, len(low)))
    if share is None:
        X = plant.rollouts(X0, applied(U) + push)
        return X + noise, U
    K, middle = np.array(bed.K, float), (low + high) / 2
    X = np.empty((of.episodes, of.steps + 1, len(low)))
    X[:, 0], V = X0, (ulow + uhigh) / 2
    for k in range(of.steps):
        U[:, k] = V - (X[:, k] + noise[:, k] - middle) @ K.T + share * (U[:, k] - V)
        X[:, k + 1] = plant.rollouts(X[:, k], (U[:, k] + push[:, k])[:, None])[:, 1]
    return X + noise, U


def episodes(of: Draw, X: np.ndarray, U: np.ndarray, dt: float | None = None) -> km.Episodes:
    plant = BEDS[of.bed].plant
    made = [km.Episode(X=x, U=u) for x, u in zip(X, U, strict=True)]
    return km.Episodes(made, of.dt if dt is None else dt, plant.states, plant.inputs)


def clean(seed: int) -> tuple[Draw, km.Episodes]:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        of = draw(rng)
        X, U = simulated(of, rng)
        if np.isfinite(X).all() and np.abs(X).max() < 1e6:
            return of, episodes(of, X, U)
    raise AssertionError("no plant stayed finite")


OPEN = ("noise", "prbs", "multisine", "chirp")
NU2 = ("tanks", "oven")
Log = tuple[km.Episodes, list[np.ndarray] | None]  # the times of the rows, where the fault is in the clock


def _some(rng, E, share=0.3):
    """Return the last episodes, about 30 % of them, or one."""
    return np.arange(E)[-max(1, round(share * E)) :]


def _stretches(rng, T, count, length):
    """Return `count` stretches of `length` rows inside 0 … T."""
    starts = rng.choice(
        np.arange(3, max(T - length - 3, 5)), size=min(count, max((T - 8) // (length + 6), 1)), replace=False
    )
    return [(int(a), int(a) + length) for a in starts]


def _late_input(of, rng):
    d = int(rng.integers(1, 5))
    return simulated(of, rng, lambda U: np.concatenate([np.repeat(U[:, :1], d, axis=1), U[:, :-d]], axis=1))


def _actuator(of, rng):
    low, high = (np.array(end, float) for end in BEDS[of.bed].u)
    share = rng.uniform(0.35, 0.7)
    middle, half = (low + high) / 2, share * (high - low) / 2
    return simulated(of, rng, lambda U: np.clip(U, middle - half, middle + half))


def _sensor_limit(of, rng):
    X, U = simulated(of, rng)
    i = int(rng.integers(X.shape[2]))
    low, high = np.quantile(X[..., i], [0.07, 0.93])
    X[..., i] = np.clip(X[..., i], low if rng.random() < 0.5 else -np.inf, high)
    return X, U


def _coarse(of, rng):
    X, U = simulated(of, rng)
    i = int(rng.integers(X.shape[2]))
    step = np.ptp(X[..., i]) / rng.integers(15, 60)
    X[..., i] = np.round(X[..., i] / step) * step
    return X, U


def _stuck(of, rng):
    X, U = simulated(of, rng)
    i, E = int(rng.integers(X.shape[2])), X.shape[0]
    for e in _some(rng, E, 0.1):
        a = int(rng.integers(2, X.shape[1] // 3))
        X[e, a : a + max(20, X.shape[1] // 4), i] = X[e, a, i]
    return X, U


def _swapped(of, rng):
    X, U = simulated(of, rng)
    i, j = rng.choice(X.shape[2], 2, replace=False)
    which = _part(rng, X)
    X[which[0], which[1], i], X[which[0], which[1], j] = (
        X[which[0], which[1], j].copy(),
        X[which[0], which[1], i].copy(),
    )
    return X, U


def _part(rng, X, share=0.3):
    """Return the last episodes and all rows; of one episode the last rows."""
    E, rows = X.shape[:2]
    return (
        (slice(E - max(1, round(share * E)), E), slice(None))
        if E > 1
        else (slice(0, 1), slice(int((1 - share) * rows), rows))
    )


def _flipped(of, rng):
    X, U = simulated(of, rng)
    e, k = _part(rng, X)
    i = int(rng.integers(X.shape[2]))
    X[e, k, i] *= -1
    return X, U


def _unit(of, rng):
    X, U = simulated(of, rng)
    e, k = _part(rng, X)
    X[e, k, int(rng.integers(X.shape[2]))] *= rng.choice([180 / np.pi, np.pi / 180, 1000.0, 1e-3, 100.0, 0.01, 10.0])
    return X, U


def _offset(of, rng):
    X, U = simulated(of, rng)
    e, k = _part(rng, X)
    i = int(rng.integers(X.shape[2]))
    low, high = (np.array(end, float) for end in BEDS[of.bed].x0)
    X[e, k, i] += rng.choice([-1, 1]) * rng.uniform(0.4, 0.8) * (high - low)[i]
    return X, U


def _input_flipped(of, rng):
    X, U = simulated(of, rng)
    U[_part(rng, U)] *= -1
    return X, U


def _held(of, rng):
    X, U = simulated(of, rng)
    for e in range(len(X)):
        if rng.random() < 0.5 or len(X) == 1:
            for a, b in _stretches(rng, X.shape[1], max(2, X.shape[1] // 150), int(rng.integers(2, 6))):
                X[e, a + 1 : b + 1] = X[e, a]
    return X, U


def _marks(of, rng):
    X, U = simulated(of, rng)
    i = int(rng.integers(X.shape[2]))
    low, high = X[..., i].min(), X[..., i].max()
    mark = rng.choice([low - 3 * (high - low), -9999.0, high + 10 * (high - low)])
    for _ in range(max(4, X.shape[0] * X.shape[1] // 200)):
        X[rng.integers(len(X)), rng.integers(2, X.shape[1] - 2), i] = mark
    return X, U


def _spikes(of, rng):
    X, U = simulated(of, rng)
    i = int(rng.integers(X.shape[2]))
    width = np.ptp(X[..., i])
    for _ in range(max(3, X.shape[0] * X.shape[1] // 300)):
        X[rng.integers(len(X)), rng.integers(3, X.shape[1] - 3), i] += rng.choice([-1, 1]) * width * rng.uniform(0.8, 3)
    return X, U


def _twice(of, rng):
    X, U = simulated(of, rng)
    XX, UU = [], []
    for x, u in zip(X, U, strict=True):
        again = np.sort(rng.choice(np.arange(3, len(u) - 3), max(2, len(u) // 60), replace=False))
        order = np.sort(np.concatenate([np.arange(len(x)), again]))
        XX.append(x[order])
        UU.append(u[np.minimum(order, len(u) - 1)][: len(order) - 1])
    return XX, UU


def _constant(of, rng):
    bed = BEDS[of.bed]
    level = rng.uniform(*(np.array(end, float) for end in bed.u))
    return simulated_with(of, rng, lambda U: np.broadcast_to(level, U.shape).copy())


def simulated_with(of, rng, command):
    """Return X and U where the command itself is changed."""
    box: list[np.ndarray] = []

    def applied(U):
        box.append(command(U))
        return box[0]

    X, _ = simulated(of, rng, applied)
    return X, box[0]


def _sine(of, rng):
    low, high = (np.array(end, float) for end in BEDS[of.bed].u)
    period = rng.uniform(20, 60)

    def command(U):
        k = np.arange(U.shape[1])
        return (low + high) / 2 + (high - low) / 2 * 0.8 * np.broadcast_to(
            np.sin(2 * np.pi * k / period)[None, :, None], U.shape
        )

    return simulated_with(of, rng, command)


def _together(of, rng):
    low, high = (np.array(end, float) for end in BEDS[of.bed].u)
    return simulated_with(of, rng, lambda U: low + (U[..., :1] - low[0]) / (high[0] - low[0]) * (high - low))


def _without_effect(of, rng):
    low, high = (np.array(end, float) for end in BEDS[of.bed].u)
    j = int(rng.integers(len(low)))

    def applied(U):
        V = U.copy()
        V[..., j] = (low[j] + high[j]) / 2
        return V

    return simulated(of, rng, applied)


def _feedback(of, rng):
    return simulated(of, rng, share=float(rng.choice([0.0, 0.02])))


def _late_sensor(of, rng):
    X, U = simulated(of, rng)
    i, d = int(rng.integers(X.shape[2])), int(rng.integers(1, 5))
    shifted = X[:, d:].copy()
    shifted[..., i] = X[:, :-d, i]
    return shifted, U[:, d:]


def _slow(of, rng):
    X, U = simulated(of, rng)
    i, n = int(rng.integers(X.shape[2])), int(rng.integers(2, 6))
    X[..., i] = X[:, (np.arange(X.shape[1]) // n) * n, i]
    return X, U


def _wrapped(of, rng):
    X, U = simulated(of, rng)
    i = ANGLES[of.bed]
    X[..., i] = (X[..., i] + np.pi) % (2 * np.pi) - np.pi
    if np.abs(np.diff(X[..., i])).max() < 3:
        return None
    return X, U


def _jump(of, rng):
    X, U = simulated(of, rng)
    XX, UU = [], []
    for x, u in zip(X, U, strict=True):
        a = int(rng.integers(10, len(u) // 2))
        lost = int(rng.integers(10, max(len(u) // 4, 12)))
        kept = np.concatenate([np.arange(a), np.arange(a + lost, len(x))])
        XX.append(x[kept])
        UU.append(u[kept[:-1]])
    return XX, UU


def _again(of, rng):
    X, U = simulated(of, rng)
    XX, UU = list(X), list(U)
    e = int(rng.integers(len(X)))
    return [*XX, XX[e].copy()], [*UU, UU[e].copy()]


def _swapped_inputs(of, rng):
    X, U = simulated(of, rng)
    where = _part(rng, U)
    U[where] = U[where][..., ::-1].copy()
    return X, U


def _mixed(of, rng):
    r = int(rng.choice([2, 3]))
    other = Draw(
        of.bed, of.dt * r, max(1, of.episodes // 4), max(of.steps // r, 30), of.noise, of.process, of.drive, of.hold
    )
    X, U = simulated(of, rng)
    Y, V = simulated(other, rng)
    return [*X, *Y], [*U, *V]


FAULTS = {
    "input delay": (_late_input, ("noise", "prbs", "chirp"), None),
    "actuator at its limit": (_actuator, ("noise", "multisine", "chirp"), None),
    "sensor at its limit": (_sensor_limit, OPEN, None),
    "quantised": (_coarse, OPEN, None),
    "stuck sensor": (_stuck, OPEN, None),
    "swapped sensors": (_swapped, OPEN, None),
    "sensor sign": (_flipped, OPEN, ("arm", "rotor", "crane", "wells", "van der pol", "motor", "mass", "cart-pole")),
    "unit change": (_unit, OPEN, None),
    "offset change": (_offset, OPEN, ("arm", "rotor", "wells", "van der pol", "motor", "tanks", "oven", "lake")),
    "input sign": (_input_flipped, OPEN, None),
    "held samples": (_held, OPEN, None),
    "lost samples": (_marks, OPEN, None),
    "spikes": (_spikes, OPEN, None),
    "rows twice": (_twice, OPEN, None),
    "constant input": (_constant, OPEN, None),
    "little excitation": (_sine, OPEN, None),
    "inputs together": (_together, OPEN, NU2),
    "input without effect": (_without_effect, OPEN, None),
    "feedback": (_feedback, ("noise",), tuple(name for name in BEDS if name != "bellows")),
    "late sensor": (_late_sensor, OPEN, None),
    "slow sensor": (_slow, OPEN, None),
    "wrapped angle": (_wrapped, OPEN, tuple(ANGLES)),
    "jump": (_jump, OPEN, None),
    "repeated episode": (_again, OPEN, None),
    "swapped inputs": (_swapped_inputs, OPEN, NU2),
    "mixed sampling": (_mixed, OPEN, None),
}


def faulty(kind: str, seed: int) -> tuple[Draw, km.Episodes]:
    """Return a log with one fault, of a plant drawn at random."""
    make, drives, beds = FAULTS[kind]
    rng = np.random.default_rng([seed, *kind.encode()])
    for _ in range(60):
        of = draw(rng, None if beds is None else str(rng.choice(beds)), drives)
        made = make(of, rng)
        if made is None or not all(np.isfinite(x).all() and np.abs(x).max() < 1e7 for x in made[0]):
            continue
        return of, episodes(of, *made)
    raise AssertionError("no plant stayed finite")
