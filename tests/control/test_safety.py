"""Random QPs through whole controllers: an answer is the optimum or says it is not; inputs stay inside."""

import collections
import sys

import numpy as np
import pytest

import koopmpc as km
from tests.control.random_mpcs import KINDS, feasible, optimality, random_case

GOOD = (km.Status.UNCONSTRAINED, km.Status.OPTIMAL, km.Status.SOFTENED)
# How far from the optimum, as a share of the largest force. OSQP stops at 1e-5 of it, at 1e-4 where rows are soft, in
# the norm of single entries, and each of its QPs is held to just that, see conftest; DAQP is exact to rounding.
EXACT = {"osqp": 1e-2, "daqp": 1e-6}
STEPS = 20


def inside(case, u, u_prev):
    """Assert that u is in its limits to the last bit, and that its change is, as far as they allow."""
    low, high = case.box
    assert np.isfinite(u).all()
    assert ((low <= u) & (u <= high)).all()
    if case.rates is not None:
        assert (u <= np.maximum(u_prev + case.rates, low)).all()
        assert (u >= np.minimum(u_prev - case.rates, high)).all()


def conflict(case, u_prev):
    """Whether the last input is so far outside that its rates do not reach the limits."""
    low, high = case.box
    return case.rates is not None and bool(((u_prev + case.rates < low) | (u_prev - case.rates > high)).any())


def steps(case, rng):
    """Yield x, r, the last input, its move and the plan, of a closed loop that is torn away now and then."""
    nx, mpc = len(case.A), case.mpc
    x, u_prev = np.zeros(nx), np.clip(np.zeros(case.B.shape[1]), *case.box)
    mpc.reset()
    r = np.zeros((case.N, nx))
    for k in range(STEPS):
        if k % 5 == 0:
            x = case.scale * rng.normal(size=nx) * 10.0 ** rng.uniform(-2, 1)
            r = np.tile(case.scale * rng.normal(size=nx) * 10.0 ** rng.uniform(-2, 0.5), (case.N, 1))
        applied = None
        if rng.random() < 0.1:  # the plant got something else
            applied = u_prev * rng.uniform(-1, 1) if case.box[0].max() <= 0 <= case.box[1].min() else None
            u_prev = u_prev if applied is None else applied
        move = mpc(x, np.vstack([x, r]), applied)
        yield x, r, u_prev, move, mpc.plan()
        u_prev = move.u
        x = case.A @ x + case.B @ move.u


def through_controllers(seed, count, share):
    """Return how often each kind ended in each status, of `count` steps, of which a share is checked by brute force."""
    seen, worst = collections.Counter(), collections.Counter()
    for i in range(count // STEPS):
        rng, solver = np.random.default_rng((seed, i)), ("osqp", "daqp")[i % 2]
        case = random_case(rng, KINDS[i // 2 % len(KINDS)], solver)
        for x, r, u_prev, move, plan in steps(case, rng):
            inside(case, move.u, u_prev)
            status, U = move.status, None if plan is None else plan.U.ravel()
            assert (status in GOOD) == (move.fallback is km.control.Fallback.NONE) == (plan is not None)
            seen[solver, case.kind, status.name] += 1
            if rng.random() > share or conflict(case, u_prev):
                continue
            if status is km.Status.INFEASIBLE:
                seen[solver, case.kind, "false INFEASIBLE"] += feasible(case, x, u_prev)
            if status in GOOD:
                violation, distance = optimality(case, x, r, u_prev, U, EXACT[solver])
                seen[solver, "checked"] += 1
                worst[solver, "violation"] = max(worst[solver, "violation"], violation)
                worst[solver, "distance"] = max(worst[solver, "distance"], distance)
                assert max(violation, distance) < EXACT[solver], (seed, i, status, violation, distance)
    return seen, worst


def test_a_sample_of_random_qps_through_whole_controllers():
    seen, _ = through_controllers(1, 540, 1.0)
    assert sum(n for key, n in seen.items() if key[-1] in {status.name for status in GOOD}) > 350
    assert sum(n for key, n in seen.items() if key[-1] == "INFEASIBLE") > 5


@pytest.mark.slow
def test_a_hundred_thousand_random_qps_through_whole_controllers():
    seen, worst = through_controllers(2, 100_000, 0.3)
    assert sum(n for key, n in seen.items() if key[-1] in km.Status.__members__) == 100_000
    lines = [f"{' '.join(key):40s} {n}" for key, n in sorted(seen.items())]
    lines += [f"worst {' '.join(key):20s} {value:.2g}" for key, value in worst.items()]
    sys.stdout.write("\n" + "\n".join(lines) + "\n")


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
def test_failed_steps_apply_the_last_plan_step_by_step_also_where_moves_are_held(solver):
    A, B = np.array([[1.02, 0.1], [0.05, 1.01]]), np.array([[0.005], [0.1]])
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("p", "v"), ("u",))
    mpc = km.KoopmanMPC(model, km.Cost([1, 0.2], 0.1), km.Limits(-0.9, 0.9), 10, moves=(1, 2, 3, 4), solver=solver)
    x = [0.5, -0.3]
    assert mpc(x, [0, 0]).status is km.Status.OPTIMAL
    U = mpc.plan().U
    assert len(np.unique(U)) == 4  # four moves for ten steps
    mpc.solver_fails = True
    for u in U[1:]:
        move = mpc(x, [0, 0])
        assert (move.status, move.fallback) == (km.Status.FAILED, km.control.Fallback.SHIFTED_PLAN)
        assert np.array_equal(move.u, u)
    assert mpc(x, [0, 0]).fallback is km.control.Fallback.CLIPPED_LQR


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 1])
def test_lqr_holds_its_input_where_a_reference_is_no_number_in_one_place(bad, place):
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("p", "v"), ("u",))
    lqr = km.LQR(model, km.Cost(Q=[1, 1], R=0.1), km.Limits(-1, 1))
    reference = np.zeros(2)
    reference[place] = bad
    before = lqr([0.1, 0.0], [0.0, 0.0]).u
    move = lqr([0.1, 0.0], reference)
    assert move.status is km.Status.BAD_MEASUREMENT
    assert np.array_equal(move.u, before)
