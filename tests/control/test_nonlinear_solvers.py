"""NonlinearMPC: three solvers and one answer, several starts against a local optimum, a terminal cost with a period."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.nonlinear.equilibrium import TerminalTargets
from koopmpc.control.nonlinear.problem import learned_map
from koopmpc.control.riccati import stationary
from koopmpc.control.tracking import state_tracking

SOLVERS = ["ipopt", "fatrop", "sqpmethod"]


def pendulum() -> km.StepMap:
    """θ = 0 is upright."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    x_next = ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.3 * ca.sin(x[0]) + 0.1 * u)
    return km.StepMap(ca.Function("F", [x, u], [x_next]), 0.1, states=("theta", "omega"), inputs=("u",))


UPRIGHT = km.Expressions(lambda x: [ca.sin(x[0]), ca.cos(x[0]), x[1]], ["s", "c", "omega"])


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


def test_no_starts_are_refused() -> None:
    with pytest.raises(km.errors.DataError, match="starts is 0; it must be at least 1"):
        km.NonlinearMPC(pendulum(), km.Cost(1, 1), starts=0)


def test_several_starts_leave_a_local_optimum() -> None:
    """Hanging, at rest, no small input changes 1 − cos θ: one start stays, several do not."""
    plant, cost = pendulum(), km.Cost(Q=[1, 1, 0.01], R=0.01, of=UPRIGHT)
    hanging = [np.pi, 0.0]
    one, several = (km.NonlinearMPC(plant, cost, km.Limits(-2, 2), 30, starts=n) for n in (1, 5))
    one(hanging, [0, 1, 0])
    several(hanging, [0, 1, 0])
    highest = [np.cos(mpc.plan().X[:, 0]).max() for mpc in (one, several)]
    assert highest[1] > highest[0] + 0.1


def test_the_end_costs_the_same_at_every_turn_and_is_riccatis_near_the_goal() -> None:
    plant, cost = pendulum(), km.Cost(Q=[1, 1, 0.1], R=0.1, of=UPRIGHT)
    read = state_tracking(plant.states, plant.nu, cost, km.Limits(-2, 2))
    target = TerminalTargets(learned_map(plant), cost, read, 300)(np.array([0.0, 1.0, 0.0]))

    def end(x: np.ndarray) -> float:
        e = target.M @ read.tracked(x).full().ravel() + target.L @ x - target.m
        return float(e @ e)

    assert np.allclose(np.sin(target.equilibrium.x[0]), 0, atol=1e-6)
    assert np.cos(target.equilibrium.x[0]) > 0.99
    far = np.array([1.0, 0.5])
    assert end(far + np.array([2 * np.pi, 0])) == pytest.approx(end(far), rel=1e-9)
    affine = plant.linearize(target.equilibrium.x, target.u)
    P = stationary(affine.A, affine.B, np.diag([1.0, 0.1]), read.R, 300).P
    for d in np.array([[1e-3, 0], [0, 1e-3], [1e-3, -2e-3]]):
        assert end(target.equilibrium.x + d) == pytest.approx(d @ P @ d, rel=1e-2)
    assert end(target.equilibrium.x + np.array([np.pi, 0])) > end(
        target.equilibrium.x + np.array([0.5, 0])
    )  # hanging is no goal


def test_the_goal_of_a_periodic_reference_is_not_the_stationary_point_at_zero() -> None:
    """From the guess x = 0 the gradient of the distance to cos θ = −1 is zero."""
    plant, cost = pendulum(), km.Cost(Q=[1, 1, 0.1], R=0.1, of=UPRIGHT)
    read = state_tracking(plant.states, plant.nu, cost, km.Limits(-2, 2))
    target = TerminalTargets(learned_map(plant), cost, read, 300)(np.array([0.0, -1.0, 0.0]))
    assert np.cos(target.equilibrium.x[0]) < -0.99
