import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.control.solvers.base import QP
from koopmpc.control.solvers.osqp import OSQP
from tests.bare import shown
from tests.control.kkt import meets_kkt

TIGHT = {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 100_000}


def random_qp(rng, n, m):
    """A QP with a known feasible point, some rows one-sided and some equalities."""
    half = rng.normal(size=(n, n))
    A, inside = rng.normal(size=(m, n)), rng.normal(size=n)
    low = A @ inside - rng.choice([0.0, 0.1, 1.0, np.inf], m)
    high = A @ inside + rng.choice([0.0, 0.1, 1.0, np.inf], m)
    return QP(half @ half.T + 0.1 * np.eye(n), rng.normal(size=n), A, low, high)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 8), m=st.integers(0, 12))
@example(seed=19, n=2, m=6)  # OSQP's own certificate of infeasibility is rounding here, and in the next two
@example(seed=312, n=1, m=7)
@example(seed=732, n=2, m=6)
def test_answers_meet_kkt(seed, n, m):
    rng = np.random.default_rng(seed)
    qp = random_qp(rng, n, m)
    solver = OSQP(qp, TIGHT)
    solution = solver.solve(np.zeros(n), np.zeros(m))
    assert solution.status is km.Status.OPTIMAL
    meets_kkt(qp, solution, 1e-8, 1e-8)
    warm = solver.solve(solution.v, solution.y)
    assert warm.status is km.Status.OPTIMAL
    assert warm.iterations <= solution.iterations
    moved = QP(qp.P, qp.q, qp.A, qp.low - 0.1, qp.high + 0.2)
    solver.set_bounds(moved.low, moved.high)
    solution = solver.solve(warm.v, warm.y)
    assert solution.status is km.Status.OPTIMAL
    meets_kkt(moved, solution, 1e-8, 1e-8)


def box(n=3, **settings):
    return OSQP(QP(np.eye(n), np.ones(n), np.eye(n), -0.5 * np.ones(n), 0.5 * np.ones(n)), settings)


def test_strided_vectors_are_read_as_they_are():
    solver = box()
    low, high = np.array([-0.1, 9, -0.2, 9, -0.3, 9])[::2], np.array([0.1, 9, 0.2, 9, 0.3, 9])[::2]
    solver.set_bounds(low, high)
    start = np.ones(6)[::2]
    solution = solver.solve(start, start)
    assert solution.status is km.Status.OPTIMAL
    np.testing.assert_allclose(solution.v, low, atol=1e-3)


def test_what_osqp_would_swallow_is_refused():
    solver, three = box(), np.ones(3)
    with pytest.raises(km.errors.ShapeError, match=r"the limits have shapes \(2,\) and \(2,\), the QP has 3 rows"):
        solver.set_bounds(-np.ones(2), np.ones(2))
    with pytest.raises(
        km.errors.ShapeError, match=r"the warm start has shapes \(3,\) and \(2,\), the QP is \(3,\), \(3,\)"
    ):
        solver.solve(three, np.ones(2))
    for low, high in (
        (three, -three),
        (np.full(3, np.nan), three),
        (-three, np.full(3, np.nan)),
        (three, -three * np.inf),
    ):
        with pytest.raises(km.errors.DataError, match=r"the limits of the QP cross, hold NaN, or are beyond 1e30"):
            solver.set_bounds(low, high)
    with pytest.raises(km.errors.DataError, match=r"beyond 1e30"):
        solver.set_bounds(-5e30 * three, -4e30 * three)
    solver.set_bounds(-0.25 * three, three)  # and the solver is as good as before
    np.testing.assert_allclose(solver.solve(0 * three, 0 * three).v, -0.25 * three, atol=1e-3)


def test_a_qp_that_does_not_fit_is_refused():
    eye, one = np.eye(2), np.ones(2)
    with pytest.raises(km.errors.DataError, match=r"the QP's q holds 1 NaN or inf, the first at \(1,\)"):
        OSQP(QP(eye, np.array([0, np.nan]), eye, -one, one))
    with pytest.raises(km.errors.DataError, match=r"the QP's low holds NaN; use ±inf"):
        OSQP(QP(eye, one, eye, np.array([0, np.nan]), one))
    with pytest.raises(km.errors.DataError, match=r"the QP's limits cross at index 0: lower 1 is above upper -1"):
        OSQP(QP(eye, one, eye, one, -one))
    lines = shown(
        """
from koopmpc.control.solvers.osqp import OSQP
from koopmpc.control.solvers.base import QP
eye, one = np.eye(2), np.ones(2)
show(lambda: OSQP(QP(eye, one[:1], eye, -one, one)))
show(lambda: OSQP(QP(np.eye(3), one, eye, -one, one)))
show(lambda: OSQP(QP(eye, one, np.ones((2, 3)), -one, one)))
show(lambda: OSQP(QP(eye, one, eye, -one[:1], one)))
show(lambda: OSQP(QP(eye, one, eye, -one, np.ones(3))))
"""
    )
    got = ["q (1,)", "P (3, 3)", "A (2, 3)", "low (1,)", "high (3,)"]
    for line, wrong in zip(lines, got, strict=True):
        assert line.startswith("ShapeError the QP has A (2, ")
        assert wrong in line
        assert line.endswith("; pass A (m, n), P (n, n), q (n,), low and high (m,)")


def test_settings_that_osqp_refuses():
    for settings in ({"eps": 1e-3}, {"rho": -1.0}, {"max_iter": 0}, {"max_iter": "many"}):
        with pytest.raises(km.errors.DataError, match=r"OSQP refuses the problem or its settings \{'"):
            box(**settings)
    with pytest.raises(km.errors.DataError, match=r"OSQP refuses the problem"):
        OSQP(QP(-np.eye(2), np.ones(2), np.eye(2), -np.ones(2), np.ones(2)))


def test_every_end_has_a_status():
    zero = np.zeros(3)
    apart = QP(np.eye(1), np.zeros(1), np.array([[1.0], [1.0]]), np.array([1.0, -3.0]), np.array([3.0, -1.0]))
    infeasible = OSQP(apart).solve(np.zeros(1), np.zeros(2))
    assert infeasible.status is km.Status.INFEASIBLE
    assert box(max_iter=1, check_termination=1).solve(zero, zero).status is km.Status.MAX_ITERATIONS
    slow = random_qp(np.random.default_rng(0), 8, 12)
    hurried = OSQP(slow, {"eps_abs": 1e-300, "eps_rel": 0.0, "max_iter": 10**6, "time_limit": 1e-6})
    assert hurried.solve(np.zeros(8), np.zeros(12)).status is km.Status.TIME_LIMIT
    assert box(eps_abs=float("nan"), max_iter=50).solve(zero, zero).status is km.Status.MAX_ITERATIONS
    unbounded = QP(np.zeros((1, 1)), np.ones(1), np.zeros((1, 1)), -np.ones(1), np.ones(1))
    assert OSQP(unbounded).solve(np.zeros(1), np.zeros(1)).status is km.Status.FAILED
    assert box().solve(np.full(3, np.nan), zero).status is not km.Status.OPTIMAL


def test_a_status_is_never_that_of_the_solve_before():
    qp = random_qp(np.random.default_rng(0), 8, 12)
    start, far = (np.zeros(8), np.zeros(12)), (np.full(8, 1e6), np.full(12, 1e6))
    solver = OSQP(qp, {"max_iter": OSQP(qp).solve(*start).iterations})
    assert solver.solve(*start).status is km.Status.OPTIMAL
    hopeless = solver.solve(*far)
    solver.set_bounds(qp.low, qp.high)
    assert solver.solve(*far).status is hopeless.status is km.Status.MAX_ITERATIONS


def test_the_first_time_limit_leaves_out_the_setup():
    qp = random_qp(np.random.default_rng(0), 60, 120)
    endless = {"eps_abs": 1e-300, "eps_rel": 0.0, "max_iter": 10**7}
    solver, start = OSQP(qp, endless), (np.zeros(60), np.zeros(120))
    first, second = (solver.solve(*start, time_limit=0.01) for _ in range(2))
    assert first.status is second.status is km.Status.TIME_LIMIT
    assert min(first.iterations, second.iterations) > 0


def test_reset_forgets_the_step_size():
    rng = np.random.default_rng(0)
    qp = random_qp(rng, 8, 12)
    solver, start = OSQP(qp, TIGHT), (np.zeros(8), np.zeros(12))
    first = solver.solve(*start)
    solver.reset()
    second = solver.solve(*start)
    np.testing.assert_array_equal(first.v, second.v)
    np.testing.assert_array_equal(first.y, second.y)
    assert first.iterations == second.iterations


def test_a_second_solve_has_what_the_first_one_has_left_of_the_time(monkeypatch):
    """Of an INFEASIBLE without a proof; on a clock that moves by a second when it is read."""
    now, limits = iter(range(100)), []
    monkeypatch.setattr("koopmpc.control.solvers.osqp.perf_counter", lambda: float(next(now)))
    solver, own = box(), OSQP._run

    def never(self, v, y, limit):
        limits.append(limit)
        return replaced(own(self, v, y, limit))

    monkeypatch.setattr(OSQP, "_run", never)
    found = solver.solve(np.zeros(3), np.zeros(3), 10.0)
    assert limits == [10.0, 9.0]
    assert found.status is km.Status.MAX_ITERATIONS  # neither has a certificate
    limits.clear()
    solver.solve(np.zeros(3), np.zeros(3), 0.5)
    assert limits == [0.5, 1e-6]


def replaced(solution):
    solution.status = km.Status.INFEASIBLE
    return solution
