"""NonlinearMPC on two stirred reactors in series, beside CasADi's solvers on the same multiple shooting."""

import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from figure import Figure

import koopmpc as km

N = 40
DT = 0.05
STEPS = 12
Q = np.array([1, 10, 1, 0.1] * 2)
R = np.full(4, 0.1)


def make_plant() -> tuple[Any, Any]:
    """Return the reactors: cA, cB, T, Tj of each; the inputs are two feeds and the cooling of two jackets."""
    x, u = ca.SX.sym("x", 8), ca.SX.sym("u", 4)
    parts: list[ca.SX] = []
    entering: list[Any] = [1.0, 0.0, 1.0]
    for i in range(2):
        cA, cB, T, Tj = x[4 * i], x[4 * i + 1], x[4 * i + 2], x[4 * i + 3]
        rate = 1.5 * ca.exp(8 * (1 - 1 / T)) * cA
        here: list[Any] = [cA, cB, T]
        feed = [u[i] * (entering[j] - here[j]) for j in range(3)]
        parts += [feed[0] - rate, feed[1] + rate, feed[2] + 0.3 * rate - (T - Tj), 2 * (T - Tj) - u[2 + i] * (Tj - 0.7)]
        entering = [cA, cB, T]
    change = ca.vertcat(*parts)
    f = ca.Function("f", [x, u], [change])
    k1 = f(x, u)
    k2 = f(x + DT / 2 * k1, u)
    k3 = f(x + DT / 2 * k2, u)
    k4 = f(x + DT * k3, u)
    step = ca.Function("F", [x, u], [x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    names = ("cA1", "cB1", "T1", "Tj1", "cA2", "cB2", "T2", "Tj2")
    return km.StepMap(step, DT, states=names, inputs=("F1", "F2", "Q1", "Q2")), step


def by_hand(F: Any, rest: Any, low: Any, high: Any, solver: str) -> Callable[[Any], Any]:
    """Return a step x → u by a CasADi solver, warm from its last plan."""
    X, U = [ca.MX.sym("x", 8) for _ in range(N + 1)], [ca.MX.sym("u", 4) for _ in range(N)]
    p = ca.MX.sym("p", 8)
    terms: list[Any] = []
    w: list[Any] = []
    g: list[Any] = []
    ends: list[list[Any]] = [[], []]
    for k in range(N + 1):
        w.append(X[k])
        for end, limit in zip(ends, (low, high), strict=True):
            end.append(limit if k else np.full(8, -np.inf if limit is low else np.inf))
        if k:
            terms.append(ca.dot(Q * (X[k] - rest), X[k] - rest))
        if k < N:
            w.append(U[k])
            ends[0].append(np.full(4, 0.1))
            ends[1].append(np.full(4, 3.0))
            g.append(X[k + 1] - F(X[k], U[k]))
            terms.append(ca.dot(R * (U[k] - 1), U[k] - 1))
        if k == 0:
            g.append(X[0] - p)
    quiet: dict[str, Any] = {"print_time": False, "expand": True, f"{solver}.print_level": 0}
    if solver == "fatrop":
        quiet |= {"structure_detection": "auto", "equality": [True] * (8 * N + 8)}
    nlp: dict[str, Any] = {"x": ca.vertcat(*w), "f": sum(terms), "g": ca.vertcat(*g), "p": p}
    solve: Any = ca.nlpsol("hand", solver, nlp, quiet)
    box = {"lbx": np.concatenate(ends[0]), "ubx": np.concatenate(ends[1]), "lbg": 0, "ubg": 0}
    guess = [np.concatenate([np.tile(np.append(rest, np.ones(4)), N), rest])]

    def step(x: Any) -> Any:
        found = solve(x0=guess[0], p=x, **box)["x"].full().ravel()
        guess[0] = np.concatenate([found[12:], found[-12:]])
        return found[8:12]

    return step


def prepare() -> Callable[[], tuple[float, float]]:
    """Return a measurement of the median step of a closed loop, by the fastest of ours and of CasADi's by hand."""
    plant, F = make_plant()
    rest = np.array([0.4, 0.6, 1.0, 0.9, 0.2, 0.8, 1.0, 0.9])
    for _ in range(2000):
        rest = np.asarray(plant(rest, np.ones(4)))
    low, high = (np.array([end, end, value, end] * 2) for end, value in ((-np.inf, 0.5), (np.inf, 1.35)))
    start = rest * (1 + 0.15 * np.random.default_rng(0).normal(size=8))
    mpc = km.NonlinearMPC(plant, km.Cost(Q, R), km.Limits(0.1, 3.0, x_min=low, x_max=high), N, solver="sqpmethod")
    hands = [by_hand(F, rest, low, high, solver) for solver in ("fatrop", "ipopt")]

    def run(step: Callable[[Any], Any]) -> float:
        x, spent = start, np.zeros(STEPS)
        for k in range(STEPS):
            begin = time.process_time()
            u = step(x)
            spent[k] = time.process_time() - begin
            x = np.asarray(plant(x, u))
        return float(np.median(spent[1:]))

    def measure() -> tuple[float, float]:
        mpc.reset()
        return run(lambda x: mpc(x, rest).u), min(run(hand) for hand in hands)

    return measure


FIGURES = {
    "reactors": Figure(
        '`NonlinearMPC`, `solver="sqpmethod"`, two reactors, 8 states, N 40',
        prepare,
        "the fastest of fatrop and ipopt by hand, without the terminal cost",
        "≤ 1.3",
    )
}
