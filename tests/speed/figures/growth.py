"""Steps with limits of a state and of the input at each step: `python tests/speed/figures/growth.py`.

Each method and size has a process of its own, which prints CPU time of building, of the first step, mean CPU time of
the next ones and peak memory. growth.json keeps one input and N 50 to 500, which docs/tools/pictures.py draws; large.json
eight inputs and 1,000 observables: `python tests/speed/figures/growth.py large`.
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
LARGE = MEASURED.with_name("large.json")
CASES = {  # methods by inputs, horizon and observables
    (8, 200, 16): ("auto", "piqp", "riccati in C"),
    (8, 500, 16): ("auto", "riccati in C"),
    (2, 40, 1000): ("auto", "daqp in C"),
}
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


def make_large_step(method: str, inputs: int, N: int, observables: int) -> tuple[Any, Any, Any]:
    """Return a function x → u of one step, the model's x⁺ of x and u, and a first state.

    Masses of one chain have a force each and a hard limit of their speed. With more observables than states they are
    pendulums, learned with Gaussians, one angle is near its soft limit and one far beyond where the loop ends.
    """
    nx = 2 * inputs
    names, forces = tuple(f"x{i}" for i in range(nx)), tuple(f"u{i}" for i in range(inputs))
    cost, zero = km.Cost(np.ones(nx), np.full(inputs, 0.1)), np.zeros(nx)
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", inputs)
    if observables == nx:
        A = np.kron(np.eye(inputs), [[1, 0.1], [0, 1]])
        for i in range(inputs):
            A[2 * i + 1, 2 * i - 1] += 0.02
        B = np.kron(np.eye(inputs), [[0.005], [0.1]])
        F, start = ca.DM(A) @ x + ca.DM(B) @ u, np.tile([1.5 + 0.01 * N, 0.0], inputs)
        start *= np.linspace(0.5, 1, inputs).repeat(2)
        end = np.tile([np.inf, 0.5], inputs)
        limits = km.Limits(-1, 1, x_min=-end, x_max=end, slack=None)
        model: Any = km.LinearPredictor(A, B, np.eye(nx), km.State(), 0.1, names, forces)
    else:
        angles = ca.vertcat(x[0], x[2] - x[0])
        F = ca.vertcat(*(x[i] + 0.05 * x[i + 1] if i % 2 == 0 else 0 for i in range(nx)))
        for i in range(inputs):
            F[2 * i + 1] = x[2 * i + 1] - 0.05 * (ca.sin(angles[i]) + 0.1 * x[2 * i + 1] - u[i])
        start, limits = np.array([0.9, 0.5, 0.9, 0.5]), km.Limits(-1, 1, x_max=[0.8, np.inf, 0.8, np.inf])
    plant = km.StepMap(ca.Function("F", [x, u], [F]), 0.1, states=names, inputs=forces)
    if observables != nx:
        data = km.collect(
            plant, km.Uniform([-1] * nx, [1] * nx), km.Noise([-1] * inputs, [1] * inputs), episodes=100, steps=40, rng=0
        )
        centers = np.random.default_rng(0).uniform(-2, 2, (observables - nx, nx))
        model = km.edmd(data, km.State() + km.Gaussian(centers, 1.0))
    if method.startswith("riccati"):
        mpc: Any = km.BilinearMPC(plant, cost, limits, N)
    else:
        mpc = km.KoopmanMPC(model, cost, limits, N, solver=method.removesuffix(" in C"))
    return partial(take_step, km.compiled(mpc) if method.endswith("in C") else mpc, zero), plant, start


def measure_large(method: str, inputs: int, N: int, observables: int) -> dict[str, float]:
    """Return times [s] and memory [MB]."""
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    step, plant, x = make_large_step(method, inputs, N, observables)
    built = time.process_time() - start
    return {"built": built} | take_steps(step, x, plant, before)


def measure(method: str, N: int) -> dict[str, float]:
    """Return times [s] and memory [MB]."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return take_steps(make_step(method, N), np.array([0.05 * N, 0.0, 0.0, 0.0]), lambda x, u: A @ x + B @ u, before)


def take_steps(step: Any, x: Any, plant: Any, before: int) -> dict[str, float]:
    """Return times [s] of steps of a loop, and the memory since `before` [MB]."""
    spent: list[float] = []
    for _ in range(STEPS):
        start = time.process_time()
        u = step(x)
        spent.append(time.process_time() - start)
        x = plant(x, u)
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return {"first": spent[0], "next": float(np.mean(spent[1:])), "MB": memory}


def ask(*case: Any) -> dict[str, float]:
    """Return what a process of its own measures, and print it."""
    words = [str(each) for each in case]
    answer = subprocess.run([sys.executable, __file__, *words], capture_output=True, text=True, check=True)
    sys.stdout.write(f"{' '.join(words)} {answer.stdout}\n")
    sys.stdout.flush()
    return json.loads(answer.stdout)


def write_large_rows(found: list[dict[str, Any]]) -> str:
    """Return the table of the page."""
    words = {
        "auto": "`KoopmanMPC`, no solver named",
        "piqp": "the same, stages, PIQP",
        "riccati in C": "`BilinearMPC`, in C",
    }
    words["daqp in C"] = "`KoopmanMPC`, in C"
    head = [
        "| inputs, N, observables; a limit at each step | method | built | first step | next | memory |",
        "| --- |" + " --- |" * 5,
    ]
    return "\n".join(
        head
        + [
            f"| {row['inputs']}, {row['N']}, {row['observables']:,} | {words[row['method']]} | {row['built']:.2g} s "
            f"| {1e3 * row['first']:,.1f} ms | {1e3 * row['next']:.3g} ms | {row['MB']:.0f} MB |"
            for row in found
        ]
    )


def main() -> None:
    """Measure all, or one."""
    method, *sizes = sys.argv[1:] or [""]
    if len(sizes) == 1:
        sys.stdout.write(json.dumps(measure(method, int(sizes[0]))))
    elif sizes:
        sys.stdout.write(json.dumps(measure_large(method, *map(int, sizes))))
    elif method == "large":
        rows = [
            {"method": each, "inputs": inputs, "N": N, "observables": observables, **ask(each, inputs, N, observables)}
            for (inputs, N, observables), methods in CASES.items()
            for each in methods
        ]
        LARGE.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        sys.stdout.write(write_large_rows(rows) + "\n")
    else:
        found = {each: {str(N): ask(each, N) for N in HORIZONS} for each in METHODS}
        MEASURED.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
