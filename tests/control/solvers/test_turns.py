"""Which solver is asked for the QP of a step, from where, with which limits and how much time: scripted solvers."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.ask.limits import Interval, Softness
from koopmpc.control.solvers.base import QPSolution, SolverTurn, StepQP, StepSolver

OPTIMAL, FAILED, MOST = km.Status.OPTIMAL, km.Status.FAILED, km.Status.MAX_ITERATIONS
INFEASIBLE = km.Status.INFEASIBLE


def step_qp(linear=(np.inf, np.inf, 4.0), source=(1, 2, 3)) -> StepQP:
    """Return a QP of two variables: two hard rows, the first of which limits a change, and a soft one."""
    linear = np.array(linear)
    return StepQP(
        P=np.eye(2),
        q=np.zeros(2),
        A=np.array([[1.0, 0.0], [0.0, 2.0], [1.0, 1.0]]),
        low=np.array([-1.0, -2.0, -3.0]),
        high=np.array([1.5, 2.5, 3.5]),
        softness=Softness(linear, np.zeros(3), np.array([0.0, 0.0, 0.1])),
        source=np.array(source),
        scale=np.array([0.5, 1.0, 2.0]),
        shift_primal=np.array([1, 2]),
        shift_dual=np.array([1, 3, 0]),
        rate_rows=np.array([0]),
        rate_inputs=np.array([0]),
    )


def scripted(name: str, is_exact: bool, *answers: tuple):
    """Return a kind of solver that gives these (status, v, y, iterations), and the list of what it is asked."""
    asked, left = [], list(answers)

    class Scripted:
        exact, resumes = is_exact, False

        def __init__(self, qp, settings):
            asked.append(("made", settings))

        def shift(self, moved):
            asked.append(("shift", moved.tolist()))

        def set_bounds(self, low, high):
            asked.append(("bounds", low.tolist(), high.tolist()))

        def solve(self, v, y, time):
            asked.append(("solve", v.tolist(), y.tolist(), time))
            status, x, multipliers, iterations = left.pop(0)
            return QPSolution(np.array(x, float), np.array(multipliers, float), status, iterations, name)

        def resume(self, time):
            asked.append(("resume", time))
            return QPSolution(np.ones(2), np.zeros(3), OPTIMAL, 1, name)

        def reset(self):
            asked.append(("reset",))

        def update(self, qp):
            asked.append(("update",))

    return Scripted, asked


GOOD, NONE = (OPTIMAL, [3, 4], [0, 0, 1], 5), (MOST, [0, 0], [0, 0, 0], 7)
PLAN = np.array([9.0, 2.0, -1.0, 0.5, 9.0])


@pytest.mark.parametrize("source", [(1, 2, 3), (3, 1, 2)])
def test_the_limits_move_by_the_plan_and_the_start_is_the_last_answer_moved_on_by_a_step(source):
    first, asked = scripted("first", True, GOOD, GOOD, GOOD, GOOD)
    solver = StepSolver(step_qp(source=source), [SolverTurn(first, {"a": 1})])
    moved = (PLAN[list(source)] * [0.5, 1.0, 2.0]).tolist()
    found, gave_way = solver.solve(PLAN, None, None)
    assert (found.status, gave_way) == (OPTIMAL, 0.0)
    assert asked == [("made", {"a": 1}), ("shift", moved), ("solve", [0, 0], [0, 0, 0], None)]
    solver.solve(PLAN, None, None)
    assert asked[-1] == ("solve", [4, 0], [0, 0, 0], None)  # one past the end stands for zero
    solver.cool()
    solver.solve(PLAN, None, None)
    assert asked[-1] == ("solve", [0, 0], [0, 0, 0], None)
    solver.first.resumes = True
    solver.solve(PLAN, None, None)
    assert asked[-1] == ("resume", None)
    solver.reset()
    assert asked[-1] == ("reset",)
    solver.update(step_qp())
    assert asked[-1] == ("update",)


def test_the_second_is_set_up_and_asked_where_the_first_one_has_no_answer():
    first, a = scripted("first", False, GOOD, NONE, GOOD)
    second, b = scripted("second", True, GOOD)
    solver = StepSolver(step_qp(), [SolverTurn(first, {}), SolverTurn(second, {})])
    found = [solver.solve(PLAN, None, None)[0] for _ in range(3)]
    assert [(each.solver, each.iterations) for each in found] == [("first", 5), ("second", 12), ("first", 5)]
    assert sum(each[0] == "solve" for each in a) == 3
    assert [each[0] for each in b] == ["made", "shift", "solve"]


def test_where_nobody_has_the_answer_the_last_one_says_why():
    first, _ = scripted("first", False, NONE, NONE)
    second, b = scripted("second", True, (FAILED, [0, 0], [0, 0, 0], 20), GOOD)
    solver = StepSolver(step_qp(), [SolverTurn(first, {}), SolverTurn(second, {})])
    found, _ = solver.solve(PLAN, None, None)
    assert (found.status, found.solver, found.iterations) == (FAILED, "second", 27)
    solver.solve(PLAN, None, None)
    assert b[-1] == ("solve", [0, 0], [0, 0, 0], None)  # nothing is left to start from
    inexact, _ = scripted("inexact", False, (OPTIMAL, [1, 1], [0, 0, 9], 100))  # a multiplier above a slack's price
    found, _ = StepSolver(step_qp(), [SolverTurn(inexact, {})]).solve(PLAN, None, None)
    assert (found.status, found.solver) == (FAILED, "inexact")


@pytest.mark.parametrize(("multiplier", "is_exact", "answers"), [(4.0, False, True), (-4.0, False, True), (4.1, False, False), (-4.1, False, False), (4.1, True, True)])  # fmt: skip
def test_one_that_knows_no_slacks_has_the_answer_where_no_multiplier_is_above_its_price(multiplier, is_exact, answers):
    first, _ = scripted("first", is_exact, (OPTIMAL, [0, 0], [0, 0, multiplier], 1))
    second, _ = scripted("second", True, GOOD)
    found, _ = StepSolver(step_qp(), [SolverTurn(first, {}), SolverTurn(second, {})]).solve(PLAN, None, None)
    assert found.solver == ("first" if answers else "second")
    hard = step_qp(linear=[np.inf] * 3)
    first, _ = scripted("first", is_exact, (OPTIMAL, [0, 0], [0, 0, multiplier], 1))
    found, _ = StepSolver(hard, [SolverTurn(first, {}), SolverTurn(second, {})]).solve(PLAN, None, None)
    assert found.solver == "first"


@pytest.mark.parametrize(("is_exact", "who"), [(True, "first"), (False, "second")])
def test_infeasible_is_believed_of_an_exact_one_alone(is_exact, who):
    first, _ = scripted("first", is_exact, (INFEASIBLE, [0, 0], [0, 0, 0], 1))
    second, _ = scripted("second", True, (INFEASIBLE, [0, 0], [0, 0, 0], 2))
    found, _ = StepSolver(step_qp(), [SolverTurn(first, {}), SolverTurn(second, {})]).solve(PLAN, None, None)
    assert (found.status, found.solver) == (INFEASIBLE, who)


def test_time_is_left_for_what_follows(monkeypatch):
    """The first of several has half of the time where it may leave the rest to others; 50 µs are for the rest."""
    clock = [100.0]
    monkeypatch.setattr("koopmpc.control.solvers.base.perf_counter", lambda: clock[0])
    for is_exact, share in ((False, 0.5), (True, 1.0)):
        first, a = scripted("first", is_exact, NONE, GOOD)
        second, b = scripted("second", True, GOOD)
        solver = StepSolver(step_qp(), [SolverTurn(first, {}), SolverTurn(second, {})])
        solver.solve(PLAN, None, 100.01)
        assert a[-1][-1] == pytest.approx(share * 0.01 - 5e-5)
        assert b[-1][-1] == pytest.approx(0.01 - 5e-5)
        solver.solve(PLAN, None, 100.00002)
        assert a[-1][-1] == pytest.approx(share * 1e-5)
    first, _ = scripted("first", False, NONE)
    second, b = scripted("second", True, GOOD)
    found, _ = StepSolver(step_qp(), [SolverTurn(first, {}), SolverTurn(second, {})]).solve(PLAN, None, 100.0)
    assert (found.status, found.solver, found.iterations) == (km.Status.TIME_LIMIT, "first", 7)
    assert b == []


@pytest.mark.parametrize(("multiplier", "share"), [(4.0, 1), (-4.0, 1), (3.9, 0), (0.0, 0)])
def test_what_a_soft_limit_gives_way_is_told_in_its_unit_above_its_allowance(multiplier, share):
    """The row s (p + D w) is limited, s = 2."""
    moved = 2.0 * PLAN[3]
    for v, past in (([3.0, 1.0], (4.0 + moved - 3.5) / 2), ([-4.0, -1.0], (-3.0 + 5.0 - moved) / 2), ([0.0, 0.5], 0.0)):
        first, _ = scripted("first", True, (OPTIMAL, v, [0, 0, multiplier], 1))
        _, gave_way = StepSolver(step_qp(), [SolverTurn(first, {})]).solve(PLAN, None, None)
        assert gave_way == pytest.approx(share * past)
    just = (3.5 - moved + 2 * 0.1 * np.array([0.99, 1.01]))[:, None] * [1.0, 0.0]
    for v, told in zip(just, (False, True), strict=True):
        first, _ = scripted("first", True, (OPTIMAL, v, [0, 0, 4.0], 1))
        _, gave_way = StepSolver(step_qp(), [SolverTurn(first, {})]).solve(PLAN, None, None)
        assert (gave_way > 0) == told


@pytest.mark.parametrize(
    ("room", "low", "high", "conflict"),
    [((-9, 9), -1, 1.5, 0), ((-9, -3), -1.5, 1.5, 1.0), ((4, 9), -1, 2.0, 1.0), ((-1, 1), -1, 1.5, 0)],
)
def test_the_first_change_may_be_as_large_as_the_limits_of_the_inputs_need(room, low, high, conflict):
    """−1 ≤ 0.5 (u − u_last) ≤ 1.5 gives way to u inside its limits, which are `room` from the last input.

    It is told where it is more than a hundred-thousandth of what is told of a soft limit.
    """
    for allowance, told in ((5e4, 1), (2e5, 0)):
        qp, (free, _) = step_qp(), scripted("first", True, (OPTIMAL, [0, 0], [0, 0, 0], 1))
        qp.softness.allowance[0] = allowance
        solver = StepSolver(qp, [SolverTurn(free, {})])
        _, gave_way = solver.solve(PLAN, Interval(np.array([room[0]]), np.array([room[1]])), None)
        assert gave_way == pytest.approx(told * conflict)
    first, asked = scripted("first", True, (OPTIMAL, [0, 0], [0, 0, 0], 1))
    solver = StepSolver(step_qp(), [SolverTurn(first, {})])
    _, gave_way = solver.solve(PLAN, Interval(np.array([room[0]]), np.array([room[1]])), None)
    moved = PLAN[1:4] * [0.5, 1.0, 2.0]
    (bounds,) = (each for each in asked if each[0] == "bounds")
    np.testing.assert_allclose(bounds[1], [low, -2, -3] - moved)
    np.testing.assert_allclose(bounds[2], [high, 2.5, 3.5] - moved)
    assert gave_way == pytest.approx(conflict)
