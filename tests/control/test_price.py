"""Prices of inputs: CVXPY's plan, the shift of a target that they are, tariffs that move along, and metrics."""

from dataclasses import replace

import numpy as np
import pytest

import koopmpc as km
from tests.control.models import linear
from tests.control.oracle import targets_of, weighed

N = 10
A, B = np.array([[0.95, 0.2], [-0.1, 0.9]]), np.array([[0.02, 0.1], [0.2, -0.05]])
R = np.array([[0.2, 0.05], [0.05, 0.3]])
LIMITS = km.Limits(u_min=-0.4, u_max=0.6, x_max=[0.7, np.inf], slack=None)
TARIFF = np.column_stack([0.3 * np.sign(np.sin(np.arange(40) / 3)), np.linspace(-0.2, 0.4, 40)])


def cheapest(model, x, rows, price, u_r, limits, q=(0.0, 0.0)):
    """The inputs of least cost, as a program in CVXPY without a tail."""
    import cvxpy as cp

    X, U = cp.Variable((N + 1, 2)), cp.Variable((N, 2))
    held = [X[0] == x, X[1:] == X[:-1] @ model.A.T + U @ model.B.T, U >= -0.4, U <= 0.6, X[1:, 0] <= 0.7]
    error = X[1:] - np.asarray(rows)[1 : N + 1]
    cost = weighed(U - np.array(u_r), [R]) + cp.sum(cp.multiply(price, U)) + cp.sum(X[1:] @ np.array(q))
    cost += 2.0 * cp.sum_squares(error[:, 0]) + 0.1 * cp.sum_squares(error[:, 1])
    cp.Problem(cp.Minimize(cost), held).solve(cp.CLARABEL)
    return U.value


@pytest.mark.parametrize("u_target", ["zero", "equilibrium"])
@pytest.mark.parametrize("kind", [km.KoopmanMPC, km.BilinearMPC, km.NonlinearMPC])
def test_the_plan_is_the_cheapest_and_a_tariff_moves_along(kind, u_target):
    model = linear(A, B)
    cost = km.Cost(Q=[2.0, 0.1], R=R, tail=0, u_target=u_target, price=TARIFF)
    mpc, x = kind(model, cost, LIMITS, N), np.array([0.3, -0.2])
    rows = np.tile([0.4, 0.0], (N + 1, 1))
    statuses = set()
    for k in range(4):
        move = mpc(x, rows)
        statuses.add(move.status)
        u_r = [np.zeros(2)] * N
        if u_target == "equilibrium":
            u_r = [u for _, u in targets_of(model, cost, LIMITS, rows, np.zeros(2), np.eye(2))][:N]
        wanted = cheapest(model, x, rows, TARIFF[k : k + N], u_r, LIMITS)
        np.testing.assert_allclose(mpc.plan().U, wanted, atol=2e-4)
        x = A @ x + B @ move.u
    assert km.Status.OPTIMAL in statuses


@pytest.mark.parametrize("kind", [km.KoopmanMPC, km.BilinearMPC, km.NonlinearMPC])
def test_the_plan_is_the_cheapest_where_outputs_have_prices_too(kind):
    model, q = linear(A, B), np.array([0.3, -0.05])
    cost = km.Cost(Q=[2.0, 0.1], R=R, tail=0, u_target="zero", price=TARIFF, output_price=q)
    mpc, x = kind(model, cost, LIMITS, N), np.array([0.3, -0.2])
    rows = np.tile([0.4, 0.0], (N + 1, 1))
    rows[N // 2 :] = [0.9, 0.1]
    for k in range(3):
        move = mpc(x, rows)
        wanted = cheapest(model, x, rows, TARIFF[k : k + N], [np.zeros(2)] * N, LIMITS, q)
        np.testing.assert_allclose(mpc.plan().U, wanted, atol=2e-4)
        x = A @ x + B @ move.u


@pytest.mark.parametrize("end", [{}, {"Q_N": np.eye(2)}])
@pytest.mark.parametrize("estimator", [None, km.LiftedDisturbance()])
def test_an_output_price_is_a_shift_of_the_reference_but_for_the_input_target(end, estimator):
    """‖y − r‖²_Q + qᵀy = ‖y − r + ½ Q⁻¹ q‖²_Q + const, also in the tail; an end of one's own counts no price."""
    model, q = linear(A, B), np.array([0.3, -0.05])
    pull = -0.5 * q / np.array([2.0, 0.1])
    cost = km.Cost(Q=[2.0, 0.1], R=R, u_target="zero", **end)
    priced = km.KoopmanMPC(model, replace(cost, output_price=q), LIMITS, N, estimator=estimator)
    shifted = km.KoopmanMPC(model, cost, LIMITS, N, estimator=estimator)
    x, statuses = np.array([0.3, -0.2]), set()
    for k in range(6):
        rows = np.tile([0.2 + 0.1 * k, 0.0], (N + 1, 1))
        moved = rows + pull
        if end:
            moved[N] = rows[N]
        a, b = priced(x, rows), shifted(x, moved)
        np.testing.assert_allclose(a.u, b.u, atol=1e-9)
        statuses.add(a.status)
        x = A @ x + B @ a.u
    assert len(statuses) == 2


def test_metrics_and_files_know_the_price_of_an_output(tmp_path):
    model = linear(A, B)
    cost = km.Cost(Q=[2.0, 0.1], R=R, u_target="zero", output_price={"x0": 0.3})
    mpc = km.KoopmanMPC(model, cost, LIMITS, N)
    run = km.simulate(model.step_map(), mpc, x0=[0.3, -0.2], reference=[0.3, 0], steps=20, cost=cost, limits=LIMITS)
    by_hand = sum(
        2.0 * (x[0] - 0.3) ** 2 + 0.1 * x[1] ** 2 + u @ R @ u + 0.3 * x[0]
        for x, u in zip(run.X[1:], run.U, strict=True)
    )
    assert km.metrics(run).cost == pytest.approx(by_hand)
    km.record(run, tmp_path / "run.rrd")
    assert km.load_run(tmp_path / "run.rrd").cost == run.cost
    mpc.save(tmp_path / "mpc.npz")
    other = km.load_controller(tmp_path / "mpc.npz")
    mpc.reset()
    np.testing.assert_array_equal(other([0.3, -0.2], [0.3, 0]).u, mpc([0.3, -0.2], [0.3, 0]).u)


def test_a_price_is_a_shift_of_the_target_to_the_bit_also_in_the_tail():
    """‖u‖²_R + pᵀu = ‖u + ½ R⁻¹ p‖²_R + const, and the tail holds the last row of both."""
    model, p = linear(A, B), np.array([0.1, -0.08])
    shift = -0.5 * np.linalg.solve(R, p)
    priced = km.KoopmanMPC(model, km.Cost(Q=[2, 0.1], R=R, u_target="zero", price=p), LIMITS, N)
    shifted = km.KoopmanMPC(model, km.Cost(Q=[2, 0.1], R=R, u_target=shift), LIMITS, N)
    x = np.array([0.3, -0.2])
    for _ in range(5):
        a, b = priced(x, [0.2, 0.0]), shifted(x, [0.2, 0.0])
        np.testing.assert_allclose(a.u, b.u, atol=1e-12)
        x = A @ x + B @ a.u


def test_metrics_count_the_price_and_a_tariff_saves(tmp_path):
    model = linear(A, B)
    plant = model.step_map()
    with_price = km.Cost(Q=[2.0, 0.1], R=R, u_target="zero", price=TARIFF)
    plain = km.Cost(Q=[2.0, 0.1], R=R, u_target="zero")
    costs = []
    for cost in (with_price, plain):
        mpc = km.KoopmanMPC(model, cost, LIMITS, N)
        run = km.simulate(plant, mpc, x0=[0.3, -0.2], reference=[0.3, 0], steps=30, cost=with_price, limits=LIMITS)
        by_hand = sum(
            2.0 * (x[0] - 0.3) ** 2 + 0.1 * x[1] ** 2 + u @ R @ u + p @ u
            for x, u, p in zip(run.X[1:], run.U, TARIFF, strict=False)
        )
        assert km.metrics(run).cost == pytest.approx(by_hand)
        costs.append(by_hand)
    assert costs[0] < costs[1]
    km.record(run, tmp_path / "run.rrd")
    assert km.load_run(tmp_path / "run.rrd").cost == with_price
    mpc = km.KoopmanMPC(model, with_price, LIMITS, N)
    mpc.save(tmp_path / "mpc.npz")
    assert km.load_controller(tmp_path / "mpc.npz").cost == with_price


def test_prices_by_name_and_what_is_refused():
    model = linear(A, B)
    named = km.Cost(Q=1, R=R, price={"u1": [0.1, 0.2]}).resolve(model.states, model.inputs)
    assert np.array_equal(named.price, [[0, 0.1], [0, 0.2]])
    with pytest.raises(km.errors.DataError, match="R above zero"):
        km.KoopmanMPC(model, km.Cost(Q=[1, 1], R=[1, 0], price=[0, 1]), LIMITS, N)
    with pytest.raises(km.errors.DataError, match="does not know"):
        km.LQR(model, km.Cost(Q=[1, 1], R=R, price=[0, 1]))
    for price in ([np.inf, 0], {"u0": [0, np.nan]}):
        with pytest.raises(km.errors.DataError, match="price holds 1 NaN or inf, the first at"):
            km.Cost(Q=1, R=R, price=price)
    for wrong, said in (
        ({"output_price": [1, 0], "Q": [0, 1]}, "no weight in Q"),
        ({"output_price": [1, 0, 0]}, "output_price has shape"),
        ({"output_price": [[1, 0]]}, "a number for each tracked output"),
        ({"output_price": {"x7": 1}}, "x7"),
    ):
        with pytest.raises((km.errors.DataError, km.errors.ShapeError), match=said):
            km.KoopmanMPC(model, km.Cost(**{"Q": [1, 1], "R": R, **wrong}), LIMITS, N)
    with pytest.raises(km.errors.DataError, match="paid back by Q"):
        km.Cost(Q=1, R=R, Q_rows=[[1, 1]], output_price=[1, 0])
    with pytest.raises(km.errors.DataError, match="does not know"):
        km.LQR(model, km.Cost(Q=[1, 1], R=R, output_price=[0, 1]))
    with pytest.raises(km.errors.DataError, match="price"):
        km.BilinearMPC(model, km.Cost(Q=[1, 1], R=R, price=[0, 1]), LIMITS, N).build_program(None)
