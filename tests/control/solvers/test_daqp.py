import cvxpy as cp
import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.ask.limits import Softness
from koopmpc.control.solvers.base import QP
from koopmpc.control.solvers.daqp import DAQP
from tests.bare import shown
from tests.control.solvers.random_qps import exactness, random_qp

ONE, EYE = np.ones(2), np.eye(2)


def box(**settings):
    return DAQP(QP(EYE, -3 * ONE, EYE, -ONE, ONE), settings)


def solved(solver, n=2, m=2):
    return solver.solve(np.zeros(n), np.zeros(m))


def test_exact_to_rounding():
    rng = np.random.default_rng(0)
    for kind in ("box", "hard", "soft", "degenerate", "scaled"):
        qp = random_qp(rng, kind, 12)
        solution = DAQP(qp).solve(np.zeros(len(qp.q)), np.zeros(len(qp.low)))
        assert solution.status is km.Status.OPTIMAL
        assert exactness(qp, solution.v, solution.y) < 1e-10


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e6, 1e9])
def test_units_of_rows_and_cost_do_not_matter(unit):
    """Bare DAQP drops rows of norm 1e-7, and measures feasibility by the root of the cost."""
    solution = solved(DAQP(QP(EYE, -3 * ONE, unit * EYE, -unit * ONE, unit * ONE)))
    np.testing.assert_allclose(solution.v, ONE, rtol=1e-12)
    np.testing.assert_allclose(unit * solution.y, 2 * ONE, rtol=1e-12)
    solution = solved(DAQP(QP(unit * EYE, -3 * unit * ONE, EYE, -ONE, ONE)))
    np.testing.assert_allclose(solution.v, ONE, rtol=1e-12)
    np.testing.assert_allclose(solution.y, 2 * unit * ONE, rtol=1e-12)


def test_rows_close_to_equal_are_not_contradictory():
    """More equalities than variables, all met at one point to rounding: bare DAQP calls some infeasible."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        n = int(rng.integers(1, 9))
        half, A, inside = rng.normal(size=(n, n)), rng.normal(size=(2 * n, n)), rng.normal(size=n)
        qp = QP(half @ half.T + np.eye(n), rng.normal(size=n), A, A @ inside, A @ inside)
        solution = solved(DAQP(qp), n, 2 * n)
        assert solution.status is km.Status.OPTIMAL
        np.testing.assert_allclose(solution.v, inside, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_inputs_that_cannot_hold_an_unstable_plant_are_not_called_infeasible(seed):
    """|u_k| ≤ 1 and |u_k − u_{k−1}| ≤ 0.2, u_k = v_k − 1.3 v_{k−1} − p_k: all u in the box can be, with |v| to 1e9."""
    n, rng = 50, np.random.default_rng(seed)
    A, change = np.eye(n) - 1.3 * np.eye(n, k=-1), np.eye(n) - np.eye(n, k=-1)
    p, half = 10.0 ** rng.uniform(0, 4) * rng.normal(size=n), np.repeat([1.0, 0.2], n)
    rows, middle = np.vstack([A, change @ A]), np.concatenate([p, change @ p])
    solution = solved(DAQP(QP(np.eye(n), np.zeros(n), rows, middle - half, middle + half)), n, 2 * n)
    assert solution.status is km.Status.OPTIMAL
    assert (np.abs(rows @ solution.v - middle) <= half + 1e-6).all()
    back = np.linalg.inv(A) / np.linalg.norm(solution.v)
    u = cp.Variable(n)  # the same in u, whose limits have no rounding; its cost is near 1
    least = cp.Problem(cp.Minimize(cp.sum_squares(back @ (u + p))), [cp.abs(u) <= 1, cp.abs(change @ u) <= 0.2])
    assert abs(least.solve(solver="CLARABEL") - 1) < 1e-7


@pytest.mark.parametrize("seed", range(3))
def test_more_rows_than_variables_to_start_from_lead_to_the_same_answer_in_few_iterations(seed):
    """|u_k| ≤ 1 and soft x_{k+1} = 1.3 x_k + u_k ≤ 1 from 50 to 1e4 times as far out: all of them give way."""
    n, rng = 30, np.random.default_rng(seed)
    reach = np.linalg.inv(np.eye(n) - 1.3 * np.eye(n, k=-1))
    x = 1.3 ** np.arange(1, n + 1) * rng.uniform(20, 60)
    rows, none = np.vstack([np.eye(n), reach]), np.zeros(n)
    low, high = np.append(-np.ones(n), np.full(n, -np.inf)), np.append(np.ones(n), 1 - x)
    prices = Softness(np.append(none + np.inf, none + 1e3), np.append(none, none + 0.1), none)
    solver = DAQP(QP(np.eye(n), none, rows, low, high, prices))
    cold = solved(solver, n, 2 * n)
    assert np.count_nonzero(cold.y) > n
    wrong = cold.y.copy()
    wrong[rng.permutation(2 * n)[:8]] *= -1
    again = solver.solve(none, wrong)
    assert again.status is cold.status is km.Status.OPTIMAL
    np.testing.assert_allclose(again.v, cold.v, atol=1e-7)
    assert again.iterations <= 10 * n


def test_equalities_come_and_go():
    solver = box()
    for low, high, v in ((0.5, 0.5, 0.5), (-1, 1, 1), (-np.inf, np.inf, 3), (2, 2, 2), (-4, -3.5, -3.5)):
        solver.set_bounds(low * ONE, high * ONE)
        np.testing.assert_allclose(solved(solver).v, v * ONE, atol=1e-12)


def test_empty_rows():
    qp = QP(EYE, -3 * ONE, np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([-1.0, -1.0]), ONE)
    solver = DAQP(qp)
    np.testing.assert_allclose(solved(solver).v, [1, 3], atol=1e-12)
    solver.set_bounds(np.array([0.5, -1.0]), ONE)
    assert solved(solver).status is km.Status.INFEASIBLE
    solver.set_bounds(qp.low, qp.high)
    np.testing.assert_allclose(solved(solver).v, [1, 3], atol=1e-12)
    np.testing.assert_allclose(solved(DAQP(QP(EYE, ONE, EYE[:0], ONE[:0], ONE[:0])), 2, 0).v, -ONE)


def test_linear_slacks_solve_warm_as_they_do_cold():
    """P is singular there: bare DAQP, started warm, calls some of them unbounded."""
    rng = np.random.default_rng(2)
    for _ in range(500):
        qp = random_qp(rng, "exact")
        start = np.zeros(len(qp.q)), np.zeros(len(qp.low))
        solver = DAQP(qp)
        for wider in (0.0, 0.1, 0.0):
            moved = QP(qp.P, qp.q, qp.A, qp.low - wider, qp.high + wider)
            solver.set_bounds(moved.low, moved.high)
            solution = solver.solve(*start)
            assert solution.status is km.Status.OPTIMAL
            assert exactness(moved, solution.v, solution.y) < 1e-6


@pytest.mark.parametrize(("quadratic", "far"), [(1e-8, 5000.0), (0.0, 50.0)])
def test_a_soft_row_far_beyond_what_v_reaches_costs_its_price_and_no_more(quadratic, far):
    """½ |v|² + p ε + q ε² with ε = a·v + far has its minimum at v = −a (p + 2 q far) / (1 + 2 q |a|²)."""
    a, p = np.array([0.8, 0.1]), 0.4
    price = Softness(np.array([p]), np.array([quadratic]), np.zeros(1))
    solution = solved(DAQP(QP(EYE, 0 * ONE, a[None], np.array([-1e20]), np.array([-far]), price)), 2, 1)
    assert solution.status is km.Status.OPTIMAL
    np.testing.assert_allclose(solution.v, -a * (p + 2 * quadratic * far) / (1 + 2 * quadratic * a @ a), rtol=1e-6)


def test_limits_are_as_they_were_after_the_wider_second_solve():
    apart = np.vstack([EYE, EYE[:1]])
    solver = DAQP(QP(EYE, -3 * ONE, apart, -np.ones(3), np.ones(3)))
    solver.set_bounds(np.array([-1.0, -1.0, 2.0]), np.array([1.0, 1.0, 3.0]))
    for _ in range(3):
        assert solved(solver, 2, 3).status is km.Status.INFEASIBLE
    solver.set_bounds(-np.ones(3), np.ones(3))
    np.testing.assert_array_equal(solved(solver, 2, 3).v, ONE)


def test_every_end_has_a_status():
    qp = random_qp(np.random.default_rng(0), "hard", 60)
    assert solved(DAQP(qp, {"iter_limit": 3}), 60, 120).status is km.Status.MAX_ITERATIONS
    assert solved(DAQP(qp, {"time_limit": 1e-9}), 60, 120).status is km.Status.TIME_LIMIT
    unbounded = QP(np.diag([1.0, 0.0]), -ONE, EYE[:1], -ONE[:1], ONE[:1])
    assert solved(DAQP(unbounded), 2, 1).status is km.Status.FAILED
    with pytest.raises(km.errors.DataError, match=r"DAQP refuses the problem, exit flag -5; pass a convex QP, P ⪰ 0"):
        DAQP(QP(-EYE, ONE, EYE, -ONE, ONE))


def test_an_answer_that_misses_its_conditions_is_a_failure():
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(8, 8)))[0]
    statuses = set()
    for _ in range(100):  # condition numbers that no explicit inverse of a factor survives
        P = basis * np.logspace(0, -15, 8) @ basis.T
        qp = QP((P + P.T) / 2, rng.normal(size=8), rng.normal(size=(16, 8)), -np.ones(16), np.ones(16))
        solution = solved(DAQP(qp), 8, 16)
        statuses.add(solution.status)
        assert solution.status is not km.Status.OPTIMAL or exactness(qp, solution.v, solution.y) < 1e-5
    assert km.Status.OPTIMAL in statuses


def test_settings_that_daqp_would_swallow():
    with pytest.raises(km.errors.DataError, match=r"DAQP has no setting 'eps_abs'; it has primal_tol, dual_tol,"):
        box(eps_abs=1e-9)
    with pytest.raises(km.errors.DataError, match=r"DAQP's primal_tol is -1; it must be above zero"):
        box(primal_tol=-1.0)
    with pytest.raises(km.errors.DataError, match=r"DAQP's iter_limit is 0; it must be at least 1"):
        box(iter_limit=0)
    with pytest.raises(km.errors.DataError, match=r"DAQP's time_limit holds 1 NaN or inf"):
        box(time_limit=np.nan)
    (line,) = shown(
        """
from koopmpc.control.solvers.base import QP
from koopmpc.control.ask.limits import Softness
from koopmpc.control.solvers.daqp import DAQP
one = np.ones(1)
show(lambda: DAQP(QP(np.eye(1), one, np.eye(1), -one, one), {"iter_limit": 2.5}))
"""
    )
    assert line == "DataError DAQP's iter_limit is 2.5; pass a whole number"
