"""NonlinearMPC: KoopmanMPC on a linear plant, three solvers and one answer, several starts against a local optimum."""

import copy
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.control.models import PRECISE, linear, step_map

A, B = np.array([[1.02, 0.1], [0.05, 1.01]]), np.array([[0.005], [0.1]])
DRIFT = np.array([0.02, -0.03])
SHARP = {"ipopt.tol": 1e-11, "ipopt.bound_relax_factor": 0.0}
CASES = {
    "free": (km.Cost(Q=[1, 0.2], R=0.1), km.Limits()),
    "inputs": (km.Cost(Q=[1, 0.2], R=0.1), km.Limits(-0.8, 0.9)),
    "soft": (km.Cost(Q=[1, 0.2], R=0.1), km.Limits(-2, 2, x_min=[-np.inf, -0.5], x_max=[0.9, 0.4])),
    "cheap slack": (km.Cost(Q=[1, 0.2], R=0.1), km.Limits(-2, 2, x_max=[0.3, 0.2], slack=(0.4, 0.3))),
    "u_target zero": (km.Cost(Q=[1, 0.2], R=0.5, u_target="zero"), km.Limits(-0.8, 0.9)),
    "Q_N": (km.Cost(Q=[1, 0.2], R=0.1, Q_N=[[3, 1], [1, 2]]), km.Limits(-0.8, 0.9)),
    "of": (
        km.Cost(Q=1, R=0.1, of=km.Expressions(lambda x: [x[0]], ["x0"])),
        km.Limits(-0.8, 0.9, of=km.Expressions(lambda x: [x[1]], ["x1"]), y_max=0.3),
    ),
}


@pytest.mark.parametrize("solver", ["ipopt", "fatrop", "sqpmethod"])
def test_no_solver_prints(solver, capfd):
    mpc = km.NonlinearMPC(step_map(A, B), *CASES["inputs"], 5, solver=solver)
    assert np.isfinite(mpc([0.5, 0.0], [0.0, 0.0]).u).all()
    assert capfd.readouterr() == ("", "")


def test_the_names_that_a_solver_tells_stay() -> None:
    """A name made anew takes a place in Python's table of names, which is some MB large and built again when full."""
    km.NonlinearMPC(step_map(A, B), *CASES["inputs"], 5)([0.5, 0.0], [0.0, 0.0])
    x = ca.MX.sym("x")
    solver = ca.nlpsol(
        "solver", "ipopt", {"x": x, "f": x**2}, {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes"}
    )
    found = solver(x0=1.0)
    told, fresh = solver.stats(), {f"a name of {x}": 0}
    alone, held = (
        min(sys.getrefcount(name) for name in names) for names in ([*fresh], [*found, *told, *told["iterations"]])
    )
    assert held > alone


@dataclass(frozen=True)
class Outflow(km.Dynamics):
    """A tank whose level is not a number below its outlet, 0.2 m above the bottom."""

    states = ("level [m]",)
    inputs = ("inflow [m/s]",)

    def rhs(self, x, u):
        return u - ca.sqrt(x - 0.2)


@pytest.mark.parametrize("solver", ["ipopt", "sqpmethod", None])
def test_a_step_where_the_model_is_not_a_number_says_so_by_its_status_alone(solver, capfd):
    plant = km.discretize(Outflow(), dt=0.1)
    asked = plant, km.Cost(Q=[1.0], R=0.1), km.Limits(u_min=0, u_max=2), 5
    mpc = km.BilinearMPC(*asked) if solver is None else km.NonlinearMPC(*asked, solver=solver)
    assert mpc([1.0], [1.0]).status.name in ("OPTIMAL", "UNCONSTRAINED")
    move = mpc([0.1], [1.0])
    assert move.status is km.Status.FAILED
    assert 0 <= move.u[0] <= 2
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", CASES)
def test_on_a_linear_plant_it_equals_koopman_mpc(name):
    cost, limits = CASES[name]
    N, nr = 10, 1 if name == "of" else 2
    if cost.Q_N is None and name != "of":
        cost = replace(cost, Q_N=[[3, 1], [1, 2]])  # the default end of a nonlinear controller is another
    one = km.KoopmanMPC(linear(A, B, constant=DRIFT), cost, limits, N, settings=PRECISE)
    other = km.NonlinearMPC(step_map(A, B, constant=DRIFT), cost, limits, N, solver=km.control.NLP(settings=SHARP))
    t = np.arange(40)
    signal = np.column_stack([0.6 * np.sign(np.sin(0.4 * t)), 0.2 * np.cos(0.3 * t)])[:, :nr]
    x, seen = np.array([0.6, 0.5]), set()
    for k in range(8):
        rows = signal[k : k + N + 1]
        first, second = one(x, rows), other(x, rows)
        np.testing.assert_allclose(second.u, first.u, atol=1e-5)
        np.testing.assert_allclose(other.plan().U, one.plan().U, atol=1e-4)
        np.testing.assert_allclose(other.plan().X, one.plan().X, atol=1e-4)
        assert (second.status is km.Status.SOFTENED) == (first.status is km.Status.SOFTENED)
        seen.add(first.status)
        x = A @ x + B @ first.u + DRIFT
    assert (seen == {km.Status.UNCONSTRAINED}) == (name == "free")


def test_the_plan_is_a_trajectory_of_the_model_and_u_is_fresh():
    plant = step_map(A, B)
    mpc = km.NonlinearMPC(plant, km.Cost(1, 0.1), km.Limits(-0.5, 0.5), 6)
    assert mpc.plan() is None
    move = mpc([0.4, 0.2], [0, 0])
    plan = mpc.plan()
    np.testing.assert_array_equal(plan.U[0], move.u)
    np.testing.assert_allclose(plan.X, plant.rollout([0.4, 0.2], plan.U), atol=1e-6)
    kept = plan.U.copy()
    move.u[:], plan.U[:] = 99.0, 99.0
    np.testing.assert_array_equal(mpc([np.nan, 0], [0, 0]).u, kept[1])
    assert (mpc.dt, mpc.nu, mpc.horizon) == (0.1, 1, 6)


def test_a_held_reference_is_its_rows_repeated():
    mpc = km.NonlinearMPC(step_map(A, B), km.Cost(1, 0.1), horizon=5)
    first = mpc([0.2, 0.1], [0.3, 0]).u
    for rows in ([[0.3, 0]], [[0.3, 0]] * 3, [[0.3, 0]] * 9):
        mpc.reset()
        np.testing.assert_array_equal(mpc([0.2, 0.1], rows).u, first)


@dataclass(frozen=True)
class Escape(km.Dynamics):
    states, inputs = ("x",), ("u",)

    def rhs(self, x, u):
        return ca.vertcat(x[0] ** 2 + u[0])


@pytest.mark.parametrize(
    "integrator", [km.RK4(), km.plants.ImplicitMidpoint(), km.plants.Collocation(), km.plants.CVODES()]
)
def test_a_plant_that_escapes_within_the_horizon_fails_a_step_and_raises_nothing(integrator):
    mpc = km.NonlinearMPC(km.discretize(Escape(), 0.2, integrator), km.Cost(1, 0.1), km.Limits(-1, 1), 10)
    good = mpc([0.2], [0.0])
    assert good.status is km.Status.OPTIMAL
    for x in (50.0, 1e6, 1e29):
        move = mpc([x], [0.0])
        assert move.status in (km.Status.FAILED, km.Status.INFEASIBLE, km.Status.BAD_MEASUREMENT)
        assert x < 1e29 or move.status is km.Status.BAD_MEASUREMENT  # of 1e29 no digit is left
        assert np.abs(move.u) <= 1
    np.testing.assert_allclose(mpc([0.2], [0.0]).u, good.u, atol=1e-4)


def test_an_estimate_from_which_no_next_state_is_found_ends_no_loop():
    plant, estimator = km.discretize(Escape(), 0.2, km.plants.Collocation()), km.LiftedDisturbance()
    mpc = km.NonlinearMPC(plant, km.Cost(1, 0.1), km.Limits(-1, 1), 5, estimator=estimator)
    for x in (0.1, 0.1, 50.0, 0.1, np.nan, 0.2):
        move = mpc([x], [0.0])
        assert np.abs(move.u) <= 1
        if x == 50.0:
            assert move.status is km.Status.FAILED


def test_every_end_has_a_status_and_a_safe_input():
    short = km.NonlinearMPC(
        step_map(A, B), km.Cost(1, 0.1), km.Limits(-0.5, 0.5), 6, solver=km.control.NLP(settings={"ipopt.max_iter": 1})
    )
    move = short([2.0, 1.0], [0, 0])
    assert (move.status, move.fallback) == (km.Status.MAX_ITERATIONS, km.control.Fallback.HOLD)
    assert move.iterations == 2  # one from each of two starts
    np.testing.assert_array_equal(move.u, [0.0])

    mpc = km.NonlinearMPC(step_map(A, B), km.Cost(1, 0.1), km.Limits(-1, 1, x_max=[0.5, 2], slack=None), 6)
    good = mpc([0.4, 0.1], [0, 0])
    plan = mpc.plan().U
    assert good.status is km.Status.OPTIMAL
    failed = mpc([3.0, 0.0], [0, 0])
    assert failed.status is km.Status.INFEASIBLE
    assert failed.fallback is km.control.Fallback.SHIFTED_PLAN
    assert mpc.plan() is None
    np.testing.assert_array_equal(failed.u, plan[1])
    for k in range(2, 6):
        move = mpc([0.1, np.nan], [0, 0])
        assert (move.status, move.fallback) == (km.Status.BAD_MEASUREMENT, km.control.Fallback.SHIFTED_PLAN)
        np.testing.assert_array_equal(move.u, plan[k])
    held = mpc([0.1, 0.1], [np.inf, 0])
    assert (held.status, held.fallback) == (km.Status.BAD_MEASUREMENT, km.control.Fallback.HOLD)
    np.testing.assert_array_equal(held.u, plan[-1])
    mpc.reset(u_prev=[7.0])
    np.testing.assert_array_equal(mpc([np.nan, 0], [0, 0]).u, [1.0])
    again = mpc([0.4, 0.1], [0, 0])
    assert again.status is km.Status.OPTIMAL
    np.testing.assert_allclose(again.u, good.u, atol=1e-6)


def swing():
    """θ̈ = (g/L) sin θ + u / (m L²): θ = 0 is upright, m = 1 kg, L = 2 m; level takes 19.6 N m."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    flow = ca.Function("f", [x, u], [ca.vertcat(x[1], 9.81 / 2 * ca.sin(x[0]) + u / 4)])
    h, state = 0.1, x
    k1 = flow(state, u)
    k2 = flow(state + h / 2 * k1, u)
    k3 = flow(state + h / 2 * k2, u)
    k4 = flow(state + h * k3, u)
    step = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return km.StepMap(ca.Function("F", [x, u], [step]), h, states=("theta", "omega"))


def test_it_swings_a_pendulum_up_with_half_the_torque_that_lifts_it():
    plant = swing()
    mpc = km.NonlinearMPC(plant, km.Cost(Q=[10, 1], R=0.05), km.Limits(-10, 10), 40)
    x = np.array([np.pi, 0.0])
    for _ in range(80):
        move = mpc(x, [0, 0])
        assert abs(move.u[0]) <= 10
        x = plant(x, move.u)
    np.testing.assert_allclose(np.angle(np.exp(1j * x[0])), 0, atol=1e-2)
    np.testing.assert_allclose(x[1], 0, atol=1e-2)


SOLVERS = ["ipopt", "fatrop", "sqpmethod"]
UPRIGHT = km.Expressions(lambda x: [ca.sin(x[0]), ca.cos(x[0]), x[1]], ["s", "c", "omega"])


def pendulum() -> km.StepMap:
    """θ = 0 is upright."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    x_next = ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.3 * ca.sin(x[0]) + 0.1 * u)
    return km.StepMap(ca.Function("F", [x, u], [x_next]), 0.1, states=("theta", "omega"), inputs=("u",))


@pytest.mark.parametrize(
    "limits",
    [
        km.Limits(-1, 1),
        km.Limits(-2, 2, x_max=[np.inf, 0.2]),
        km.Limits(-2, 2, x_max=[0.5, np.inf], slack=None),
        km.Limits(-2, 2, x_min=[-1, -0.4], slack=([np.inf, 30.0], [0.0, 3.0])),
    ],
)
def test_all_solvers_find_the_same_plan(limits: km.Limits) -> None:
    plant, cost = pendulum(), km.Cost(Q=[2, 0.2], R=0.1)
    plans = []
    for solver in SOLVERS:
        mpc = km.NonlinearMPC(plant, cost, limits, 12, solver=solver)
        x = np.array([0.45, 0.1])
        for _ in range(4):
            move = mpc(x, [0, 0])
            assert move.status in (km.Status.OPTIMAL, km.Status.SOFTENED), solver
            x = plant(x, move.u)
        plans.append(mpc.plan().U)
    assert np.allclose(plans[1], plans[0], atol=1e-3)
    assert np.allclose(plans[2], plans[0], atol=1e-3)


@pytest.mark.parametrize("solver", SOLVERS)
def test_copies_go_on_as_their_original_also_in_threads(solver: str) -> None:
    plant, limits = pendulum(), km.Limits(-1, 1, du_max=0.3, x_max=[np.inf, 0.2])
    mpc = km.NonlinearMPC(plant, km.Cost(Q=[2, 0.2], R=0.1), limits, 12, solver=solver)
    start = np.array([0.45, 0.1])
    start = plant(start, mpc(start, [0, 0]).u)

    def run(controller: km.NonlinearMPC) -> np.ndarray:
        x, inputs = start, []
        for k in range(25):
            inputs.append(controller(x, [0.01 * (k % 5), 0]).u)
            x = plant(x, inputs[-1])
        return np.array(inputs)

    controllers = [copy.deepcopy(mpc), copy.deepcopy(mpc), pickle.loads(pickle.dumps(mpc))]
    alone = run(mpc)
    with ThreadPoolExecutor(3) as pool:
        for inputs in pool.map(run, controllers):
            assert np.array_equal(inputs, alone)


def test_several_starts_leave_a_local_optimum() -> None:
    """Hanging, at rest, no small input changes 1 − cos θ: one start stays, several do not."""
    plant, cost = pendulum(), km.Cost(Q=[1, 1, 0.01], R=0.01, of=UPRIGHT)
    hanging = [np.pi, 0.0]
    one, several = (km.NonlinearMPC(plant, cost, km.Limits(-2, 2), 30, solver=km.control.NLP(starts=n)) for n in (1, 5))
    one(hanging, [0, 1, 0])
    several(hanging, [0, 1, 0])
    highest = [np.cos(mpc.plan().X[:, 0]).max() for mpc in (one, several)]
    assert highest[1] > highest[0] + 0.1


class Tank(km.Dynamics):
    """ḣ = u − √h: below an empty tank there is no forecast."""

    states, inputs = ("h [m]",), ("inflow [m/s]",)

    def rhs(self, x, u):
        return ca.vertcat(u[0] - ca.sqrt(x[0]))


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
def test_a_forecast_that_turns_nan_is_no_plan(kind):
    plant = km.discretize(Tank(), 0.2, km.plants.Euler())
    mpc = kind(plant, km.Cost(Q=[10.0], R=0.01, u_target=[0.0]), km.Limits(u_min=0, u_max=1), 10)
    for x in (1.0, 0.05, 0.01, 1e-4, 1e-9, 0.5):
        move = mpc([x], [0.0])
        assert 0 <= move.u[0] <= 1
        plan = mpc.plan()
        if move.fallback is km.control.Fallback.NONE:
            assert np.isfinite(plan.X).all()
            assert np.isfinite(plan.U).all()
            assert np.abs(plan.X[1:, 0] - plan.X[:-1, 0] - 0.2 * (plan.U[:, 0] - np.sqrt(plan.X[:-1, 0]))).max() < 0.05
    assert move.fallback is km.control.Fallback.NONE  # a level from which there is a forecast again


@pytest.mark.parametrize("horizon", [1, 2, 5])
@pytest.mark.parametrize("limits", [km.Limits(-1, 1), km.Limits(-1, 1, x_max=[1.0, 2.0])])
def test_the_next_step_starts_from_the_solution_moved_on_by_one_step_multipliers_included(horizon, limits):
    """Constraints are gap_1; gap_2, path_1; …; gap_N, path_{N−1}; path_N: each takes its place of the stage behind."""
    mpc = km.NonlinearMPC(pendulum(), km.Cost(Q=[1, 0.1], R=0.1), limits, horizon)
    npath = 0 if limits.x_max is None else 4  # two soft limits: g − ε and g + ε
    labels = []
    for k in range(1, horizon + 2):
        labels += [("gap", k, i) for i in range(2) if k <= horizon]
        labels += [("path", k - 1, i) for i in range(npath) if k > 1]
    moved = [labels[i] for i in mpc._step.solver._shooting._next_g]
    assert moved == [(kind, min(k + 1, horizon), i) for kind, k, i in labels]
    mpc._step.aim.at(np.zeros(2), np.zeros(2), mpc._task.outputs.R_root, np.inf)
    start = mpc._step.solver._shooting.at(np.zeros((horizon, 2)), np.zeros((horizon, 1)))
    solution = mpc._step.solver._shooting.solve(
        np.array([0.5, 0.0]), mpc._step.aim.stages, mpc._step.e, start, mpc._task.problem.inputs
    )
    whole = np.hstack([solution.U, solution.X, solution.slacks]) / mpc._step.solver._shooting._sizes
    wanted = np.vstack([whole[1:], whole[-1:]])
    np.testing.assert_allclose(solution.start.v.reshape(horizon, -1), wanted, atol=1e-12)


def test_a_solution_that_is_no_number_in_one_place_is_a_failure():
    mpc = km.NonlinearMPC(pendulum(), km.Cost(Q=[1, 0.1], R=0.1), km.Limits(-1, 1), 4)
    mpc([0.5, 0.0], [0, 0])
    own = mpc._step.solver._shooting._solver

    class Torn:
        stats = own.stats

        def __call__(self, **given):
            found = dict(own(**given))
            found["x"][3] = np.nan
            return found

    mpc._step.solver._shooting._solver = Torn()
    move = mpc([0.5, 0.0], [0, 0])
    assert move.status is km.Status.FAILED
    assert np.isfinite(move.u).all()
