"""`find_drift` on nonlinear plants: how often unchanged ones are named, and changes of a fifth by their name."""

import argparse
import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np

import koopmpc as km

FILE = Path(__file__).with_suffix(".json")
DT = 0.1
OLD, NEW, QUIET = (6, 150), (1, 500), (1, 300)  # episodes and steps
HOLD = 5  # steps of an input's level
NOISE = 0.005  # of the sensors, as a share of the states' spread
SLOWEST = -0.5  # largest real part of the eigenvalues in rest
WILDEST = 10.0  # plants whose states go beyond are drawn again
FAR = 6.0  # an input in whose reach there are no old data


@dataclass(frozen=True)
class Verdicts:
    """What `find_drift` said of one plant.

    Attributes
    ----------
    unchanged, quiet, far
        Verdicts on the same plant with another set point and load, with hardly any excitation, and far from the data.
    compared
        How many of the rows far from the data were compared.
    kind, changed, right
        What was changed by a fifth, the verdict, and whether what changed is among the names.
    """

    unchanged: str
    quiet: str
    far: str
    compared: int
    kind: str
    changed: str
    right: bool


@dataclass(frozen=True, eq=False)
class DrawnPlant(km.Dynamics):
    """ẋ = A x + B u + C sin(2x) x_0 + D x u_0 + load: without a load each is at rest in 0."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    load: np.ndarray | float = 0.0
    states = ("a", "b", "c")
    inputs = ("u", "v")

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ."""
        return self.A @ x + self.B @ u + self.C @ ca.sin(2 * x) * x[0] + self.D @ x * u[0] + self.load


def build_plant(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, load: np.ndarray | float = 0.0
) -> km.StepMap:
    """Return the step map of a `DrawnPlant` with as many names as it has states and inputs."""

    class Plant(DrawnPlant):
        states, inputs = DrawnPlant.states[: len(A)], DrawnPlant.inputs[: B.shape[1]]

    return km.discretize(Plant(A, B, C, D, load), DT)


@dataclass(frozen=True, eq=False)
class BentPlant:
    """A `DrawnPlant` that is stable, with sensors."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    load: np.ndarray | float = 0.0
    gain: np.ndarray | float = 1.0
    sensor: np.ndarray | float = 1.0

    def log(
        self,
        size: tuple[int, int],
        rng: np.random.Generator,
        noise: np.ndarray | float,
        *,
        amplitude: float = 1.0,
        middle: float = 0.0,
    ) -> km.Episodes:
        """Return logs from rest under random steps, without rows that are beyond all bounds."""
        episodes, steps = size
        nx, nu = self.B.shape
        plant = build_plant(self.A, self.B, self.C, self.D, self.load)
        levels = rng.uniform(-1, 1, (episodes, -(-steps // HOLD), nu))
        U = middle + amplitude * np.repeat(levels, HOLD, axis=1)[:, :steps]
        X = plant.rollouts(np.zeros((episodes, nx)), self.gain * U)
        Y = X * self.sensor + noise * rng.standard_normal(X.shape)
        return km.Episodes([km.Episode(X=y, U=u) for y, u in zip(Y, U, strict=True)], DT, plant.states, plant.inputs)


def draw_bent(rng: np.random.Generator) -> tuple[BentPlant, np.ndarray]:
    """Return a plant whose states stay bounded under random steps, and their spread."""
    while True:
        nx = int(rng.integers(1, 4))
        nu = int(rng.integers(1, 3)) if nx > 1 else 1
        A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
        A += (SLOWEST - np.linalg.eigvals(A).real.max()) * np.eye(nx)
        bent = BentPlant(A, B, 0.3 * rng.normal(size=(nx, nx)), 0.2 * rng.normal(size=(nx, nx)))
        try:
            X = np.concatenate([e.X for e in bent.log((2, 400), rng, 0.0)])
        except km.errors.DataError:
            continue
        if np.abs(X).max() < WILDEST:
            return bent, X.std(axis=0)


def _change(bent: BentPlant, number: int, rng: np.random.Generator) -> tuple[BentPlant, str, str]:
    """Return the plant with one thing changed by a fifth, its kind, and its name."""
    share, kind = float(rng.choice([0.8, 1.2])), ("input", "sensor", "coefficient")[number % 3]
    nx, nu = bent.B.shape
    states, inputs = ("a", "b", "c")[:nx], ("u", "v")[:nu]
    if kind == "input":
        j, gain = int(rng.integers(nu)), np.ones(nu)
        gain[j] = share
        return replace(bent, gain=gain), kind, f"the gain of {inputs[j]}"
    if kind == "sensor":
        j, sensor = int(rng.integers(nx)), np.ones(nx)
        sensor[j] = share
        return replace(bent, sensor=sensor), kind, f"the sensor of {states[j]}"
    i, j = np.unravel_index(int(np.argmax(np.abs(bent.A))), bent.A.shape)
    A = bent.A.copy()
    A[i, j] *= share
    return replace(bent, A=A), kind, f"the coefficient of {states[j]} in the change of {states[i]}"


def judge_drift(number: int) -> Verdicts:
    """Return the verdicts on the plant of this number."""
    rng = np.random.default_rng([3500, number])
    bent, size = draw_bent(rng)
    noise = NOISE * size
    old = bent.log(OLD, rng, noise)
    load = rng.uniform(-0.05, 0.05, len(size)) * size * (number % 2)
    moved = replace(bent, load=load).log(
        NEW, rng, noise, amplitude=0.8, middle=rng.uniform(-0.3, 0.3) * (number % 3 > 0)
    )
    quiet = bent.log(QUIET, rng, noise, amplitude=0.005)
    try:
        away = km.validate.find_drift(old, bent.log(QUIET, rng, noise, amplitude=0.3, middle=FAR))
        far, compared = away.verdict, away.inside
    except km.KoopmpcError:  # the plant does not bear it
        far, compared = "diverged", 0
    other, kind, name = _change(bent, number, rng)
    found = km.validate.find_drift(old, replace(other, load=load).log(NEW, rng, noise))
    return Verdicts(
        km.validate.find_drift(old, moved).verdict,
        km.validate.find_drift(old, quiet).verdict,
        far,
        compared,
        kind,
        found.verdict,
        name in {one.name for one in found.changes},
    )


def load_rows() -> dict[str, Verdicts]:
    """Return the stored rows, by the number of their plant."""
    return {name: Verdicts(**row) for name, row in json.loads(FILE.read_text()).items()}


def main() -> int:
    """Judge plants again and store their rows."""
    parser = argparse.ArgumentParser(prog="python -m tests.drift.nonlinear", description=__doc__)
    parser.add_argument("--first", type=int, default=0, help="number of the first plant")
    parser.add_argument("--count", type=int, default=10, help="number of plants")
    asked = parser.parse_args()
    rows = load_rows() | {str(n): judge_drift(n) for n in range(asked.first, asked.first + asked.count)}
    lines = [f"{json.dumps(name)}: {json.dumps(asdict(row))}" for name, row in rows.items()]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
