"""Steps with limits of a state and of the input at each step, N 50 to 500: `python tests/speed/figures/growth.py`.

Each method and N has a process of its own, which prints CPU time of the first step, mean CPU time of the next ones and
peak memory; growth.json keeps them, and docs/tools/pictures.py draws them.
"""

import json
import resource
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import osqp as osqp_library
import scipy.sparse as scipy_sparse

import koopmpc as km

osqp: Any = osqp_library  # neither has types
sp: Any = scipy_sparse
HORIZONS = (50, 100, 200, 500)
METHODS = {
    "daqp": "condensed, DAQP",
    "piqp": "stages, PIQP",
    "auto": "no solver named",
    "riccati": "Riccati interior point",
    "riccati in C": "Riccati interior point, in C",
    "sparse": "OSQP alone, sparse",
}
MEASURED = Path(__file__).with_suffix(".json")
STEPS = 10
A = np.array([[1, 0.1, 0, 0], [0, 1.0, 0.1, 0], [0, 0, 0.95, 0.1], [0, 0, 0, 0.9]])
B = np.array([[0.0], [0.05], [0.1], [0.1]])
NAMES = tuple("abcd")


def take_step(mpc: Any, reference: Any, x: Any) -> Any:
    """Return the input of a step."""
    return mpc(x, reference).u


def make_step(method: str, N: int) -> Any:
    """Return a function x → u of one step."""
    cost = km.Cost(np.ones(4), 0.1)
    end = np.array([np.inf, 0.5, np.inf, np.inf])
    limits = km.Limits(-1, 1, x_min=-end, x_max=end, slack=None)
    zero = np.zeros(4)
    if method in ("daqp", "piqp", "auto"):
        model = km.LinearPredictor(A, B, np.eye(4), km.State(), 0.1, NAMES, ("u",))
        mpc: Any = km.KoopmanMPC(model, cost, limits, N, solver=method)
        return partial(take_step, mpc, zero)
    if method.startswith("riccati"):
        x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 1)
        plant = km.StepMap(ca.Function("F", [x, u], [ca.DM(A) @ x + ca.DM(B) @ u]), 0.1, states=NAMES, inputs=("u",))
        mpc = km.BilinearMPC(plant, cost, limits, N)
        if method == "riccati in C":
            mpc = km.compiled(mpc)
        return partial(take_step, mpc, zero)
    one = sp.identity(N)
    P = sp.block_diag([0.2 * one, 2 * sp.identity(4 * N)]).tocsc()
    model = sp.hstack([sp.kron(one, -B), sp.identity(4 * N) - sp.kron(sp.eye(N, k=-1), A)])
    output = sp.hstack([sp.csc_matrix((N, N)), sp.kron(one, np.array([[0, 1, 0, 0]]))])
    rows = sp.vstack([model, sp.hstack([one, sp.csc_matrix((N, 4 * N))]), output]).tocsc()
    ends = np.concatenate([np.zeros(4 * N), np.ones(N), np.full(N, 0.5)])
    solver = osqp.OSQP()
    tight = {"eps_abs": 1e-6, "eps_rel": 1e-6, "max_iter": 100_000}
    solver.setup(P, np.zeros(5 * N), rows, -ends, ends, verbose=False, **tight)

    def step(x: Any) -> Any:
        low, high = -ends, ends.copy()
        low[:4] = high[:4] = A @ x
        solver.update(l=low, u=high)
        return solver.solve(raise_error=False).x[:1]

    return step


def measure(method: str, N: int) -> dict[str, float]:
    """Return times [s] and memory [MB]."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    step, x = make_step(method, N), np.array([0.05 * N, 0.0, 0.0, 0.0])
    spent: list[float] = []
    for _ in range(STEPS):
        start = time.process_time()
        u = step(x)
        spent.append(time.process_time() - start)
        x = A @ x + B @ u
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return {"first": spent[0], "next": float(np.mean(spent[1:])), "MB": memory}


def main() -> None:
    """Measure all, or one."""
    if len(sys.argv) == 3:
        sys.stdout.write(json.dumps(measure(sys.argv[1], int(sys.argv[2]))))
        return
    found: dict[str, dict[str, Any]] = {method: {} for method in METHODS}
    for N in HORIZONS:
        for method in METHODS:
            command = [sys.executable, __file__, method, str(N)]
            answer = subprocess.run(command, capture_output=True, text=True, check=True)
            found[method][str(N)] = json.loads(answer.stdout)
            sys.stdout.write(f"{method} {N} {answer.stdout}\n")
            sys.stdout.flush()
    MEASURED.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
