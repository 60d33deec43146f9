"""A link whose payload grows by half while it is controlled, and the controllers that face it."""

from dataclasses import dataclass, field

import numpy as np

import koopmpc as km
from tests.closed_loop.plants import Arm

DT, STEPS, HORIZON = 0.05, 400, 20
COST = km.Cost(Q=[100.0, 1.0], R=0.01)
LIMITS = km.Limits(u_min=-15.0, u_max=15.0)
LIFTING = km.State() + km.Fourier(1, states=[0]) + km.Constant()
KNOTS = np.linspace(1.0, 1.5, 11)  # payloads of the models of the controller that is told [kg]


def payloads(drift: float, steps: int = STEPS) -> np.ndarray:
    """Return the payload at each step: 1 kg for a quarter of the run, then it grows for a quarter, then it stays."""
    t = np.arange(steps) / steps
    return 1.0 + drift * np.clip((t - 0.25) / 0.25, 0.0, 1.0)


def reference(steps: int = STEPS) -> np.ndarray:
    """Return (steps + 1, 2) rows: the angle goes to and fro in steps and in a sine, at rest in between."""
    k = np.arange(steps + 1)
    angle = 1.0 * np.sin(2 * np.pi * k / 130) + np.where(k % 100 < 50, 0.3, -0.3)
    return np.column_stack([angle, np.zeros(steps + 1)])


@dataclass
class DriftingArm:
    """The plant: the payload of step k is `m[k]`."""

    m: np.ndarray
    noise: float = 0.0
    dt: float = DT
    states: tuple = Arm.states
    inputs: tuple = Arm.inputs
    outputs: tuple = Arm.states
    state: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self):
        levels, self._of = np.unique(np.round(self.m, 3), return_inverse=True)
        self._maps = [km.discretize(Arm(m=float(m)), DT) for m in levels]

    def reset(self, x0, rng):
        self.state, self._k, self._rng = np.array(x0, float), 0, np.random.default_rng(rng)
        return self.state.copy()

    def step(self, u):
        step_map = self._maps[self._of[min(self._k, len(self._of) - 1)]]
        self.state, self._k = np.asarray(step_map(self.state, u)).ravel(), self._k + 1
        return self.state + self.noise * self._rng.standard_normal(2)


def data(m: float = 1.0, seed: int = 0, noise: float = 0.0) -> km.Episodes:
    plant, rng = km.discretize(Arm(m=m), DT), np.random.default_rng(seed)
    clean = km.collect(
        plant, km.Uniform([-1.5, -4], [1.5, 4]), km.Noise(-15, 15, hold=4), episodes=50, steps=50, rng=rng
    )
    return clean.with_episodes([km.Episode(X=e.X + noise * rng.standard_normal(e.X.shape), U=e.U) for e in clean])


class Told:
    """A KoopmanMPC that is given, at every step, the model that was fitted to data of the nearest payload."""

    def __init__(self, m: np.ndarray, seed: int = 0, noise: float = 0.0) -> None:
        self.models = [km.edmd(data(float(knot), seed, noise), LIFTING) for knot in KNOTS]
        self.m, self.mpc = m, km.KoopmanMPC(self.models[0], COST, LIMITS, HORIZON)
        self.dt, self.nu, self.horizon = self.mpc.dt, self.mpc.nu, self.mpc.horizon

    def reset(self, x0=None, u_prev=None):
        self.k, self.used = 0, 0
        self.mpc.update(self.models[0])
        self.mpc.reset(x0, u_prev)

    def __call__(self, y, reference, applied=None, w=None):
        knot = int(np.argmin(np.abs(KNOTS - self.m[self.k])))
        if knot != self.used:
            self.mpc.update(self.models[knot])
            self.used = knot
        self.k += 1
        return self.mpc(y, reference, applied, w)


def controllers(m: np.ndarray, seed: int = 0, noise: float = 0.0) -> dict:
    """Return the controllers of the drift bench."""
    train = data(1.0, seed, noise)
    model = km.edmd(train, LIFTING)
    online = km.OnlineEDMD.start(train, LIFTING, forgetting=0.98)
    return {
        "told": Told(m, seed, noise),
        "adaptive": km.supervise.Adaptive(km.KoopmanMPC(model, COST, LIMITS, HORIZON), online),
        "fixed": km.KoopmanMPC(model, COST, LIMITS, HORIZON),
        "offset-free": km.KoopmanMPC(model, COST, LIMITS, HORIZON, estimator=km.LiftedDisturbance()),
    }


def run(controller, m: np.ndarray, noise: float = 0.0, u_reference=None) -> km.Run:
    return km.simulate(
        DriftingArm(m, noise),
        controller,
        x0=[0.0, 0.0],
        reference=reference(len(m)),
        steps=len(m),
        cost=COST,
        limits=LIMITS,
    )
