"""Two more generated programs for `rivals`: LinearMPC.jl's, written from its templates, and cvxpygen's."""

import ctypes
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import cholesky, solve_triangular

DAQP = Path(__file__).parents[3] / "koopmpc" / "codegen"
Step = Callable[[Any, float, float], float]
PROGRAM = """
#include "daqp/daqp.h"
static double dupper[M], dlower[M], x[N], lam[K], lam_star[K], D[K], L[K * (K + 1) / 2], xldl[K], zldl[K], Mu[M];
static int sense[M], WS[K];
static double none[M];
static DAQPSettings settings = {.primal_tol = 1e-8, .dual_tol = 1e-12, .zero_tol = 1e-11, .pivot_tol = 1e-8,
  .progress_tol = 1e-14, .cycle_tol = 10, .iter_limit = 10000, .fval_bound = 1e30, .eps_prox = -1e-6,
  .eta_prox = 1e-9, .rho_soft = 1e-6, .sing_tol = 3.7e-11, .refactor_tol = 1e-9};
static DAQPWorkspace work = {.settings = &settings, .n = N, .m = M, .ms = N, .M = rows, .Rinv = Rinv,
  .scaling = scaling, .dupper = dupper, .dlower = dlower, .sense = sense, .x = x, .u = x, .lam = lam,
  .lam_star = lam_star, .D = D, .L = L, .xldl = xldl, .zldl = zldl, .WS = WS, .Mu = Mu, .outer_iter = 1,
  .rho_ls = rho, .rho_us = rho, .w_ls = none, .w_us = none, .sing_ind = DAQP_EMPTY_IND};
double compute(const double *state, double reference, double last) {
  const double th[6] = {state[0], state[1], state[2], state[3], reference, last};
  double u = 0;
  if (!sense[N]) for (int i = N; i < M; i++) sense[i] = DAQP_SOFT;
  for (int i = 0, d = 0; i < M; i++) {
    double moved = 0;
    for (int j = 0; j < 6; j++) moved += Dth[d++] * th[j];
    dupper[i] = du[i] + moved;
    dlower[i] = moved - du[i];
  }
  work.reuse_ind = 0;
#ifndef DAQP_WARMSTART
  daqp_deactivate_constraints(&work);
  reset_daqp_workspace(&work);
#endif
  daqp_ldp(&work);
  ldp2qp_solution(&work);
  for (int j = 0; j < 6; j++) u += Uth[j] * th[j];
  return x[0] / scaling[0] + u;
}
"""


def make_lmpc(A: Any, B: Any, weights: tuple[float, ...], ends: tuple[float, ...], N: int, *, warm: bool) -> Step:
    """Return x, set point, last input → input by the program that LinearMPC.jl 0.9 generates, without Julia.

    The templates are its codegen/mpc_update_qp.c and qp2ldp of src/codegen.jl; the QP is condensed, the price that of
    `rivals`. With `warm` it is generated with warm_start=true, which is not its default.
    """
    (position, angle, change, price), (most, tilt) = weights, ends
    powers = [np.linalg.matrix_power(A, k) for k in range(N + 1)]
    states, moves = np.vstack(powers[1:]), np.zeros((4 * N, N))
    for k in range(N):
        for j in range(k + 1):
            moves[4 * k : 4 * k + 4, j] = powers[k - j] @ B[:, 0]
    Q, steps = np.kron(np.eye(N), np.diag([position, 0, angle, 0])), np.eye(N) - np.eye(N, k=-1)
    goal, first = np.kron(np.ones((N, 1)), np.eye(4)[:, :1]), np.eye(N)[:, :1]
    H = moves.T @ Q @ moves + change * steps.T @ steps
    F = np.hstack([moves.T @ Q @ states, -moves.T @ Q @ goal, -change * steps.T @ first])
    R = cholesky(H)
    rows = np.vstack([np.eye(N), moves[2::4]]) @ np.linalg.inv(R)
    Dth = np.vstack([np.zeros((N, 6)), np.hstack([-states[2::4], np.zeros((N, 2))])])
    Dth = Dth + rows @ solve_triangular(R.T, F, lower=True)
    scaling = 1 / np.linalg.norm(rows, axis=1)
    rows, Dth, du = rows * scaling[:, None], Dth * scaling[:, None], np.repeat([most, tilt], N) * scaling
    tables = {
        "rows": rows[N:],
        "Rinv": np.concatenate([rows[i, i:N] for i in range(N)]),
        "Dth": Dth,
        "du": du,
        "Uth": -np.linalg.solve(H, F)[0],
        "scaling": scaling,
        "rho": np.full(2 * N, 1 / price),
    }
    text = f"enum {{ N = {N}, M = {2 * N}, K = {2 * N + 2} }};\n" + "#define DAQP_WARMSTART\n" * warm
    for name, table in tables.items():
        text += f"static double {name}[] = {{{', '.join(repr(float(v)) for v in np.ravel(table))}}};\n"
    folder = Path(tempfile.mkdtemp())
    (folder / "mpc.c").write_text(text + PROGRAM, encoding="utf-8")
    sources = [str(DAQP / "daqp" / f"{name}.c") for name in ("daqp", "auxiliary", "factorization")]
    code = _build([str(folder / "mpc.c"), *sources], [f"-I{DAQP}"], folder)
    code.compute.restype, code.compute.argtypes = ctypes.c_double, (ctypes.c_void_p, ctypes.c_double, ctypes.c_double)
    return lambda x, r, u: code.compute(x.ctypes.data, r, u)


def make_cvxpygen(A: Any, B: Any, weights: tuple[float, ...], ends: tuple[float, ...], N: int) -> Step:
    """Return the same by cvxpygen's C with OSQP, 1e-4; it needs `pip install cvxpygen`."""
    import cvxpy as cp
    from cvxpygen import cpg

    (position, angle, change, price), (most, tilt) = weights, ends
    x, u, over = cp.Variable((4, N + 1)), cp.Variable((1, N), name="u"), cp.Variable(N)
    start, goal, last = cp.Parameter(4, name="x0"), cp.Parameter(name="r"), cp.Parameter(name="last")
    cost = position * cp.sum_squares(x[0, 1:] - goal) + angle * cp.sum_squares(x[2, 1:]) + price * cp.sum_squares(over)
    cost += change * (cp.sum_squares(u[0, 0] - last) + cp.sum_squares(u[:, 1:] - u[:, :-1]))
    rows = [x[:, 0] == start, x[:, 1:] == A @ x[:, :-1] + B @ u, u <= most, u >= -most]
    rows += [x[2, 1:] <= tilt + over, -x[2, 1:] <= tilt + over]
    folder = Path(tempfile.mkdtemp()) / "code"
    options = {"eps_abs": 1e-4, "eps_rel": 1e-4, "max_iter": 20_000}
    problem = cp.Problem(cp.Minimize(cost), rows)
    cpg.generate_code(problem, code_dir=str(folder), solver="OSQP", wrapper=False, solver_opts=options)
    door = folder / "c" / "door.c"
    door.write_text(
        '#include "cpg_workspace.h"\n#include "cpg_solve.h"\n'
        "double compute(const double *x, double r, double u) {\n"
        "  for (int i = 0; i < 4; i++) cpg_update_x0(i, x[i]);\n"
        "  cpg_update_r(r);\n  cpg_update_last(u);\n  cpg_solve();\n  return CPG_Result.prim->u[0];\n}\n",
        encoding="utf-8",
    )
    leave = ("emosqp.c", "cpg_example.c")
    found = [path for path in (folder / "c").rglob("*.c") if path.name not in leave and "build" not in path.parts]
    places = [f"-I{path}" for path in {path.parent for path in (folder / "c").rglob("*.h")}]
    code = _build([str(path) for path in found], places, folder)
    code.compute.restype, code.compute.argtypes = ctypes.c_double, (ctypes.c_void_p, ctypes.c_double, ctypes.c_double)
    return lambda x, r, u: code.compute(x.ctypes.data, r, u)


def _build(sources: list[str], places: list[str], folder: Path) -> ctypes.CDLL:
    """Return the machine code of these sources, with the flags that all programs get."""
    flags = ["-w", "-O3", "-march=native", "-fPIC", "-shared", "-std=gnu99"]
    library = str(folder / "step.so")
    subprocess.run(["gcc", *flags, *places, *sources, "-o", library, "-lm"], check=True)
    return ctypes.CDLL(library)
