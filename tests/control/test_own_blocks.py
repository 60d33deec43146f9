"""Move blocking of each input: plans against least squares, against NonlinearMPC, C, and its errors."""

import itertools

import numpy as np
import pytest
import scipy.optimize

import koopmpc as km

STATES, INPUTS = ("a", "b", "c"), ("pump [V]", "valve")
OWN = {"pump": (1, 1, 2, 4), "valve": (2, 6)}
HELD = {"pump [V]": [0, 1, 2, 4, 8], "valve": [0, 2, 8]}


def draw(rng, radius=1.1):
    A = rng.standard_normal((3, 3))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    model = km.LinearPredictor(A, rng.standard_normal((3, 2)), np.eye(3), km.State().bind(STATES), 0.1, STATES, INPUTS)
    Q = rng.uniform(0.1, 2, 3)
    cost = km.Cost(
        Q=Q, R=rng.uniform(0.05, 1, 2), R_delta=rng.uniform(0.01, 0.5, 2), Q_N=np.diag(Q + 1), u_target="zero"
    )
    return model, cost, 2 * rng.standard_normal(3), rng.standard_normal(3)


def residuals(model, cost, x, r, U, last=(0, 0)):
    """The rows whose squares add up to the cost of a plan."""
    rows = []
    for k, u in enumerate(U):
        rows += [np.sqrt(cost.R) * u, np.sqrt(cost.R_delta) * (u - last)]
        x, last = model.A @ x + model.B @ u, u
        rows.append(np.sqrt(np.diagonal(cost.Q_N) if k == len(U) - 1 else cost.Q) * (x - r))
    return np.concatenate(rows)


def spread(v, starts=HELD):
    """The plan of so many free values."""
    columns, at = [], 0
    for ends in starts.values():
        lengths = np.diff(ends)
        columns.append(np.repeat(v[at : at + len(lengths)], lengths))
        at += len(lengths)
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("seed", range(8))
def test_a_plan_with_blocks_of_its_own_is_the_best_one(seed):
    rng = np.random.default_rng(seed)
    model, cost, x, r = draw(rng)
    size = 1e6 if seed % 2 else 0.6
    mpc = km.KoopmanMPC(model, cost, km.Limits(u_min=-size, u_max=size), 8, moves=OWN)
    move = mpc(x, r)
    fixed = residuals(model, cost, x, r, spread(np.zeros(6)))
    M = np.stack([residuals(model, cost, x, r, spread(e)) - fixed for e in np.eye(6)], axis=1)
    best = spread(scipy.optimize.lsq_linear(M, -fixed, (-size, size), tol=1e-14).x)
    U = mpc.plan().U
    np.testing.assert_allclose(U, best, atol=1e-6)
    np.testing.assert_array_equal(move.u, U[0])
    assert move.status is (km.Status.UNCONSTRAINED if seed % 2 else km.Status.OPTIMAL)
    for i, ends in enumerate(HELD.values()):
        for first, end in itertools.pairwise(ends):
            assert len(set(U[first:end, i])) == 1


def test_equal_blocks_by_name_are_the_blocks_of_all():
    model, cost, x, r = draw(np.random.default_rng(0))
    limits = km.Limits(u_min=-0.5, u_max=0.7, du_max=0.4, x_max=1.5)
    for blocks in (3, (1, 1, 6)):
        one = km.KoopmanMPC(model, cost, limits, 8, moves=blocks)
        other = km.KoopmanMPC(model, cost, limits, 8, moves={"pump": blocks, "valve": blocks})
        np.testing.assert_array_equal(one(x, r).u, other(x, r).u)
        assert one.as_data() == other.as_data()


def test_an_input_without_blocks_may_move_at_every_step():
    model, cost, x, r = draw(np.random.default_rng(1))
    one = km.KoopmanMPC(model, cost, km.Limits(), 6, moves={"valve": 1})
    other = km.KoopmanMPC(model, cost, km.Limits(), 6, moves={"valve": 1, "pump": 6})
    np.testing.assert_array_equal(one(x, r).u, other(x, r).u)
    assert len(set(one.plan().U[:, 0])) == 6


def test_nonlinear_mpc_and_the_linear_one_agree_under_all_limits():
    rng = np.random.default_rng(0)
    model, cost, x, r = draw(rng)
    limits = km.Limits(u_min=-0.5, u_max=0.7, du_max=0.4, x_max=1.5)
    linear = km.KoopmanMPC(model, cost, limits, 8, moves=OWN)
    other = km.NonlinearMPC(
        model.step_map(), cost, limits, 8, moves=OWN, solver=km.control.NLP(settings={"ipopt.tol": 1e-10})
    )
    for scale in (1.0, 0.4):
        for mpc in (linear, other):
            mpc.reset()
        linear(scale * x, r), other(scale * x, r)
        np.testing.assert_allclose(other.plan().U, linear.plan().U, atol=1e-6)


def test_levels_keep_the_blocks_of_each_input():
    model, cost, x, r = draw(np.random.default_rng(3))
    limits = km.Limits(levels=[[-1, 0, 1], [-1, 1]])
    mpc = km.KoopmanMPC(model, cost, limits, 8, moves={"pump": (1, 3, 4), "valve": (4, 4)})
    mpc.reset(u_prev=[0, 1])
    mpc(x, r)
    U = mpc.plan().U
    assert set(U[:, 0]) <= {-1.0, 0.0, 1.0}
    assert set(U[:, 1]) <= {-1.0, 1.0}
    assert [len(set(U[a:b, 0])) for a, b in ((0, 1), (1, 4), (4, 8))] == [1, 1, 1]
    assert [len(set(U[a:b, 1])) for a, b in ((0, 4), (4, 8))] == [1, 1]
    ends = {"pump": [0, 1, 4, 8], "valve": [0, 4, 8]}
    costs = [
        (residuals(model, cost, x, r, spread(np.array([*p, *v]), ends), (0, 1)) ** 2).sum()
        for p in np.array(np.meshgrid(*[[-1, 0, 1]] * 3)).reshape(3, -1).T
        for v in np.array(np.meshgrid(*[[-1, 1]] * 2)).reshape(2, -1).T
    ]
    reached = (residuals(model, cost, x, r, U, (0, 1)) ** 2).sum()
    assert reached <= min(costs) * (1 + 1e-9)


def test_loops_and_files_and_c_repeat_it(tmp_path):
    model, cost, x, r = draw(np.random.default_rng(4), radius=0.95)
    mpc = km.KoopmanMPC(
        model, cost, km.Limits(u_min=-0.5, u_max=0.7, du_max=0.4), 8, moves=OWN, estimator=km.LiftedDisturbance()
    )
    mpc.save(tmp_path / "own.npz")
    twins = [km.load_controller(tmp_path / "own.npz"), km.compiled(mpc)]
    for twin, closeness in zip(twins, (0.0, 1e-9), strict=True):
        mpc.reset()
        state = x
        for _ in range(12):
            move, other = mpc(state, r), twin(state, r)
            np.testing.assert_allclose(other.u, move.u, atol=closeness)
            state = model.A @ state + model.B @ move.u


REFUSED = {
    "names 'tap', which is not there": {"tap": 2},
    "sum to 4, the horizon is 8": {"pump": (2, 2)},
    "moves is 9, the horizon 8": {"valve": 9},
    "moves is 0; it must be at least 1": {"valve": 0},
}


@pytest.mark.parametrize("said", REFUSED)
def test_blocks_that_cannot_be_are_refused(said):
    model, cost, *_ = draw(np.random.default_rng(0))
    with pytest.raises(km.errors.DataError, match=said):
        km.KoopmanMPC(model, cost, km.Limits(), 8, moves=REFUSED[said])


def test_bilinear_mpc_says_that_its_inputs_share_their_blocks():
    model, cost, *_ = draw(np.random.default_rng(0))
    with pytest.raises(km.errors.DataError, match="same blocks"):
        km.BilinearMPC(model.step_map(), cost, km.Limits(), 8, moves=OWN)
