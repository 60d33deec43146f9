"""The cart-pole of LinearMPC.jl by another solver: `python tests/speed/figures/rivals.py ours|osqp|tinympc|lmpc|lmpc-warm|cvxpygen N …`.

500 closed-loop steps, each called from Python; prints the median step, the mean of the slowest fifth and the cost. OSQP
is its generated C on the sparse program, TinyMPC gets changes of the input as inputs, for it weighs none.
"""

import ctypes
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as scipy_sparse
from scipy.signal import cont2discrete

sys.path.insert(0, str(Path(__file__).parent))
import generated

sp: Any = scipy_sparse  # it has no types
STEPS, TURNS = 500, 3
A, B = np.array([[0, 1, 0, 0], [0, -10, 9.81, 0], [0, 0, 0, 1], [0, -20, 39.24, 0]]), np.array([[0], [1], [0], [2.0]])
A, B, *_ = cont2discrete((A, 100 * B, np.eye(4), np.zeros((4, 1))), 0.01)
POSITION, ANGLE, CHANGE = 1.44, 1.0, 0.01  # weights
MOST, TILT, PRICE = 2.0, 0.3, 1e3  # limits of input and angle, price of the square beyond it
TIGHT = 1e-4  # OSQP's tolerances
Step = Callable[[Any, float, float], float]


def make_ours(N: int) -> Step:
    """Return x, set point, last input → input by km.compiled."""
    import koopmpc as km

    model = km.LinearPredictor(A, B, np.eye(4), km.State(), 0.01, tuple("pvto"), ("u",))
    end, cost = np.array([np.inf, np.inf, TILT, np.inf]), km.Cost([POSITION, 0, ANGLE, 0], 0.0, R_delta=CHANGE, tail=0)
    limits = km.Limits(-MOST, MOST, x_min=-end, x_max=end, slack=(0.0, PRICE))
    mpc = km.compiled(km.KoopmanMPC(model, cost, limits, N))
    return lambda x, r, u: mpc(x, np.array([r, 0, 0, 0])).u[0]


class Solution(ctypes.Structure):
    """The first field of OSQP's solution."""

    _fields_ = (("x", ctypes.POINTER(ctypes.c_double)),)


class Solver(ctypes.Structure):
    """The first fields of OSQP's solver."""

    _fields_ = (("settings", ctypes.c_void_p), ("solution", ctypes.POINTER(Solution)))


def make_osqp(N: int) -> Step:
    """Return the same by OSQP's generated C: states, inputs and what the angle is beyond its limit."""
    import osqp

    n, one = 4 * N, sp.eye(N)
    change, angle = sp.eye(N) - sp.eye(N, k=-1), sp.kron(one, np.array([[0, 0, 1.0, 0]]))
    Q = np.diag([POSITION, 0, ANGLE, 0])
    P = sp.block_diag([sp.kron(one, 2 * Q), 2 * CHANGE * (change.T @ change), 2 * PRICE * one]).tocsc()
    none, wide = sp.csc_matrix((N, N)), sp.csc_matrix((N, n))
    rows = [
        [sp.eye(n) - sp.kron(sp.eye(N, k=-1), A), sp.kron(one, -B), sp.csc_matrix((n, N))],
        [wide, one, none],
        [angle, none, -one],
        [angle, none, one],
    ]
    every, inf = np.ones(N), np.full(N, 1e30)
    low = np.concatenate([np.zeros(n), -MOST * every, -inf, -TILT * every])
    high = np.concatenate([np.zeros(n), MOST * every, TILT * every, inf])
    q = np.zeros(n + 2 * N)
    q[0:n:4] = -2 * POSITION
    low[:4] = high[:4] = A @ [0, 0, 0.2, 0]  # its first program, by which it tunes its step size
    settings = {"eps_abs": TIGHT, "eps_rel": TIGHT, "max_iter": 20_000, "check_termination": 5, "verbose": False}
    model = osqp.OSQP()
    model.setup(P, q, sp.bmat(rows).tocsc(), low, high, **settings)
    model.solve(raise_error=False)
    folder = Path(tempfile.mkdtemp())
    model.codegen(str(folder), parameters="vectors", force_rewrite=True, prefix="")
    sources = [str(path) for path in folder.rglob("*.c") if "emosqp" not in path.name and "bindings" not in path.name]
    places = [f"-I{path}" for path in {path.parent for path in folder.rglob("*.h")}]
    flags = ["-O3", "-march=native", "-fPIC", "-shared"]
    subprocess.run(["gcc", *flags, *places, *sources, "-o", str(folder / "qp.so"), "-lm"], check=True)
    code = ctypes.CDLL(str(folder / "qp.so"))
    solver = Solver.in_dll(code, "solver")
    address, arrays = ctypes.byref(solver), [ctypes.c_void_p(each.ctypes.data) for each in (q, low, high)]

    def step(x: Any, r: float, u: float) -> float:
        q[0:n:4], q[n] = -2 * POSITION * r, -2 * CHANGE * u
        low[:4] = high[:4] = A @ x
        code.osqp_update_data_vec(address, *arrays)
        code.osqp_solve(address)
        return solver.solution.contents.x[n]

    return step


def make_tinympc(N: int) -> Step:
    """Return the same by TinyMPC, from `pip install tinympc`, with the angle inside hard limits."""
    import tinympc

    wider = np.block([[A, B], [np.zeros((1, 4)), np.eye(1)]])
    mpc, end = tinympc.TinyMPC(), np.array([[1e17], [1e17], [TILT], [1e17], [MOST]]) * np.ones(N + 1)
    weights, loose = np.diag([POSITION, 1e-6, ANGLE, 1e-6, 1e-6]), np.full((1, N), 1e17)
    mpc.setup(wider, np.vstack([B, [[1.0]]]), weights, np.array([[CHANGE]]), N + 1, rho=1.0, max_iter=1000)
    mpc.set_bound_constraints(-end, end, -loose, loose)

    def step(x: Any, r: float, u: float) -> float:
        mpc.set_x0(np.append(x, u))
        mpc.set_x_ref(np.array([[r], [0], [0], [0], [0]]) * np.ones(N + 1))
        return u + float(np.atleast_1d(mpc.solve()["controls"])[0])

    return step


def run(step: Step) -> tuple[Any, float]:
    """Return the times of the steps, the least of some turns, and the cost."""
    turns, cost = [], 0.0
    for _ in range(TURNS):
        x, u, cost, spent = np.array([0, 0, 0.2, 0.0]), 0.0, 0.0, []
        for k in range(STEPS):
            r, start, last = 1.0 if k < STEPS // 2 else -0.5, time.perf_counter(), u
            u = float(np.clip(step(x, r, u), -MOST, MOST))
            spent.append(time.perf_counter() - start)
            cost += POSITION * (x[0] - r) ** 2 + ANGLE * x[2] ** 2 + CHANGE * (u - last) ** 2
            x = A @ x + B[:, 0] * u
        turns.append(spent)
    return np.min(turns, axis=0), cost


def main() -> None:
    """Print a line for each horizon."""
    given = A, B, (POSITION, ANGLE, CHANGE, PRICE), (MOST, TILT)
    make = {
        "ours": make_ours,
        "osqp": make_osqp,
        "tinympc": make_tinympc,
        "lmpc": lambda N: generated.make_lmpc(*given, N, warm=False),
        "lmpc-warm": lambda N: generated.make_lmpc(*given, N, warm=True),
        "cvxpygen": lambda N: generated.make_cvxpygen(*given, N),
    }[sys.argv[1]]
    for N in map(int, sys.argv[2:]):
        spent, cost = run(make(N))
        slowest = np.sort(spent)[-STEPS // 5 :].mean()
        sys.stdout.write(f"N {N}: {1e6 * np.median(spent):.1f} us, slowest {1e6 * slowest:.1f} us, cost {cost:.1f}\n")


if __name__ == "__main__":
    main()
