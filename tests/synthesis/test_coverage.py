"""Coverage: a tube bounds what errors do, and a margin that is chosen on some loops keeps its promise on others."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.synthesis.loops.margin import check_share, find_tube, most_failures, promise_coverage, propagate_errors
from koopmpc.synthesis.loops.pool import DrawnLoop, LoopPool, LoopResult
from koopmpc.synthesis.task import check_task
from tests.searches import design


def test_no_errors_inside_the_bound_leave_a_tube_and_some_reach_it():
    rng = np.random.default_rng(0)
    for _ in range(20):
        n, steps = int(rng.integers(1, 5)), 12
        A, error = rng.normal(size=(n, n)) / np.sqrt(n), rng.uniform(0.1, 1, n)
        tube = propagate_errors(A, error, steps)
        e = np.zeros((500, n))
        for k in range(steps):
            e = e @ A.T + error * rng.uniform(-1, 1, e.shape)
            assert (np.abs(e) <= tube[k] * (1 + 1e-12)).all()
        for i in range(n):  # the signs that push coordinate i up at the last step
            e = np.zeros(n)
            for k in range(steps):
                e = A @ e + np.sign(np.linalg.matrix_power(A, steps - 1 - k)[i]) * error
            assert e[i] == pytest.approx(tube[-1, i])


def make_task(limit=0.5):
    rng = np.random.default_rng(0)
    A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.005], [0.1]])
    episodes = []
    for _ in range(8):
        X, U = [rng.uniform(-1, 1, 2)], rng.uniform(-2, 2, (30, 1))
        for u in U:
            X.append(A @ X[-1] + B @ u)
        episodes.append(km.Episode(X=np.array(X), U=U))
    data = km.Episodes(episodes, 0.1, ("p", "v"), ("u",))
    limits = km.Limits(u_min=-2, u_max=2, x_max=[np.inf, limit])
    task = check_task(data, km.Cost(Q=[1, 0.1], R=0.01), limits, 10, [0.0, 0.0], None, ())
    return A, B, data, task


def test_the_tube_of_a_design_is_that_of_the_linear_loop_under_its_riccati_feedback():
    A, B, data, task = make_task()
    model, error = km.edmd(data, km.State() + km.Constant()), np.array([0.01, 0.02])
    tube = find_tube(model, task, error, np.zeros(2), np.zeros(1))
    lqr = km.LQR(model, km.Cost(Q=[1, 0.1], R=0.01))
    K = -np.array([lqr([1.0, 0.0], [0, 0]).u, lqr([0.0, 1.0], [0, 0]).u]).T
    assert tube == pytest.approx(propagate_errors(A - B @ K, error, len(tube)), rel=1e-3)
    assert tube[0] == pytest.approx(error)


class MarginAlone(float):
    """A controller of which the pool asks nothing but its margin."""

    dt, nu, horizon = 0.1, 1, 1

    def reset(self, x0=None, u_prev=None): ...

    def __call__(self, y, reference, applied=None, w=None): ...


class DrawnPool(LoopPool):
    """Loops that need a margin of their own, drawn at random, on a share of which no margin helps."""

    def __init__(self, asked, hopeless):
        super().__init__(asked, (), None, asked.low, asked.high)
        object.__setattr__(self, "hopeless", hopeless)

    def draw(self, count, rng):
        needs = np.where(rng.uniform(size=count) < self.hopeless, np.inf, rng.exponential(0.1, count))
        return [DrawnLoop(np.array([need, 0.0]), 0, 1.0, 0, 0) for need in needs]

    def run(self, controller, loops):
        return [LoopResult(1.0 + controller, 0.05 if loop.x0[0] > controller else 0.0) for loop in loops]


def promise(seed, coverage=0.9, loops=60, hopeless=0.0, room=10.0):
    task = make_task()[-1]
    tube = np.array([[0.0, 0.05], [0.0, 0.1]])
    return promise_coverage(
        DrawnPool(task, hopeless),
        lambda limits: MarginAlone(0.0 if limits.margin is None else np.max(limits.margin)),
        tube,
        np.full(2, room),
        coverage,
        loops,
        np.random.default_rng(seed),
    )


def test_the_least_margin_that_holds_is_promised_and_the_promise_is_kept_on_average():
    kept = []
    for seed in range(40):
        found, limits = promise(seed)
        margin = float(np.max(limits.margin))
        kept.append(1 - np.exp(-margin / 0.1))  # the true share of loops that need no more
        assert found.found
        assert found.chosen_failures <= most_failures(60, 0.9)
        assert found.failures == pytest.approx(60 * np.exp(-margin / 0.1), abs=5 * np.sqrt(60 * 0.1) + 1)
    assert np.mean(kept) >= 0.9
    assert np.mean(kept) < 0.985  # and no more than a step of the search is given away


def test_where_no_margin_helps_the_promise_says_so():
    found, _ = promise(0, hopeless=0.5)
    assert not found.found
    assert not found.holds
    assert "no margin keeps the limits in 90 % of loops" in str(found)
    narrow, limits = promise(0, room=0.02)
    assert not narrow.holds
    assert float(np.max(limits.margin)) <= 0.02


def test_where_none_is_needed_there_is_no_margin():
    task = make_task()[-1]
    pool = DrawnPool(task, 0.0)
    found, limits = promise_coverage(
        pool,
        lambda limits: MarginAlone(100.0),
        np.full((2, 2), 0.1),
        np.full(2, 1.0),
        0.95,
        40,
        np.random.default_rng(0),
    )
    assert (found.shape, found.failures, limits.margin) == ("none", 0, None)
    assert found.holds
    assert "without a margin" in str(found)


def test_the_number_of_failures_that_is_allowed_is_that_of_conformal_risk_control():
    assert [most_failures(n, 0.95) for n in (18, 19, 39, 59)] == [-1, 0, 1, 2]
    with pytest.raises(km.errors.DataError, match="needs 19 loops"):
        check_share(0.95, 18)
    with pytest.raises(km.errors.DataError, match="between 0 and 1"):
        km.DesignOptions(margin=1.0)
    rng, missed = np.random.default_rng(0), 0
    for _ in range(4000):  # the least threshold that at most k of 39 values exceed is exceeded by one more of 20
        values = rng.normal(size=40)
        missed += values[-1] > np.sort(values[:-1])[-1 - most_failures(39, 0.95)]
    assert missed / 4000 <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 4000)


@pytest.mark.slow
def test_a_design_with_noise_promises_what_fresh_loops_keep():
    *_, data, _ = make_task()
    rng = np.random.default_rng(1)
    noisy = data.with_episodes([km.Episode(X=e.X + 0.03 * rng.normal(size=e.X.shape), U=e.U) for e in data])
    limits = km.Limits(u_min=-2, u_max=2, x_min=[-np.inf, -0.5], x_max=[np.inf, 0.5])
    task = {"horizon": 10, "reference": [0.0, 0.0], "bilinear": False, "workers": 1}
    made = design(noisy, km.Cost(Q=[1, 0.1], R=0.01), limits, margin=0.9, **task)
    assert made.promise.holds
    assert f"for {made.promise.steps} steps" in str(made.promise)
    assert (made.expected.fresh.violation > 0.01).mean() <= 0.2
