"""What every solver behind the interface has to do, on random QPs of a seeded generator."""

import collections
import copy
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.control.kkt import meets_kkt
from tests.control.solvers.random_qps import FEASIBLE, KINDS, QP, SOLVERS, QPSolver, exactness, random_qp

TIGHT = {"osqp": {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100_000}, "daqp": {}}
WELL_SCALED = ("box", "hard", "soft", "exact", "dense", "degenerate")


@pytest.fixture(params=["osqp", "daqp"], scope="module")
def name(request):
    return request.param


def start(qp):
    return np.zeros(len(qp.q)), np.zeros(len(qp.low))


def held(name, qp, solution):
    """Assert the KKT conditions to the tolerance that the solver promises.

    That of OSQP is 1e-5. That of DAQP is 1e-6 of each row, by norms that are within a factor of two of those here, and
    1e-8 of rows that are smaller than 0.01: one of 10⁵ random QPs has a limit of 0, and a row and a solution so small.
    """
    if name == "osqp":
        meets_kkt(qp, solution, 1e-5, 1e-5)
    else:
        assert exactness(qp, solution.v, solution.y, least=0.01) < 2e-6


def answers(name, rng, count):
    """Solve `count` random QPs of each kind in turn, cold, with new limits, and warm; count the statuses."""
    seen = collections.Counter()
    for i in range(count):
        kind = KINDS[i % len(KINDS)]
        qp = random_qp(rng, kind)
        made = SOLVERS[name](qp, None)
        solution = made.solve(*start(qp))
        if solution.status is km.Status.OPTIMAL:
            held(name, qp, solution)
            assert kind != "infeasible"
        seen[kind, solution.status.name] += 1
        moved = QP(qp.P, qp.q, qp.A, qp.low - rng.choice([0.0, 0.1]), qp.high + rng.choice([0.0, 0.1]))
        made.set_bounds(moved.low, moved.high)
        solved = solution.status is km.Status.OPTIMAL
        again = made.solve(solution.v, solution.y) if solved else made.solve(*start(qp))
        if again.status is km.Status.OPTIMAL:
            held(name, moved, again)
        seen["moved" if kind != "infeasible" else "moved apart", again.status.name] += 1
    return seen


def test_random_qps(name):
    seen = answers(name, np.random.default_rng(1), 500)
    assert sum(n for (kind, status), n in seen.items() if kind in FEASIBLE and status == "OPTIMAL") > 350
    assert seen["infeasible", "INFEASIBLE"] > 45


@pytest.mark.slow
def test_a_hundred_thousand_random_qps(name):
    count = 50_000  # each is solved, moved, and solved again
    seen = answers(name, np.random.default_rng(2), count)
    lines = [f"{kind:11s} {status:14s} {n}" for (kind, status), n in sorted(seen.items())]
    sys.stdout.write(f"\n{name}, {2 * count} solves\n" + "\n".join(lines) + "\n")
    assert sum(seen.values()) == 2 * count
    share = seen["infeasible", "INFEASIBLE"] / (count / len(KINDS))
    assert share > (0.999 if name == "daqp" else 0.97)
    if name == "daqp":  # every feasible one is solved, but for a few whose P is singular
        missed = [kind for kind, status in seen if kind in FEASIBLE and status != "OPTIMAL"]
        assert set(missed) <= {"singular"}
        assert seen["singular", "OPTIMAL"] > 0.999 * count / len(KINDS)


def clarabel(qp):
    """(v, value) by CLARABEL; (None, inf) where the problem is infeasible."""
    import cvxpy as cp

    v = cp.Variable(len(qp.q))
    from_below, from_above = np.isfinite(qp.low), np.isfinite(qp.high)
    cost = 0.5 * cp.quad_form(v, cp.psd_wrap(qp.P)) + qp.q @ v
    rows = []
    if from_below.any():
        rows.append(qp.A[from_below] @ v >= qp.low[from_below])
    if from_above.any():
        rows.append(qp.A[from_above] @ v <= qp.high[from_above])
    problem = cp.Problem(cp.Minimize(cost), rows)
    problem.solve(cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    return v.value, float(problem.value)


@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from((*WELL_SCALED, "infeasible")))
def test_against_clarabel(name, seed, kind):
    qp = random_qp(np.random.default_rng(seed), kind)
    solution = SOLVERS[name](qp, TIGHT[name]).solve(*start(qp))
    v, value = clarabel(qp)
    if kind == "infeasible":
        assert v is None
        assert solution.status is not km.Status.OPTIMAL
    elif solution.status is km.Status.OPTIMAL:
        cost = 0.5 * solution.v @ qp.P @ solution.v + qp.q @ solution.v
        assert abs(cost - value) <= 1e-5 * (1 + abs(value))
        if kind != "exact":
            scale = np.sqrt(np.diag(qp.P).max() / np.linalg.eigvalsh(qp.P).min())
            np.testing.assert_allclose(solution.v, v, atol=1e-5 * scale * (1 + np.abs(v).max()))
    else:
        assert name == "osqp"
        assert solution.status is km.Status.MAX_ITERATIONS or kind == "degenerate"


def test_warm_starts_save_iterations(name):
    """Limits that drift, on as many independent rows as variables: every QP is feasible."""
    rng, N = np.random.default_rng(0), 20
    A = np.tril(rng.normal(size=(N, N)) / N) + np.eye(N)
    wish, drift, ones = 2 * rng.normal(size=N), 0.02 * rng.normal(size=N), np.ones(N)
    at = QP(np.eye(N), np.zeros(N), A, -ones - wish, ones - wish)
    made, solution, spent = SOLVERS[name](at, None), None, np.zeros(2)
    for k in range(30):
        at = QP(at.P, at.q, A, -ones - wish - k * drift, ones - wish - k * drift)
        made.set_bounds(at.low, at.high)
        cold = SOLVERS[name](at, None).solve(*start(at))
        solution = made.solve(*start(at)) if solution is None else made.solve(solution.v, solution.y)
        assert solution.status is cold.status is km.Status.OPTIMAL
        held(name, at, solution)
        if k > 0:
            spent += solution.iterations, cold.iterations
    assert spent[0] < 0.7 * spent[1]


def test_time_limits(name):
    rng, limit = np.random.default_rng(0), np.full(300, 0.03)  # DAQP has 400 rows to try here
    qp = QP(np.eye(100), 30 * rng.normal(size=100), np.tril(rng.normal(size=(300, 100))), -limit, limit)
    endless = {"eps_abs": 1e-300, "eps_rel": 0.0, "max_iter": 10**6} if name == "osqp" else {}
    made, given_v, given_y = SOLVERS[name](qp, endless), np.ones(100), np.ones(300)
    for over in (0.0, -1.0, np.nan):
        solution = made.solve(given_v, given_y, time_limit=over)
        assert solution.status is km.Status.TIME_LIMIT
        assert solution.iterations == 0
        np.testing.assert_array_equal(solution.v, given_v)
        assert solution.v is not given_v
    assert made.solve(*start(qp), time_limit=1e-5).status is km.Status.TIME_LIMIT
    if name == "daqp":  # without a limit it runs to its end again
        assert made.solve(*start(qp)).status is km.Status.OPTIMAL


def test_copies_and_pickles_solve_the_same(name):
    rng = np.random.default_rng(0)
    qp = random_qp(rng, "soft", 6)
    made = SOLVERS[name](qp, TIGHT[name])
    made.set_bounds(qp.low - 0.1, qp.high + 0.2)
    fresh = SOLVERS[name](QP(qp.P, qp.q, qp.A, qp.low - 0.1, qp.high + 0.2), TIGHT[name]).solve(*start(qp))
    made.solve(*start(qp))
    for other in (copy.copy(made), copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert isinstance(other, QPSolver)
        solution = other.solve(*start(qp))
        np.testing.assert_array_equal(solution.v, fresh.v)
        np.testing.assert_array_equal(solution.y, fresh.y)


def test_reset_repeats_to_the_bit(name):
    qp = random_qp(np.random.default_rng(0), "soft", 8)
    made = SOLVERS[name](qp, None)
    made.solve(*start(qp))
    first = []
    for _ in range(2):
        made.reset()
        made.set_bounds(qp.low - 0.05, qp.high)
        first.append(made.solve(*start(qp)))
    np.testing.assert_array_equal(first[0].v, first[1].v)
    np.testing.assert_array_equal(first[0].y, first[1].y)
    assert first[0].iterations == first[1].iterations


def test_two_in_two_threads_do_not_disturb_each_other(name):
    qps = [random_qp(np.random.default_rng(i), "hard", 20) for i in range(2)]

    def run(qp):
        made = SOLVERS[name](qp, None)
        return [made.solve(*start(qp)).v for _ in range(50)]

    alone = [run(qp) for qp in qps]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(run, qps))
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_the_solvers_would_swallow_is_refused(name):
    three = np.ones(3)
    made = SOLVERS[name](QP(np.eye(3), 2 * three, np.eye(3), -three, three), TIGHT[name])
    with pytest.raises(km.errors.ShapeError, match=r"the limits have shapes \(2,\) and \(2,\), the QP has 3 rows"):
        made.set_bounds(-np.ones(2), np.ones(2))
    with pytest.raises(km.errors.ShapeError, match=r"the warm start has shapes \(3,\) and \(2,\), the QP is \(3,\), "):
        made.solve(three, np.ones(2))
    nan, wide = np.full(3, np.nan), np.full(3, np.inf)
    for low, high in ((three, -three), (nan, three), (-three, nan), (wide, wide), (-wide, -wide)):
        with pytest.raises(km.errors.DataError, match=r"the limits of the QP cross, hold NaN, or are beyond 1e30"):
            made.set_bounds(low, high)
        solution = made.solve(0 * three, 0 * three)  # the old limits stand
        np.testing.assert_allclose(solution.v, -three, atol=1e-8)
    strided = np.array([-0.1, 9, -0.2, 9, -0.3, 9])[::2]
    made.set_bounds(strided, three)
    np.testing.assert_allclose(made.solve(strided, strided).v, strided, atol=1e-8)
