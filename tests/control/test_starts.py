"""Where a BilinearMPC starts, which of several plans it takes, and when its iterations end: against written-down ones."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.nonlinear import real_time_solver
from koopmpc.control.nonlinear.condensed_stages import StageStep
from koopmpc.control.nonlinear.iteration import RealTimeIteration
from tests.control.test_bilinear_mpc import CIRCLE
from tests.control.test_nonlinear_mpc import pendulum
from tests.control.test_staged_mpc import TRACKED
from tests.control.test_staged_mpc import pendulum as learned

OPTIMAL, FAILED, LATE = km.Status.OPTIMAL, km.Status.FAILED, km.Status.TIME_LIMIT
N = 5


@pytest.fixture(autouse=True)
def no_compiler(monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "")


def made(cost=CIRCLE, limits=None, model=None, **options):
    return km.BilinearMPC(model or pendulum(), cost, limits or km.Limits(-1, 1), N, **options)


def start(mpc, x, u_prev, deadline=np.inf):
    """Return where a plan starts from a state, with the targets of the last step."""
    mpc._initial.take(x, np.asarray(u_prev), None, None)
    mpc._step.memory.given = np.asarray(u_prev)
    if mpc._initial.u_prev.size:
        mpc._initial.u_prev[:] = u_prev
    begin = mpc._step._begin(
        np.array([0.2, 0.0] if mpc._step.aim.targets.equilibria.of_state else [0.0, 1.0, 0.0]), 0.0
    )
    return begin._replace(deadline=deadline)


@pytest.mark.parametrize("rated", [False, True])
def test_it_starts_from_rest_the_line_to_the_equilibrium_and_the_free_motion(rated):
    mpc = made(TRACKED if rated else CIRCLE)
    mpc([0.3, 0.1], [0.2, 0.0] if rated else [0, 1, 0])
    end, x, u = mpc._step.aim.end.equilibrium.x, np.array([0.7, -0.2]), np.array([0.4 if rated else 0.0])
    (rest, U), (line, V), (motion, W) = mpc._step.solver._starts(start(mpc, x, [0.4]))
    for inputs in (U, V, W):
        np.testing.assert_array_equal(inputs, np.tile(u, (N, 1)))
    np.testing.assert_array_equal(rest, np.tile(x, (N + 1, 1)))
    np.testing.assert_allclose(line, [x + k / N * (end - x) for k in range(N + 1)], atol=1e-12)
    wanted = [x]
    for _ in range(N):
        wanted.append(mpc.step_map(wanted[-1], u))
    np.testing.assert_allclose(motion, wanted, atol=1e-12)
    model = made(model=learned())
    model([0.3, 0.1], [0, 1, 0])
    assert len(list(model._step.solver._starts(start(model, x, u)))) == 2  # a learned model may invent a motion


@pytest.mark.parametrize("moves", [None, 3])
def test_the_next_step_starts_from_the_plan_moved_on_by_one_step_of_the_model(moves):
    mpc = made(TRACKED, estimator=km.LiftedDisturbance(0.5), moves=moves)
    for x in ([0.3, 0.1], [0.32, 0.08], [0.3, 0.12]):
        mpc(x, [0.2, 0.0])
    before, e = mpc.plan(), mpc._step.e[-1].copy()
    assert np.abs(e).max() > 1e-3
    mpc._step.solver._shift(start(mpc, before.X[0], before.U[0])._replace(e=np.tile(e, (N, 1))))
    X, U = mpc._task.problem.leave(mpc._step.solver.iteration.X, mpc._step.solver.iteration.U, mpc._step.now.inputs)
    wanted = np.vstack([before.U[1:], before.U[-1:]])[mpc._task.problem.held_from[:, 0]]
    np.testing.assert_allclose(U, wanted, atol=1e-12)
    np.testing.assert_allclose(X[:-1], before.X[1:], atol=1e-12)
    np.testing.assert_allclose(X[-1], mpc.step_map(before.X[-1], before.U[-1]) + e, atol=1e-12)


# status, gap and cost of the plans to which three starts lead; how the best one ends once it is improved; what is taken
CHOICES = [
    ([(OPTIMAL, 0.0, 5.0), (OPTIMAL, 0.01, 3.0), (OPTIMAL, 0.0, 4.0)], OPTIMAL, 1, OPTIMAL),
    ([(OPTIMAL, 0.03, 1.0), (OPTIMAL, 0.019, 9.0), (OPTIMAL, 0.021, 2.0)], OPTIMAL, 1, OPTIMAL),
    ([(OPTIMAL, 0.3, 1.0), (OPTIMAL, 0.2, 9.0), (OPTIMAL, 0.25, 0.0)], OPTIMAL, 1, OPTIMAL),
    ([(FAILED, 0.0, 0.0), (FAILED, 0.0, 0.0), (km.Status.SOFTENED, 0.5, 9.0)], OPTIMAL, 2, OPTIMAL),
    ([(OPTIMAL, 0.0, 2.0), (OPTIMAL, 0.0, 2.0), (FAILED, 0.0, 0.0)], FAILED, 0, OPTIMAL),
    ([(km.Status.SOFTENED, 0.0, 2.0), (OPTIMAL, 0.0, 3.0), (FAILED, 0.0, 0.0)], FAILED, 0, km.Status.SOFTENED),
    ([(FAILED, 0.0, 0.0), (km.Status.INFEASIBLE, 0.0, 0.0), (FAILED, 0.0, 0.0)], OPTIMAL, 0, FAILED),
]


@pytest.mark.parametrize(("ends", "polished", "taken", "status"), CHOICES)
def test_of_the_plans_that_follow_the_model_the_cheapest_is_taken(monkeypatch, ends, polished, taken, status):
    mpc, now, asked = made(), {}, []
    solver = mpc._step.solver
    monkeypatch.setattr(RealTimeIteration, "gap", property(lambda _: now["gap"]))
    monkeypatch.setattr(RealTimeIteration, "cost", lambda _: now["cost"])
    monkeypatch.setattr(mpc._step.solver, "_starts", lambda start: [(i, i) for i in range(3)])

    def improve(start, most, settled=real_time_solver.SETTLED, begin=None, until=None):
        asked.append((most, settled, begin))
        if begin is None:
            now["before"] = solver.iteration.X[0, 0]
            solver.iteration.X[:] = 9.0
            solver._iterations += 100
            return polished
        found, now["gap"], now["cost"] = ends[begin[0]]
        mpc._step.solver.iteration.X[:], mpc._step.solver.iteration.U[:], mpc._step.solver.iteration.slack = (
            begin[0],
            begin[0],
            float(begin[0]),
        )
        solver._iterations += 1
        return found

    monkeypatch.setattr(mpc._step.solver, "_improve", improve)
    found = solver._begin_anew(start(mpc, [0.0, 0.0], [0.0]))
    good = any(end[0] not in (FAILED, km.Status.INFEASIBLE) for end in ends)
    assert [each[0] for each in asked] == [12, 12, 12] + [10] * good
    assert {each[1] for each in asked[:3]} == {real_time_solver.EFFORT.nearly}
    assert found is status
    assert solver._iterations == (103 if good else 3)
    if good:
        assert now["before"] == taken
        assert mpc._step.solver.iteration.X[0, 0] == (9.0 if polished is OPTIMAL else taken)
        assert polished is OPTIMAL or (taken == mpc._step.solver.iteration.U).all()
        assert mpc._step.solver.iteration.slack == taken
    asked.clear()
    solver._iterations = 0
    found = solver._begin_anew(start(mpc, [0.0, 0.0], [0.0], -np.inf))  # no time for more than one
    assert len(asked) == 1
    assert found is ends[0][0]
    assert solver._iterations == 1


class Steps:
    """Iterations with the status, length, gap and slack that are written down."""

    def __init__(self, *script, rests=99):
        self.script, self.rested = script, rests
        self.X, self.U, self.count, self.asked = np.zeros((N + 1, 2)), np.zeros((N, 1)), 0, []

    def step(self, s, targets, deadline):
        status, self.length, self.gap, self.slack = self.script[self.count]
        self.count += 1
        return StageStep(self.X[1:], self.U, np.zeros((N, 0)), status, self.count)

    def take(self, s, found):
        self.X += 1.0

    def rests(self, found, settled):
        self.asked.append(settled)
        return self.count >= self.rested


GOOD, HARD = (OPTIMAL, 1.0, 0.0, 0.0), (OPTIMAL, 1.0, 0.0, 0.3)


@pytest.mark.parametrize(
    ("script", "rests", "status", "taken"),
    [
        ([GOOD, GOOD, GOOD], 99, OPTIMAL, 3),
        ([GOOD, GOOD, GOOD], 2, OPTIMAL, 2),
        ([GOOD, GOOD, HARD], 99, km.Status.SOFTENED, 3),
        ([HARD, HARD, GOOD], 99, OPTIMAL, 3),
        ([(LATE, 1.0, 0.0, 0.0)], 99, LATE, 1),
        ([HARD, (LATE, 1.0, 0.0, 0.0)], 99, km.Status.SOFTENED, 2),
        ([GOOD, (FAILED, 1.0, 0.0, 0.0)], 99, FAILED, 2),
        ([GOOD, (OPTIMAL, 0.0, 0.19, 0.0)], 99, OPTIMAL, 2),
        ([(OPTIMAL, 0.0, 0.21, 0.0)], 99, FAILED, 1),
    ],
)
def test_iterations_end_where_the_plan_rests_or_one_of_them_has_no_good_end(script, rests, status, taken):
    mpc = made(sqp_iterations=2)
    mpc([0.1, 0.0], [0, 1, 0])
    mpc._step.solver.iteration = steps = Steps(*script, rests=rests)
    mpc._step.solver._iterations = 0
    found = mpc._step.solver._improve(start(mpc, [0.0, 0.0], [0.0]), 3, 0.5)
    assert found is status
    assert steps.count == taken
    assert mpc._step.solver._iterations == sum(range(1, taken + 1))
    assert set(steps.asked) <= {0.5}
    assert len(steps.asked) == (min(taken, 2) if status is OPTIMAL and len(script) == 3 else len(steps.asked))


def test_iterations_end_at_the_deadline_with_the_plan_so_far():
    mpc = made()
    mpc([0.1, 0.0], [0, 1, 0])
    mpc._step.solver.iteration = steps = Steps(GOOD, GOOD)
    begin = np.full((N + 1, 2), 5.0), np.zeros((N, 1))
    found = mpc._step.solver._improve(start(mpc, [0.0, 0.0], [0.0], -np.inf), 2, begin=begin)
    assert found is OPTIMAL
    assert steps.count == 1
    assert (steps.X == 6.0).all()


def test_a_state_far_from_the_expected_one_begins_anew_and_the_last_plan_goes_on_elsewhere(monkeypatch):
    mpc, anew = made(limits=km.Limits(-1, 1, x_min=[-4, -2], x_max=[4, 2])), []
    own = mpc._step.solver._begin_anew
    monkeypatch.setattr(mpc._step.solver, "_begin_anew", lambda *rest: anew.append(1) or own(*rest))
    mpc([0.1, 0.0], [0, 1, 0])
    assert len(anew) == 1  # there is no plan
    sizes = mpc._task.problem.sizes
    np.testing.assert_array_equal(sizes, [4, 2])
    for share, times in ((2.9, 1), (3.1, 2)):
        expected = mpc.plan().X[1].copy()
        mpc(expected + np.array([0.0, share * sizes[1]]), [0, 1, 0])
        assert len(anew) == times
        mpc.reset()
        mpc([0.1, 0.0], [0, 1, 0])
        anew.pop()


@pytest.mark.parametrize("R_delta", [None, 0.02])
@pytest.mark.parametrize("latency", [0, 2])
@pytest.mark.parametrize("u_target", ["equilibrium", "zero", [[0.1], [-0.2], [0.3]]])
@pytest.mark.parametrize("ahead", [True, False])
def test_what_a_plan_costs_is_the_cost_of_its_states_and_inputs(R_delta, latency, u_target, ahead):
    """Row k of the reference, and of given inputs, belongs to step k from now; the last of both is held."""
    cost = km.Cost(Q=[10, 1], R=0.1, R_delta=R_delta, u_target=u_target, beyond="rest")
    mpc = made(cost, km.Limits(-5, 5), latency=latency)
    rows = np.array([[0.1 * k, 0.0] for k in range(N + 1 + latency)]) if ahead else np.tile([0.2, 0.0], (9, 1))
    mpc.reset(u_prev=[0.4])
    for step in range(3):
        last = 0.4 if step == 0 else mpc._step.memory.given[0]
        move = mpc([0.3, -0.1 + 0.05 * step], rows)
        before = last if not latency else mpc._step.solver.iteration.X[0, 2] if R_delta else 0.0
        plan, R = mpc.plan(), rows[latency : latency + N + 1]
        if isinstance(u_target, str):
            u_r = np.array([target.u for target in mpc._step.aim.targets.find(list(R))[0]])
        else:
            u_r = np.array([u_target[min(k + step + latency, 2)] for k in range(N + 1)])
        total = 0.0
        for k in range(N):
            total += 0.1 * float(((plan.U[k] - u_r[k]) ** 2).sum())
            change = plan.U[k, 0] - (plan.U[k - 1, 0] if k else before)
            total += (R_delta or 0.0) * change**2
            if k:
                total += float((plan.X[k] - R[k]) ** 2 @ [10, 1])
        ((target,), _), x = mpc._step.aim.targets.find([R[-1]]), plan.X[N]
        end = mpc._step.aim.targets.weigh_end(target)
        if ahead and not isinstance(u_target, str):  # a trajectory goes on to no equilibrium: the state alone counts
            total += float((x - R[-1]) ** 2 @ [10, 1])
        else:
            m = end.m if isinstance(u_target, str) else end.m + end.V @ u_r[-1]
            total += float(((end.M @ x + end.L @ x + end.V @ plan.U[-1] - m) ** 2).sum())
        assert mpc._step.solver.iteration.cost() == pytest.approx(total, rel=1e-9)
        assert (move.u == plan.U[0]).all()


@pytest.mark.parametrize("moves", [None, 2])
@pytest.mark.parametrize("rated", [False, True])
def test_a_plan_is_the_same_in_stages_but_for_inputs_that_are_held_or_beyond_their_limits(moves, rated):
    mpc, rng = made(TRACKED if rated else CIRCLE, km.Limits(-1, 1), moves=moves), np.random.default_rng(0)
    problem, box = mpc._task.problem, mpc._step.now.inputs
    X, U, last = rng.standard_normal((N + 1, 2)), rng.standard_normal((N, 1)), np.array([0.3])
    back, inputs = problem.leave(*problem.enter(X, U, last, box), box)
    np.testing.assert_array_equal(back, X)
    held = [0, 1, 2, 3, 4] if moves is None else [0, 1, 1, 1, 1]
    np.testing.assert_allclose(inputs, np.clip(U, -1, 1)[held], atol=1e-12)
    if rated or moves:
        S, V = problem.enter(X, U, last, box)
        np.testing.assert_allclose(S[:, 2], [0.3, *inputs[:, 0]], atol=1e-12)
        np.testing.assert_allclose(V[:, 0], np.diff([0.3, *inputs[:, 0]]), atol=1e-12)
