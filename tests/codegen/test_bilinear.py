"""A BilinearMPC in C against itself in Python: every step is told the same, and both must answer alike."""

import copy
import pickle
import shutil
import subprocess
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from koopmpc.codegen import tolerances
from koopmpc.codegen.programs import make_tables, read_program
from tests.compiler import find_compiler, needs_compiler
from tests.synthesis.test_loops import make
from tests.tiers import few

COST = km.Cost(Q=[10.0, 1.0], R=0.1)
BOX = {"u_min": -8.0, "u_max": 8.0}
SWING = km.Cost(
    Q=[5.0, 5.0, 0.1],
    R=0.05,
    of=km.Expressions(lambda x: [ca.sin(x[0]), ca.cos(x[0]), x[1]], ("sin", "cos", "omega [rad/s]")),
)


class Asked(NamedTuple):
    """A controller of a model and of its plant, what its steps are told, and statuses that have to come up."""

    make: object
    seen: tuple[str, ...]
    rows: int = 1
    acts: bool = False
    reference: tuple[float, ...] = (0.2, 0.0)


def mpc(limits, horizon=12, cost=COST, **options):
    return lambda model, plant: km.BilinearMPC(model, cost, km.Limits(**limits), horizon, **options)


CONTROLLERS = {
    "inputs": Asked(mpc(BOX), ("UNCONSTRAINED", "OPTIMAL", "BAD_MEASUREMENT")),
    "swing": Asked(mpc(BOX, 25, SWING), ("OPTIMAL",), reference=(0.0, 1.0, 0.0)),
    "equations": Asked(
        lambda model, plant: km.BilinearMPC(plant, COST, km.Limits(**BOX), 12, sqp_iterations=2), ("OPTIMAL",)
    ),
    "soft": Asked(mpc(BOX | {"x_min": [-0.5, -1.0], "x_max": [0.5, 1.0]}), ("SOFTENED",), rows=20),
    "hard": Asked(mpc(BOX | {"x_min": [-0.9, -2.0], "x_max": [0.9, 2.0], "slack": None}, 8), ("OPTIMAL", "INFEASIBLE")),
    "rates": Asked(
        mpc(
            BOX | {"du_max": 2.0, "x_max": [0.8, np.inf]},
            cost=km.Cost(Q=[10.0, 1.0], R=0.1, R_delta=0.3),
            moves=(1, 1, 2, 3, 5),
            latency=1,
        ),
        ("OPTIMAL", "SOFTENED"),
        rows=4,
    ),
    "soft rates": Asked(mpc(BOX | {"du_max": 1.0, "du_slack": (50.0, 5.0)}), ("OPTIMAL", "SOFTENED")),
    "disturbance": Asked(mpc(BOX | {"x_max": [0.6, 9.0]}, estimator=km.LiftedDisturbance()), ("OPTIMAL",), acts=True),
    "late": Asked(
        mpc(BOX, estimator=km.LiftedDisturbance(0.3), latency=2, cost=km.Cost([10.0, 1.0], 0.1, R_delta=0.1)),
        ("OPTIMAL",),
        acts=True,
        rows=3,
    ),
    "given": Asked(mpc(BOX, cost=km.Cost([10.0, 1.0], 0.1, u_target=np.linspace(0, 3, 30)[:, None])), ("OPTIMAL",)),
    "weighed end": Asked(mpc(BOX, cost=km.Cost([10.0, 1.0], 0.1, Q_N=[50.0, 5.0], u_target="zero")), ("OPTIMAL",)),
    "no tail": Asked(mpc(BOX, cost=km.Cost([10.0, 1.0], 0.1, tail=0)), ("OPTIMAL",), rows=5),
}


@pytest.fixture(scope="module")
def swung():
    """A pendulum, θ = 0 upright, and a bilinear model of nine observables."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    ahead = ca.vertcat(x[0] + 0.05 * x[1], x[1] + 0.05 * (4.9 * ca.sin(x[0]) + 0.5 * u - 0.1 * x[1]))
    plant = km.StepMap(ca.Function("F", [x, u], [ahead]), 0.05, states=("theta", "omega"), inputs=("torque",))
    start = km.Uniform([-np.pi, -5.0], [np.pi, 5.0])
    data = km.collect(plant, start, km.Noise(-8.0, 8.0), episodes=300, steps=10, rng=0)
    lifting = km.State() + km.Fourier(2, states=[0]) + km.Constant()
    return plant, km.bilinear_edmd(data, lifting)


def steps_of(config, plant, steps, rng):
    """What the steps are told: measurements of a run with noise and jumps, missed samples, moving references."""
    x = np.array([0.6, 0.0])
    pool = np.array(config.reference) + 0.1 * (np.arange(6)[:, None] % 3) * (len(config.reference) == 2)
    for k in range(steps):
        if k % 40 == 0:
            x = rng.uniform([-1.5, -2.0], [1.5, 2.0])
        y = x + rng.normal(0.0, 0.01, 2)
        if k % 19 == 7:
            y[rng.integers(2)] = np.nan
        first = (k // 15) % 3
        reference = pool[first] if config.rows == 1 else pool[np.minimum(first + np.arange(config.rows), 5)]
        if k % 97 == 13:
            reference = np.full_like(reference, np.nan)
        applied = None if k % 5 else rng.uniform(-8, 8, 1)
        u = yield y, reference, applied
        x = np.array(plant(x, u if applied is None or config.acts else applied)) + rng.normal(0.0, 0.02, 2)


def told(name, steps, swung, precision="double"):
    """Both controllers' moves and plans of these steps, and how far rounding moves Python's own answer.

    A third controller gets y times 1 + 1e-13: what that changes in u, 1e-13 of y does to this problem.
    """
    plant, model = swung
    asked = CONTROLLERS[name]
    controller, other = (asked.make(model, plant) for _ in range(2))
    twin = km.compiled(controller, precision=precision)
    rows = steps_of(asked, plant, steps, np.random.default_rng(2))
    said, pairs, spread = next(rows), [], 0.0
    while True:
        a, b, c = controller(*said), twin(*said), other(said[0] * (1 + 1e-13), *said[1:])
        pairs.append((a, b, controller.plan(), twin.plan()))
        spread = max(spread, float(np.abs(a.u - c.u).max()))
        try:
            said = rows.send(a.u)
        except StopIteration:
            return pairs, spread


@pytest.mark.parametrize(
    "name", few(CONTROLLERS, "swing", "equations", "soft rates", "late", "given", "weighed end", "no tail")
)
@pytest.mark.parametrize("steps", [150, pytest.param(10_000, marks=pytest.mark.slow)])
def test_every_step_is_answered_as_in_python(name, steps, swung):
    pairs, spread = told(name, steps, swung)
    seen, other, parted, off = set(), 0, 0, []
    for a, b, first, second in pairs:
        seen.add(a.status.name)
        if (a.status, a.fallback) != (b.status, b.fallback):
            other += 1
            continue
        off.append(float(np.abs(b.u - a.u).max()))
        assert (first is None) == (second is None)
        if first is not None and a.iterations == b.iterations:
            near = np.abs(second.X[:2] - first.X[:2]).max() <= 1e-6 + 10 * spread
            parted += not (near and np.abs(second.U - first.U).max() <= 1e-3 + 10 * spread)
    assert parted <= 0.002 * steps  # where a step is halved, or not, by rounding
    assert other <= 0.002 * steps
    assert np.quantile(off, 0.5) <= 1e-9 * 16
    assert np.quantile(off, 0.99) <= 1e-6 * 16 + 10 * spread
    assert set(CONTROLLERS[name].seen) <= seen


def test_a_closed_loop_under_soft_limits_costs_the_same(swung):
    plant, model = swung
    limits = km.Limits(**BOX, x_min=[-0.4, -1.0], x_max=[1.5, 1.2])
    controller = km.BilinearMPC(model, COST, limits, 15, estimator=km.LiftedDisturbance())
    fast = km.compiled(controller)
    rows = np.column_stack([0.3 * np.sin(0.05 * np.arange(121)), np.zeros(121)])
    runs = [
        km.simulate(plant, one, x0=[1.2, 0.0], reference=rows, steps=120, cost=COST, limits=limits)
        for one in (controller, fast)
    ]
    costs = [km.metrics(run).cost for run in runs]
    assert abs(costs[1] / costs[0] - 1) < 1e-6
    assert runs[1].status == runs[0].status
    assert km.Status.SOFTENED in runs[0].status


def test_a_loop_that_learns_what_the_model_lacks_is_that_of_python_to_rounding(swung):
    """Its estimator and its iteration have constants of one name each: where two share one, plans end too early."""
    plant, model = swung
    limits = km.Limits(**BOX, du_max=2.0, x_min=[-np.inf, -1.0], x_max=[np.inf, 1.0])
    controller = km.BilinearMPC(model, COST, limits, 20, estimator=km.LiftedDisturbance())
    fast, rng = km.compiled(controller), np.random.default_rng(0)
    x, reference = np.array([0.4, 0.0]), np.zeros(2)
    for k in range(120):
        if k % 20 == 0:
            reference = np.array([rng.uniform(-0.5, 0.5), 0.0])
        y = x + 1e-3 * rng.normal(size=2)
        a, b = controller(y, reference), fast(y, reference)
        assert a.status is b.status
        np.testing.assert_allclose(b.u, a.u, rtol=0, atol=1e-8)
        x = np.add(plant(x, a.u), [0.0, 0.02])  # a load that the model does not know


@pytest.mark.parametrize("seed", few(range(4), 0, 1))
def test_delays_and_a_disturbance_without_an_equilibrium_are_answered_as_in_python(seed):
    """Readings that no constant load explains: Gauss–Newton leads to an equilibrium at some steps, and at others to none."""
    controller = make(bilinear=True, delays=1)[1]
    machine, readings = km.compiled(controller), 0.3 * np.random.default_rng(seed).normal(size=(30, 2))
    controller.reset(readings[0])
    for y in readings:
        slow, fast = controller(y, [0.3, 0.0]), machine(y, [0.3, 0.0])
        assert (slow.status, slow.fallback) == (fast.status, fast.fallback)
        np.testing.assert_allclose(slow.u, fast.u, rtol=0, atol=1e-6)


def test_a_constant_of_the_c_code_has_one_meaning(swung, monkeypatch):
    program = read_program(km.BilinearMPC(swung[1], COST, km.Limits(**BOX), 5))
    monkeypatch.setitem(tolerances.IN_C, "HORIZON", (1e-9, 1e-6))
    with pytest.raises(ValueError, match="two constants of the name HORIZON"):
        make_tables(program, single=False)


@pytest.mark.slow
def test_it_swings_up_in_c_as_it_does_in_python(swung):
    plant, model = swung
    controller = km.BilinearMPC(model, SWING, km.Limits(**BOX), 30)
    fast = km.compiled(controller)
    found = fast.runs(plant, [[np.pi, 0.1], [2.5, 0.0]], [0.0, 1.0, 0.0], steps=120)
    for X, U in zip(found.X, found.U, strict=True):
        run = km.simulate(plant, controller, x0=X[0], reference=[0.0, 1.0, 0.0], steps=120)
        np.testing.assert_allclose(X, run.X, atol=1e-5)
        np.testing.assert_allclose(U, run.U, atol=1e-5)
        assert abs(np.cos(X[-1, 0]) - 1) < 1e-3


def test_floats_follow_the_plan_to_a_thousandth_of_the_range(swung):
    pairs, _ = told("swing", 100, swung, "float")
    off = [float(np.abs(a.u - b.u).max()) for a, b, *_ in pairs if a.status is b.status]
    assert np.median(off) <= 1e-3 * 16
    assert len(off) >= 95


def test_a_pickle_goes_on_with_the_targets_that_it_knew(swung):
    fast = km.compiled(km.BilinearMPC(swung[1], COST, km.Limits(**BOX), 10))
    fast([0.5, 0.0], [0.1, 0.0])
    twin, other = pickle.loads(pickle.dumps(fast)), copy.copy(fast)
    for x in ([0.45, -0.1], [0.4, -0.2]):
        moves = [one(x, [0.1, 0.0]) for one in (fast, twin, other)]
        assert moves[0].u == moves[1].u == moves[2].u
    assert other([0.4, 0.0], [0.2, 0.0]).status is km.Status.UNCONSTRAINED


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "float"])
def test_the_folder_builds_without_a_warning_and_runs_clean(swung, tmp_path, precision):
    plant, model = swung
    limits = km.Limits(**BOX, du_max=3.0, x_max=[2.0, 1.5])
    controller = km.BilinearMPC(model, COST, limits, 12, latency=1, estimator=km.LiftedDisturbance())
    rows = np.column_stack([np.linspace(0.0, 0.3, 40), np.zeros(40)])
    folder = km.export(controller, tmp_path / "c", precision=precision, plant=plant, x0=[0.8, 0], reference=rows)
    for compiler in filter(shutil.which, ("gcc", "clang")):
        done = subprocess.run(["make", "-s", "strict", f"CC={compiler}"], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[:2000]
    done = subprocess.run(["make", "-s", "sanitize"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:2000]
    printed = subprocess.run(
        ["make", "-s", "run", "CFLAGS=-O0"], cwd=folder, capture_output=True, text=True, check=True
    ).stdout
    table = np.array([[float(word) for word in line.split(",")] for line in printed.splitlines()[1:]])
    x, acting, close = np.array([0.8, 0.0]), np.zeros(1), 1e-5 if precision == "double" else 1e-2
    controller.reset()
    for k, row in enumerate(table[:60]):
        move = controller(x, rows[min(k, 39) :])
        np.testing.assert_allclose(row[1:3], x, atol=close)
        np.testing.assert_allclose(row[3], move.u, atol=10 * close)
        x, acting = plant(x, acting), move.u
    assert "Any other row may come at run time" in (folder / "README.md").read_text()


DRIVER = r"""
#include <stdio.h>
#include "koopmpc.h"
static koopmpc_state s;
int main(void) {
  static double y[KOOPMPC_NY], rows[1000], applied[KOOPMPC_NU], count, acts;
  koopmpc_init(&s, 0, 0);
  while (scanf("%lf", &count) == 1) {
    koopmpc_real u[KOOPMPC_NU];
    koopmpc_report report;
    const koopmpc_rows reference = {rows, (int)count};
    for (int i = 0; i < KOOPMPC_NY; i++) scanf("%lf", y + i);
    for (int i = 0; i < (int)count * KOOPMPC_NR; i++) scanf("%lf", rows + i);
    scanf("%lf", &acts);
    for (int i = 0; i < KOOPMPC_NU; i++) scanf("%lf", applied + i);
    koopmpc_step(&s, y, &reference, acts > 0 ? applied : 0, 0, u, &report);
    for (int i = 0; i < KOOPMPC_NU; i++) printf("%.17g ", u[i]);
    printf("%d %d\n", (int)report.status, (int)report.fallback);
  }
  return 0;
}
"""


def numbers(*parts):
    return " ".join(repr(float(x)) for part in parts for x in np.ravel(part))


SEARCHED = {
    "inputs": 0.8, "swing": 0.3, "rates": 0.2, "disturbance": 0.4, "given": 0.3, "weighed end": 0.6,
    "soft": 0.9, "equations": 0.8, "late": 0.5, "no tail": 0.7, "soft rates": 0.3,
}  # fmt: skip


@pytest.mark.parametrize("name", [n if n == "rates" else pytest.param(n, marks=pytest.mark.slow) for n in SEARCHED])
def test_a_reference_row_that_was_not_exported_is_found_at_run_time(name, swung, tmp_path):
    plant, model = swung
    asked, reach, rng = CONTROLLERS[name], SEARCHED[name], np.random.default_rng(5)
    controller, width = asked.make(model, plant), len(asked.reference)
    features = width == 3
    known = [[0.0, 1.0, 0.0]] if features else [[0.0, 0.0], [-0.1, 0.0]]
    folder = km.export(controller, tmp_path / "c", reference=known)
    (tmp_path / "main.c").write_text(DRIVER)
    command = [*find_compiler(), "-std=c99", "-O1", "-Ic", *map(str, folder.glob("koopmpc_*.c")), "main.c", "-lm"]
    subprocess.run([*command, "-o", "main"], cwd=tmp_path, check=True)
    x, lines, moves = np.array([0.3, 0.0]), [], []
    for k in range(40):
        angles = np.round(reach * np.sin(0.13 * (k // 5 if asked.rows == 1 else k + np.arange(asked.rows))), 3)
        angles = np.ravel(angles)
        still = np.zeros(len(angles))
        rows = np.column_stack([np.sin(angles), np.cos(angles), still] if features else [angles, still])
        y, applied = x + rng.normal(0, 0.002, 2), None if k % 3 else rng.uniform(-2, 2, 1)
        moves.append(move := controller(y, rows, applied))
        lines.append(numbers(len(rows), y, rows, applied is not None, 0.0 if applied is None else applied))
        x = np.array(plant(x, move.u))
    printed = subprocess.run([tmp_path / "main"], input="\n".join(lines), capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in printed.stdout.splitlines()], dtype=float)
    assert found[:, 1].astype(int).tolist() == [move.status.value for move in moves]
    off = np.abs(found[:, 0] - [move.u[0] for move in moves]) / 16
    assert np.quantile(off, 0.9) <= 1e-6
    assert off.max() <= 1e-5
    assert {"OPTIMAL", "UNCONSTRAINED", "SOFTENED"} & {move.status.name for move in moves}


def test_an_implicit_integrator_is_refused_with_what_would_do(tmp_path):
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, 0.05, km.plants.Collocation(2))
    controller = km.BilinearMPC(plant, COST, km.Limits(**BOX), 5)
    with pytest.raises(km.errors.DataError, match=r"implicit integrator .* discretize with RK4"):
        km.compiled(controller)


def drive_scheduled(x, u, w):
    """The input counts as w says, and not at all without it; w also moves the state, and multiplies it."""
    return [0.95 * x[0] + 0.1 * x[1] + 0.05 * w[0], 0.9 * x[1] - 0.1 * x[0] + 0.2 * w[0] * u[0] + 0.1 * w[0] * x[0]]


def learn_scheduled(rng):
    episodes = []
    for _ in range(8):
        X, U, W = [rng.uniform(-1, 1, 2)], rng.uniform(-1, 1, (25, 1)), rng.uniform(-1, 1, (25, 1))
        for u, w in zip(U, W, strict=True):
            X.append(drive_scheduled(X[-1], u, w))
        episodes.append(km.Episode(X=np.array(X), U=U, W=W))
    return km.bilinear_edmd(km.Episodes(episodes, 0.1), km.State() + km.Constant(), scheduled_inputs=True)


@needs_compiler
@pytest.mark.parametrize("given", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "more", [{}, pytest.param({"latency": 1, "estimator": km.LiftedDisturbance()}, marks=pytest.mark.slow)]
)
def test_measured_disturbances_that_multiply_state_and_inputs_count_in_c_as_in_python(given, more):
    rng = np.random.default_rng(3)
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    plant = km.StepMap(ca.Function("F", [x, u, w], [ca.vertcat(*drive_scheduled(x, u, w))]), 0.1)
    model = plant if given else learn_scheduled(rng)
    cost, limits = km.Cost(Q=[1, 0.1], R=0.01), km.Limits(-2, 2, x_max=[0.5, 2], slack=(20.0, 5.0))
    mpc = km.BilinearMPC(model, cost, limits, 8, **more)
    fast = km.compiled(mpc)
    assert fast is not mpc
    at, seen = np.array([0.4, 0.1]), set()
    for k in range(60):
        rows = 0.8 + 0.4 * np.sin((k + np.arange(9)) / 7)[:, None]
        measured = [np.nan] if k == 40 else rows if k % 20 < 15 else rows[0]
        a, b = (each(at, [0.3 + 0.2 * (k > 30), 0.0], w=measured) for each in (mpc, fast))
        assert (a.status, a.fallback) == (b.status, b.fallback)
        np.testing.assert_allclose(b.u, a.u, atol=2e-5)
        seen.add(a.status.name)
        at = np.array(drive_scheduled(at, a.u, rows[0])) + 0.01 * rng.normal(size=2)
    assert {"UNCONSTRAINED", "OPTIMAL", "BAD_MEASUREMENT"} <= seen
    again = km.compiled(mpc)  # of a controller that has seen w: the table of its C is that of w = 0 all the same
    again.reset()
    mpc.reset()
    np.testing.assert_allclose(again(at, [0.3, 0.0], w=[0.7]).u, mpc(at, [0.3, 0.0], w=[0.7]).u, atol=1e-6)


@needs_compiler
@pytest.mark.slow
def test_new_rows_that_several_inputs_hold_are_aimed_at_by_the_same_in_c_as_in_python():
    model = km.BilinearPredictor(
        [[-0.9]], [[-1.3, -0.25]], [[[0.13]], [[0.34]]], np.eye(1), km.State(), 0.1, ["x"], ["u0", "u1"]
    )
    mpc = km.BilinearMPC(model, km.Cost(Q=1, R=0.5), km.Limits(-1, 1), 5)
    fast = km.compiled(mpc)
    for row in (0.0, 0.5, 0.55, -0.45, -0.58, 0.3):
        for y in (0.1, 0.9 * row):
            np.testing.assert_allclose(fast([y], [row]).u, mpc([y], [row]).u, atol=1e-9)


def test_targets_that_a_jump_of_w_moves_to_other_limits_are_those_of_python():
    """Rows that no equilibrium holds, products u·w, limits active: whole Gauss–Newton steps swing from limit to limit."""
    A, B = np.array([[0.28, -1.09], [0.76, 0.37]]), np.array([[0.58, 0.36], [0.29, 0.03]])
    N = [[[0.16, -0.22], [-0.05, -0.14]], [[0.18, 0.01], [-0.09, -0.23]]]
    P = [[[-0.11, 0.61], [0.19, 0.20]], [[-0.15, -0.49], [0.05, 0.03]]]
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u", 2), ca.SX.sym("w", 2)
    f = A @ x + B @ u + np.array([[-0.08, 0.0], [-0.08, 0.39]]) @ w
    for i in range(2):
        f = f + u[i] * (ca.DM(N[i]) @ x) + w[i] * (ca.DM(P[i]) @ u)
    plant = km.StepMap(ca.Function("F", [x, u, w], [f]), 0.1)
    controller = km.BilinearMPC(plant, km.Cost(Q=[0.6, 0.1], R=[0.7, 0.7]), km.Limits(u_min=-1.1, u_max=1.0), 3)
    fast, used = km.compiled(controller), []
    for W in ([0, 0], [-0.75, 0.93], [0.75, -0.5], [0, 0], [-0.7, 0.9]):
        for row in ([0.4, -0.6], [-0.5, 0.6]):
            slow, quick = (one([-0.6, 0.1], row, w=W) for one in (controller, fast))
            assert quick.status is slow.status
            np.testing.assert_allclose(quick.u, slow.u, rtol=0, atol=1e-6)
            used.append(slow.u)
    np.testing.assert_allclose(used[-2], [-1.032, -0.871], atol=1e-3)  # not where no target was found, [-.099, -.027]


def test_a_target_that_w_takes_off_a_limit_is_found_in_c_as_in_python():
    """Close to the w that frees the input, no piece of the way settled in 40 steps: ipopt found it, and C nothing."""
    A, B = np.array([[0.27, -0.63], [0.26, 0.08]]), np.array([[-1.11], [0.0]])
    N, P, S = ([[-0.25, -0.02], [0.16, 0.03]], [[-0.03], [-0.38]], [[0.13, -0.13], [-0.06, 0.08]])
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    f = A @ x + B @ u + np.array([[0.4], [0.23]]) @ w + u * (ca.DM(N) @ x) + w * (ca.DM(P) @ u + ca.DM(S) @ x)
    plant = km.StepMap(ca.Function("F", [x, u, w], [f]), 0.1)
    controller = km.BilinearMPC(plant, km.Cost(Q=[0.17, 0.9], R=0.11), km.Limits(u_min=-1.43, u_max=1.19), 6)
    fast = km.compiled(controller)
    for W in (0.0, -0.32):
        for _ in range(3):
            slow, quick = (one([-0.78, -0.18], [0.96, -1.07], w=[W]) for one in (controller, fast))
            assert quick.status is slow.status
            np.testing.assert_allclose(quick.u, slow.u, rtol=0, atol=1e-6)


def test_a_target_in_a_corner_of_limits_is_left_in_c_as_in_python():
    """x at its limit, an input at its own: nothing is free to move, and C found no target where ipopt found one."""
    x, u, w = ca.SX.sym("x"), ca.SX.sym("u", 2), ca.SX.sym("w")
    f = -0.95 * x + 0.25 * u[0] + 0.74 * u[1] - 0.47 * w
    f = f + x * (0.15 * u[0] + 0.063 * u[1]) + w * (0.24 * u[1] - 0.33 * u[0])
    plant = km.StepMap(ca.Function("F", [x, u, w], [f]), 0.1)
    limits = km.Limits(u_min=-0.71, u_max=1.4, x_max=[0.87], x_min=[-1.41])
    controller = km.BilinearMPC(plant, km.Cost(Q=0.5, R=[0.5, 0.5]), limits, 6)
    fast = km.compiled(controller)
    for y, row in ((0.21, [[-1.33], [0.85]]), (0.83, [[1.63]]), (0.5, [[0.85]]), (0.83, [[1.63]])):
        slow, quick = (one([y], row, w=[-0.744]) for one in (controller, fast))
        assert quick.status is slow.status
        np.testing.assert_allclose(quick.u, slow.u, rtol=0, atol=1e-6)
