"""Steps of controllers: references that rest and move, limits, and quadratic programs."""

import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from figure import Figure, cpu_time_of_rows  # beside this file: an old commit has no figures

import koopmpc as km

COUNT = 300  # steps of a measurement


def pendulum() -> Any:
    """θ̈ = (g/L) sin θ + u / (m L²) by a semi-implicit step of 0.05 s, θ = 0 upright."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    omega = x[1] + 0.05 * (9.81 / 2 * ca.sin(x[0]) + u / 4)
    F = ca.Function("F", [x, u], [ca.vertcat(x[0] + 0.05 * omega, omega)])
    return km.StepMap(F, 0.05, states=("theta", "omega"), inputs=("torque",))


def twelve() -> Any:
    """Return a model of the pendulum with 12 observables."""
    data = km.collect(pendulum(), km.Uniform([-3.2, -4], [3.2, 4]), km.Noise(-10, 10), episodes=200, steps=40, rng=0)

    def products(x: Any) -> list[Any]:
        return [*(x[1] * trig(k * x[0]) for k in (1, 2) for trig in (ca.sin, ca.cos)), x[1] ** 2]

    return km.edmd(
        data, km.State() + km.Fourier(2, states="theta") + km.Expressions(products, list("abcde")) + km.Constant()
    )


def moving(kind: str, N: int, compiled: bool = False) -> Callable[[], Callable[[], tuple[float, float]]]:
    """Return a measurement of steps with a reference that moves, beside the same controller's resting steps."""

    def prepare() -> Callable[[], tuple[float, float]]:
        model, x, rest = twelve(), np.array([0.02, 0.0]), np.zeros(2)
        signal = 0.01 * np.sin(0.1 * np.arange(COUNT + N + 1))[:, None] * np.ones(2)
        cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(-25, 25)
        ends = 25 + np.sin(0.1 * np.arange(COUNT + N + 1))[:, None]
        in_time = km.Limits(-ends, ends)
        targets = km.Cost(Q=[10, 1], R=0.1, u_target=0.1 * np.sin(0.1 * np.arange(COUNT + N + 1))[:, None])
        ahead = [(x, signal[k : k + N + 1]) for k in range(COUNT)]
        cases: dict[str, tuple[Any, Any, list[Any]]] = {
            "rest": (cost, limits, [(x, rest)] * COUNT),
            "rows": (cost, limits, ahead),
            "row": (cost, limits, [(x, signal[k]) for k in range(COUNT)]),
            "u_target": (targets, limits, [(x, rest)] * COUNT),
            "u_target rows": (targets, limits, ahead),
            "limits": (cost, in_time, [(x, rest)] * COUNT),
            "limits rows": (cost, in_time, ahead),
        }
        one, other = (km.KoopmanMPC(model, *cases[each][:2], N, solver="daqp") for each in (kind, "rest"))
        if compiled:
            one, other = km.compiled(one), km.compiled(other)

        def measure() -> tuple[float, float]:
            one.reset()
            return cpu_time_of_rows(one, cases[kind][2]), cpu_time_of_rows(other, cases["rest"][2])

        return measure

    return prepare


def limited() -> Callable[[], float]:
    """Return a measurement of steps with a QP: 20 inputs and 20 hard rows more."""
    A = np.array([[1, 0.1, 0, 0], [0, 1.02, 0.1, 0], [0, 0, 0.95, 0.1], [0, 0, 0, 0.9]])
    B, end = np.array([[0.0], [0.05], [0.1], [0.1]]), np.array([6.0, np.inf, np.inf, np.inf])
    model = km.LinearPredictor(A, B, np.eye(4), km.State(), 0.1, tuple("abcd"), ("u",))
    mpc = km.KoopmanMPC(model, km.Cost(np.ones(4), 0.1), km.Limits(-1, 1, x_min=-end, x_max=end, slack=None), 20)
    rng, zero = np.random.default_rng(0), np.zeros(4)
    states: list[tuple[Any, ...]] = []
    for _ in range(12):
        x = rng.normal(size=4) * [2, 0.5, 0.5, 0.5]
        for _ in range(40):
            move = mpc(x, zero)
            if move.status is km.Status.OPTIMAL:
                states.append((x, zero))
            x = A @ x + B @ move.u

    def measure() -> float:
        mpc.reset()
        return cpu_time_of_rows(mpc, states)

    return measure


def pmsm() -> Any:
    """Return a permanent-magnet drive in the rotor's frame, by Runge-Kutta steps of 0.1 ms: id, iq, ω and ud, uq."""
    R, L, flux, pairs, J, friction, dt = 0.5, 2e-3, 0.1, 4, 1e-3, 1e-4, 1e-4
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    turn = pairs * x[2]
    change = ca.vertcat(
        (-R * x[0] + turn * L * x[1] + u[0]) / L,
        (-R * x[1] - turn * L * x[0] - turn * flux + u[1]) / L,
        (1.5 * pairs * flux * x[1] - friction * x[2]) / J,
    )
    f = ca.Function("f", [x, u], [change])
    k2 = f(x + dt / 2 * change, u)
    k3 = f(x + dt / 2 * k2, u)
    k4 = f(x + dt * k3, u)
    step = ca.Function("F", [x, u], [x + dt / 6 * (change + 2 * k2 + 2 * k3 + k4)])
    return km.StepMap(step, dt, states=("id", "iq", "omega"), inputs=("ud", "uq"))


def whole_loop(kind: str, share: float, compiled: bool) -> Callable[[], Callable[[], float]]:
    """Return a measurement of the CPU time of a step of a closed loop that a share of the steps keeps."""

    def prepare() -> Callable[[], float]:
        if kind == "quadrotor":
            problem = km.load_problem("planar_quadrotor")
            plant, case = km.discretize(problem.dynamics, problem.dt), next(iter(problem.cases.values()))
            mpc: Any = km.BilinearMPC(plant, problem.cost, problem.limits, 50)
            x, rows = np.asarray(case.x0), [np.asarray(case.reference)] * case.steps
        else:
            plant, N, steps, k = pmsm(), 20, 1000, np.arange(1021)
            limits = km.Limits(-150, 150, x_min=[-30, -30, -1000], x_max=[30, 30, 1000])
            mpc, x = km.BilinearMPC(plant, km.Cost([1, 1, 0.1], [1e-3, 1e-3]), limits, N), np.zeros(3)
            speed = 50 + 0.1 * k if kind == "ramp" else np.where(k // 200 % 2, 100.0, 50.0)
            rows = [np.array([0.0, 0.0, speed[i]]) for i in range(steps)]
            if kind == "ramp":
                rows = [np.stack([0 * speed[i : i + N + 1]] * 2 + [speed[i : i + N + 1]], axis=1) for i in range(steps)]
        controller: Any = km.compiled(mpc) if compiled else mpc

        def measure() -> float:
            controller.reset()
            state, spent = x, np.zeros(len(rows))
            for i, row in enumerate(rows):
                start = time.thread_time()
                move = controller(state, row)
                spent[i] = time.thread_time() - start
                state = plant(state, move.u)
            return float(np.quantile(spent[1:], share))

        return measure

    return prepare


NAMES = {
    "rows": "N+1 rows of preview",
    "row": "one new row",
    "u_target": "rows of `u_target`",
    "u_target rows": "rows of `u_target` and of preview",
    "limits": "limits in time",
    "limits rows": "limits in time and rows of preview",
}
LOOPS = {
    "pmsm": "electric drive at 10 kHz, set points",
    "ramp": "the same, rows of a ramp",
    "quadrotor": "planar quadrotor, N 50",
}
FIGURES = {
    "resting": Figure("step, nothing active, 12 observables, N 40", moving("rest", 40), goal="not slower"),
    "limited": Figure("step with a QP, 20 × 40", limited, goal="not slower"),
    **{
        f"{kind} {N}": Figure(f"{text}, N {N}", moving(kind, N), "resting", "≤ 1.5")
        for N in (40, 100)
        for kind, text in NAMES.items()
    },
    **{
        f"compiled {kind} {N}": Figure(
            f"{NAMES[kind]}, N {N}, in C", moving(kind, N, compiled=True), "resting", "≤ 1.5"
        )
        for N in (40, 100)
        for kind in NAMES
    },
    **{
        f"{kind} {name}": Figure(
            f"`BilinearMPC`, {text}, {'in C' if compiled else 'Python'}, {'p99' if share > 0.9 else 'median'}",
            whole_loop(kind, share, compiled),
            goal=goal,
        )
        for kind, text in LOOPS.items()
        for name, share, compiled, goal in (("C", 0.99, True, "≤ 100 µs"), ("Python", 0.5, False, "≤ 1 ms"))
    },
}
