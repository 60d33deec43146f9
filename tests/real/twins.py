"""Simulated plants with the troubles of measured records: hidden states, noise, friction, sensors at their limits.

Every twin is a difference map x⁺ = f(x, u, p) with one sensor y = h(x, u), written in CasADi with its parameters p as
symbols, so that the same map makes the record and is fitted to it: that fit is the best that knowledge can do.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

from tests.real.records import Record

Map = Callable[[ca.SX, ca.SX, ca.SX], ca.SX]
Feedback = Callable[[int, float, dict[str, float]], float]  # u_k of k, y_k and a memory of its own


@dataclass(frozen=True)
class Twin:
    """A plant with one input and one sensor.

    Attributes
    ----------
    name, unit, dt, inputs, outputs
        As in `Record`.
    parameters
        True values of p.
    x0
        State before the first row.
    step
        f: x⁺ of x, u and p, over one sample.
    sensor
        h: y of x, u and p, before noise.
    excite
        (rows,) inputs of a part of the record, or set points under a `feedback`, of a generator and a count of rows.
    learn, test, known
        Rows to learn from, rows to test on, and how many outputs a free run is told.
    noise
        Standard deviation of the sensor.
    quantum
        Resolution of the sensor; 0 without one.
    rails
        Lowest and highest value that the sensor shows.
    late
        Row k of the record holds y after u_k has acted, as where the log writes its input column a row late.
    feedback
        A controller that runs the plant: u_k of the set point and y_k.
    """

    name: str
    unit: str
    dt: float
    inputs: tuple[str]
    outputs: tuple[str]
    parameters: tuple[float, ...]
    x0: tuple[float, ...]
    step: Map
    sensor: Map
    excite: Callable[[np.random.Generator, int], np.ndarray]
    learn: int
    test: int
    known: int
    noise: float
    quantum: float = 0.0
    rails: tuple[float, float] = (-np.inf, np.inf)
    late: bool = False
    feedback: Callable[[], Callable[[float, float], float]] | None = None

    @cached_property
    def _functions(self) -> tuple[ca.Function, ca.Function]:
        x, u, p = ca.SX.sym("x", len(self.x0)), ca.SX.sym("u"), ca.SX.sym("p", len(self.parameters))
        x_next = self.step(x, u, p)
        y = self.sensor(x_next if self.late else x, u, p)
        options = {"cse": True}
        return ca.Function("f", [x, u, p], [x_next], options), ca.Function("fy", [x, u, p], [x_next, y], options)

    def outputs_of(self, x0: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the outputs of the true structure, without noise, on inputs u; the sensor's rails hold."""
        chained = self._functions[1].mapaccum(len(u))
        _, y = chained(x0, u[None, :], np.tile(np.asarray(p)[:, None], len(u)))
        return np.clip(np.asarray(y).ravel(), *self.rails)

    def record(self, seed: int) -> Record:
        """Return a record of the plant; the seed draws the excitation and the noise."""
        rng = np.random.default_rng(seed)
        signal = np.concatenate([self.excite(rng, self.learn), self.excite(rng, self.test)])
        rows = len(signal)
        noise = self.noise * rng.standard_normal(rows)
        if self.feedback is None:
            u, y = signal, self.outputs_of(np.array(self.x0), signal, np.array(self.parameters))
            y = self._shown(y + noise)
        else:
            u, y, act = np.empty(rows), np.empty(rows), self.feedback()
            x, f = np.array(self.x0), self._functions[1]
            for k in range(rows):
                clean = float(f(x, 0.0, self.parameters)[1])
                y[k] = self._shown(np.array([clean + noise[k]]))[0]
                u[k] = act(signal[k], y[k])
                x = np.asarray(f(x, u[k], self.parameters)[0]).ravel()
        U, Y, at = u[:, None], y[:, None], self.learn
        return Record(
            self.name, self.unit, self.dt, self.inputs, self.outputs, U[:at], Y[:at], U[at:], Y[at:], self.known
        )

    def _shown(self, y: np.ndarray) -> np.ndarray:
        rounded = np.round(y / self.quantum) * self.quantum if self.quantum else y
        return np.clip(rounded, *self.rails)

    def knowing(self, record: Record, rng: np.random.Generator) -> np.ndarray:
        """Return the free run of the true structure, whose p and x₀ least squares of the free run found.

        It begins at parameters that are up to 10 % off, on the learning part, and takes its state at the beginning of
        the test from the rows that are known.
        """
        sized = np.where(np.array(self.parameters) != 0, np.array(self.parameters), 1.0)
        scale = np.std(record.Y_learn)
        start = np.array(self.x0)
        spread = np.maximum(np.abs(start), 1.0) * scale
        u, y = record.U_learn[:, 0], record.Y_learn[:, 0]

        def residual(v: np.ndarray) -> np.ndarray:
            with np.errstate(all="ignore"):
                gap = self.outputs_of(start + v[len(sized) :] * spread, u, sized * v[: len(sized)]) - y
            return np.nan_to_num(gap / scale, nan=1e3, posinf=1e3, neginf=-1e3)

        begin = np.concatenate([rng.uniform(0.9, 1.1, len(sized)), np.zeros(len(start))])
        found = least_squares(residual, begin, method="trf", x_scale="jac", loss="linear", max_nfev=60)
        p, known = sized * found.x[: len(sized)], record.known
        x_end = self._last(start + found.x[len(sized) :] * spread, u, p)

        def early(v: np.ndarray) -> np.ndarray:
            gap = self.outputs_of(x_end + v * spread, record.U_test[:known, 0], p) - record.Y_test[:known, 0]
            return np.concatenate([np.nan_to_num(gap / scale, nan=1e3), 1e-3 * v])

        x_test = x_end + least_squares(early, np.zeros(len(start)), max_nfev=60).x * spread
        return self.outputs_of(x_test, record.U_test[:, 0], p)[:, None]

    def _last(self, x0: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        chained = self._functions[0].mapaccum(len(u))
        return np.asarray(chained(x0, u[None, :], np.tile(np.asarray(p)[:, None], len(u))))[:, -1]


def rk4(rhs: Map, dt: float, substeps: int) -> Map:
    """Return x⁺ of ẋ = rhs(x, u, p) by the classical Runge-Kutta method, u held over the sample."""

    def step(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        h = dt / substeps
        for _ in range(substeps):
            a = rhs(x, u, p)
            b = rhs(x + h / 2 * a, u, p)
            c = rhs(x + h / 2 * b, u, p)
            d = rhs(x + h * c, u, p)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        return x

    return step


def multisine(rng: np.random.Generator, rows: int, dt: float, low: float, high: float) -> np.ndarray:
    """Return a multisine of random phases between two frequencies [Hz], with standard deviation 1."""
    frequency = np.fft.rfftfreq(rows, dt)
    band = (frequency >= low) & (frequency <= high)
    phases = np.exp(2j * np.pi * rng.random(len(frequency)))
    u = np.fft.irfft(np.where(band, phases, 0.0), rows)
    return u / u.std()


def steps(rng: np.random.Generator, rows: int, low: float, high: float, least: int, most: int) -> np.ndarray:
    """Return levels between low and high, each held for a random number of rows."""
    u = np.empty(rows)
    k = 0
    while k < rows:
        held = int(rng.integers(least, most + 1))
        u[k : k + held] = rng.uniform(low, high)
        k += held
    return u


def _tanks(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """Two tanks, one above the other; what overflows from the upper one runs partly into the lower one."""
    substeps, dt, full = 4, 4.0, 10.0
    for _ in range(substeps):
        upper, lower = ca.fmax(x[0], 1e-3), ca.fmax(x[1], 1e-3)
        h1 = x[0] + dt / substeps * (-p[0] * ca.sqrt(upper) + p[1] * u)
        over = ca.fmax(h1 - full, 0.0)
        h2 = x[1] + dt / substeps * (p[2] * ca.sqrt(upper) - p[3] * ca.sqrt(lower)) + p[4] * over
        x = ca.vertcat(ca.fmax(ca.fmin(h1, full), 0.0), ca.fmax(ca.fmin(h2, full), 0.0))
    return x


def _drive(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """A carriage with viscous and dry friction: v̇ = (k u − Fv v − Fc sign(v) − offset) / M."""
    friction = p[1] * x[1] + p[2] * ca.tanh(x[1] / 2e-3) + p[3]
    return ca.vertcat(x[1], p[0] * u - friction)


def _oscillator(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """A spring that hardens: ÿ = ω² (u − y − κ y³) − 2 ζ ω ẏ."""
    return ca.vertcat(x[1], p[0] ** 2 * (u - x[0] - p[2] * x[0] ** 3) - 2 * p[1] * p[0] * x[1])


def _converter(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """A buck converter, averaged; its diode lets no current back: x = [inductor current, output voltage]."""
    return ca.vertcat((24.0 * u - x[1] - p[0] * x[0]) / p[1], (x[0] - x[1] / p[2]) / p[3])


def _converter_step(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    forward = rk4(_converter, 1e-5, 1)(x, u, p)
    return ca.vertcat(ca.fmax(forward[0], 0.0), forward[1])


def _exchanger(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """A heat exchanger: outlet temperature and, hidden, that of the wall, heated by steam."""
    flow = ca.fmax(u, 1e-3)
    wall = p[1] * flow**0.6 * (x[1] - x[0])
    return ca.vertcat(p[0] * flow * (20.0 - x[0]) + wall, p[2] * (110.0 - x[1]) - p[3] * wall)


def _hysteresis(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """A mass on a Bouc-Wen element: x = [position in mm, velocity in mm/s, hysteretic force in N]."""
    v = x[1] / 1e3
    force = p[3] * v - p[4] * (p[5] * ca.fabs(v) * x[2] + p[6] * v * ca.fabs(x[2]))
    return ca.vertcat(x[1], 1e3 * (u - p[0] * v - p[1] * x[0] / 1e3 - x[2]) / p[2], force)


def _level(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """A tank that drains through an orifice, fed by a valve with a lag: x = [valve, level]."""
    return ca.vertcat((u - x[0]) / p[0], p[1] * x[0] - p[2] * ca.sqrt(ca.fmax(x[1], 1e-3)))


def _pd() -> Callable[[float, float], float]:
    """A PD on the position, as a positioning drive has: its velocity is the difference of two rows."""
    last: list[float] = []

    def act(setpoint: float, y: float) -> float:
        speed = (y - last[-1]) / 1e-3 if last else 0.0
        last[:] = [y]
        return float(np.clip(0.16 * (setpoint - y) - 2e-3 * speed, -10.0, 10.0))

    return act


def _pi() -> Callable[[float, float], float]:
    """A PI on the level with limits on the valve; its integral stops at them."""
    memory = [40.0]

    def act(setpoint: float, y: float) -> float:
        error = setpoint - y
        u = 2.0 * error + memory[0]
        if 0.0 < u < 100.0:
            memory[0] += 0.1 * error
        return float(np.clip(u, 0.0, 100.0))

    return act


def _strokes(rng: np.random.Generator, rows: int) -> np.ndarray:
    """Return set points of a drive [mm]: strokes between random places, smooth at both ends."""
    places = np.concatenate([[0.0], rng.uniform(0, 240, rows // 900 + 2)])
    at = np.linspace(0, len(places) - 1.001, rows)
    share = np.clip((at % 1) / 0.7, 0, 1)
    return places[at.astype(int)] + (3 * share**2 - 2 * share**3) * np.diff(places)[at.astype(int)]


_RATE = 610.35  # samples a second of the oscillator [Hz]

TWINS: dict[str, Twin] = {
    twin.name: twin
    for twin in (
        Twin(
            "two tanks, overflow", "V", 4.0, ("pump [V]",), ("lower level [V]",),
            (0.045, 0.036, 0.05, 0.055, 0.4), (4.0, 4.0), _tanks, lambda x, u, p: x[1],
            lambda rng, rows: np.clip(4.2 + 2.4 * multisine(rng, rows, 4.0, 0, 0.012), 0, 10),
            1024, 1024, 10, noise=0.03, rails=(0.0, 10.0),
        ),
        Twin(
            "drive with dry friction", "mm", 1e-3, ("motor force [V]",), ("position [mm]",),
            (360.0, 2.1, 210.0, -30.0), (0.0, 0.0), rk4(_drive, 1e-3, 4), lambda x, u, p: x[0],
            _strokes, 8000, 8000, 10, noise=2e-3, quantum=5e-3, feedback=_pd,
        ),
        Twin(
            "hardening oscillator", "mV", 1 / _RATE, ("drive [mV]",), ("displacement [mV]",),
            (2 * np.pi * 68, 0.05, 8e-6), (0.0, 0.0), rk4(_oscillator, 1 / _RATE, 6), lambda x, u, p: x[0],
            lambda rng, rows: 40 * multisine(rng, rows, 1 / _RATE, 1, 150),
            6000, 4000, 50, noise=0.2, late=True,
        ),
        Twin(
            "buck converter twin", "V", 1e-5, ("duty",), ("output [V]",),
            (0.15, 1.6e-4, 12.0, 2e-5), (0.5, 12.0), _converter_step, lambda x, u, p: x[1],
            lambda rng, rows: steps(rng, rows, 0.25, 0.75, 60, 160),
            2000, 1000, 10, noise=0.1, quantum=0.05,
        ),
        Twin(
            "exchanger, hidden wall", "degC", 1.0, ("liquid flow",), ("outlet temperature [degC]",),
            (0.6, 1.4, 0.02, 0.05), (80.0, 95.0), rk4(_exchanger, 1.0, 2), lambda x, u, p: x[0],
            lambda rng, rows: steps(rng, rows, 0.2, 0.9, 5, 60),
            3000, 1000, 25, noise=0.1,
        ),
        Twin(
            "hysteretic element", "mm", 1 / 750, ("force [N]",), ("displacement [mm]",),
            (10.0, 5e4, 2.0, 5e4, 1e3, 0.8, -1.1), (0.0, 0.0, 0.0), rk4(_hysteresis, 1 / 750, 10),
            lambda x, u, p: x[0], lambda rng, rows: 50 * multisine(rng, rows, 1 / 750, 5, 150),
            6000, 2000, 50, noise=8e-3,
        ),
        Twin(
            "level under a PI", "cm", 2.0, ("valve [%]",), ("level [cm]",),
            (9.0, 0.012, 0.08), (40.0, 36.0), rk4(_level, 2.0, 2), lambda x, u, p: x[1],
            lambda rng, rows: steps(rng, rows, 15, 70, 60, 160),
            4000, 1500, 10, noise=0.15, feedback=_pi,
        ),
    )
}  # fmt: skip
