"""Our OSQP and DAQP against the bare ones, on the QPs of a closed loop with active limits; and a time limit of 1 ms."""

import sys
import time

import daqp
import numpy as np
import osqp
import pytest
import scipy.linalg
from scipy.sparse import csc_matrix

import koopmpc as km
from tests.control.solvers.random_qps import DEFAULTS, QP, SOLVERS

pytestmark = pytest.mark.speed

A = np.array([[1, 0.1, 0, 0], [0, 1.02, 0.1, 0], [0, 0, 0.95, 0.1], [0, 0, 0, 0.9]])
B = np.array([[0.0], [0.05], [0.1], [0.1]])
BOUNDS = np.array([1.0, 6.0, 1.5])  # of u, x₀, x₁


class Loop:
    """The QPs of closed loops from random states, in Riccati coordinates: N inputs, and `outputs` rows a step."""

    def __init__(self, N, outputs, episodes=12, steps=40):
        P = scipy.linalg.solve_discrete_are(A, B, np.eye(4), 0.1 * np.eye(1))
        K = np.linalg.solve(0.1 + B.T @ P @ B, B.T @ P @ A)
        size = N * (1 + outputs)
        D, F, Z, W = np.zeros((size, N)), np.zeros((size, 4)), np.eye(4), np.zeros((4, N))
        for k in range(N):
            D[k], F[k] = -K @ W, -K @ Z
            D[k, k] += 1
            Z, W = (A - B @ K) @ Z, A @ W + B @ D[k : k + 1]
            rows = slice(N + k * outputs, N + (k + 1) * outputs)
            D[rows], F[rows] = W[:outputs], Z[:outputs]
        self.limit = np.append(np.full(N, BOUNDS[0]), np.tile(BOUNDS[1 : 1 + outputs], N))
        self.qp = QP(np.eye(N), np.zeros(N), D, -self.limit, self.limit)
        end = np.full(outputs, size)
        self.shift_v = np.append(np.arange(1, N), N)
        self.shift_y = np.concatenate([np.append(np.arange(1, N), size), np.arange(N + outputs, size), end])
        self.offsets = list(self._offsets(F, episodes, steps))

    def _offsets(self, F, episodes, steps):
        rng, exact = np.random.default_rng(0), SOLVERS["daqp"](self.qp, None)
        D = self.qp.A
        for _ in range(episodes):
            x = rng.normal(size=4) * [2, 0.5, 0.5, 0.5]
            for k in range(steps):
                v = F @ x
                u = np.clip(v[0], -BOUNDS[0], BOUNDS[0])
                if (np.abs(v) > self.limit).any():
                    exact.set_bounds(-self.limit - v, self.limit - v)
                    found = exact.solve(np.zeros(D.shape[1]), np.zeros(len(D)))
                    if found.status is km.Status.OPTIMAL:
                        u = v[0] + D[0] @ found.v
                        yield k == 0, v
                x = A @ x + B[:, 0] * u

    def replay(self, step, reset):
        """Return the seconds of each step(low, high, v, y) → (v, y), from the shifted last answer."""
        times = []
        v, y = np.zeros(self.qp.A.shape[1] + 1), np.zeros(len(self.limit) + 1)
        for first, offset in self.offsets:
            if first:
                v[:], y[:] = 0, 0
                reset()
            low, high, v0, y0 = -self.limit - offset, self.limit - offset, v[self.shift_v], y[self.shift_y]
            start = time.perf_counter()
            v[:-1], y[:-1] = step(low, high, v0, y0)
            times.append(time.perf_counter() - start)
        return np.array(times)


def ours(name, loop):
    made = SOLVERS[name](loop.qp, None)

    def step(low, high, v, y):
        made.set_bounds(low, high)
        solution = made.solve(v, y)
        return solution.v, solution.y

    return step, made.reset


def bare_osqp(loop):
    made = osqp.OSQP()
    P, D = csc_matrix(loop.qp.P), csc_matrix(loop.qp.A)
    made.setup(P, loop.qp.q, D, loop.qp.low, loop.qp.high, verbose=False, **DEFAULTS)

    def step(low, high, v, y):
        made.update(l=low, u=high)
        made.warm_start(x=v, y=y)
        found = made.solve(raise_error=False)
        return found.x, found.y

    return step, lambda: None


def bare_daqp(loop):
    made = daqp.Model()
    made.setup(loop.qp.P, loop.qp.q, loop.qp.A, loop.qp.high, loop.qp.low)

    def step(low, high, v, y):
        made.update(bupper=high, blower=low)
        x, _, _, info = made.solve()
        return x, info["lam"]

    return step, lambda: None


def report(benchmark, **figures):
    benchmark.extra_info.update(figures)
    sys.stdout.write(f"\n{benchmark.name}: " + ", ".join(f"{k} {v:.3g}" for k, v in figures.items()) + "\n")


@pytest.mark.parametrize(("N", "outputs"), [(20, 1), (50, 2)], ids=["20x40", "50x150"])
@pytest.mark.parametrize(("name", "bare"), [("osqp", bare_osqp), ("daqp", bare_daqp)], ids=["osqp", "daqp"])
def test_against_the_bare_solver(benchmark, name, bare, N, outputs):
    loop = Loop(N, outputs)
    sides = ours(name, loop), bare(loop)
    pairs = []
    benchmark.pedantic(lambda: pairs.append([loop.replay(*side) for side in sides]), rounds=9, warmup_rounds=1)
    a, b = (np.concatenate(times) for times in zip(*pairs[1:], strict=True))
    ratio = np.median([np.median(one) / np.median(other) for one, other in pairs[1:]])
    half, high = ([np.quantile(t, q) * 1e6 for t in (a, b)] for q in (0.5, 0.99))
    report(
        benchmark,
        QPs=len(loop.offsets),
        **{
            "median µs": half[0],
            "bare µs": half[1],
            "p99 µs": high[0],
            "bare p99 µs": high[1],
            "ratio": ratio,
        },
    )


@pytest.mark.parametrize("name", ["osqp", "daqp"])
def test_a_millisecond_is_held_or_reported(benchmark, name):
    """Hard QPs of 100 variables and 300 rows, cold: how far past 1 ms a solve returns, and with which status."""
    rng, limit = np.random.default_rng(0), np.full(300, 0.03)
    qp = QP(np.eye(100), 30 * rng.normal(size=100), np.tril(rng.normal(size=(300, 100))), -limit, limit)
    made, seen, times = SOLVERS[name](qp, None), set(), []

    def solve():
        made.reset()
        made.set_bounds(qp.low - 0.01 * rng.random(300), qp.high + 0.01 * rng.random(300))
        start = time.perf_counter()
        seen.add(made.solve(np.zeros(100), np.zeros(300), time_limit=1e-3).status)
        times.append(time.perf_counter() - start)

    benchmark.pedantic(solve, rounds=300, warmup_rounds=5)
    assert seen == {km.Status.TIME_LIMIT}
    report(
        benchmark,
        **{
            "median ms": np.median(times) * 1e3,
            "p99 ms": np.quantile(times, 0.99) * 1e3,
            "max ms": max(times) * 1e3,
        },
    )


@pytest.mark.parametrize("name", ["osqp", "daqp"])
@pytest.mark.parametrize("states", ["free", "soft"])
def test_whole_steps_of_a_millisecond(benchmark, name, states):
    """N = 100 on an unstable plant, a time limit of 1 ms a step: none is late without saying so, and by how much."""
    unstable, push = np.array([[1.1, 0.1], [0.0, 1.05]]), np.array([[0.0], [0.1]])
    model = km.LinearPredictor(unstable, push, np.eye(2), km.State(), 0.1, ("x", "v"), ("u",))
    ends = {} if states == "free" else {"x_min": [-0.15, -0.3], "x_max": [0.15, 0.3]}
    mpc = km.KoopmanMPC(model, km.Cost([1, 1], 1e-3), km.Limits(-1, 1, **ends), 100, solver=name, time_limit=1e-3)
    rng, moves = np.random.default_rng(0), []

    def step():
        moves.append(mpc(np.array([0.2, 0.1]) + 0.05 * rng.normal(size=2), np.zeros(2)))

    benchmark.pedantic(step, rounds=1000)
    late = [move for move in moves if move.solve_time > 1e-3]
    assert all(move.status is km.Status.TIME_LIMIT for move in late)
    half, high, most = np.quantile([move.solve_time for move in moves], [0.5, 0.99, 1]) * 1e3
    given_up = sum(move.status is km.Status.TIME_LIMIT for move in moves)
    figures = {"late": len(late), "given up": given_up, "median ms": half, "p99 ms": high, "max ms": most}
    report(benchmark, steps=len(moves), **figures)
