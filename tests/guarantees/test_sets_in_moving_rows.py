"""Terminal sets beside limits in time: what lies inside every later row is taken, and plans stay feasible."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.ask.terminal import measure_reach
from tests.guarantees.test_terminal_set import draw_model, make_cart

ROWS = 30
NORMAL = (km.Status.OPTIMAL, km.Status.UNCONSTRAINED)


def draw_task(seed, kind):
    """Return a random model, a cost, rows of limits, a set inside the tightest of them, and a horizon."""
    rng = np.random.default_rng(seed)
    model = draw_model(rng)
    n, nu = model.nx, model.nu
    cost = km.Cost(Q=rng.uniform(0.1, 2, n), R=rng.uniform(0.05, 1, nu))
    x_max = rng.uniform(1, 3, n) + np.abs(rng.normal(size=(ROWS, n))) * rng.uniform(0, 1)
    u_max = rng.uniform(0.6, 1, nu) + rng.uniform(0, 0.5, (ROWS, nu))
    rates = {"du_max": rng.uniform(0.5, 1)} if rng.uniform() < 0.4 else {}
    tight = km.Limits(u_min=-1, u_max=u_max.min(axis=0), x_max=x_max.min(axis=0), **rates)
    try:
        end = km.guarantees.find_terminal_set(model, cost, tight, np.zeros(n), kind=kind)
    except km.errors.CertificateError:  # a slow loop whose polytope does not end
        return None
    limits = km.Limits(-1, u_max, x_max=x_max, slack=None, terminal=end, terminal_slack=None, **rates)
    return model, cost, limits, int(rng.integers(3, 8)), rng


def hold_rows(rows, k, count):
    return rows[np.minimum(np.arange(k, k + count), ROWS - 1)]


def run_loops(seed, kind, at_call, starts, steps=36):
    """Return loops that are feasible at first, later ones without a plan, and plans that leave their rows or the set."""
    task = draw_task(seed, kind)
    if task is None:
        return 0, 0, 0
    model, cost, limits, N, rng = task
    mpc = km.KoopmanMPC(model, cost, limits.at(0) if at_call else limits, horizon=N)
    feasible = lost = left = 0
    for _ in range(starts):
        x = rng.normal(size=model.nx) * rng.uniform(0.2, 2)
        mpc.reset(u_prev=np.zeros(model.nu))
        for k in range(steps):
            u_rows, x_rows = hold_rows(limits.u_max, k, N + 2), hold_rows(limits.x_max, k, N + 2)
            now = mpc.limits.with_bounds(u_max=u_rows, x_max=x_rows) if at_call else None
            move = mpc(x, np.zeros(model.nx), limits=now)
            if move.status not in NORMAL:
                lost += k > 0
                break
            feasible += k == 0
            plan, end = mpc.plan(), limits.terminal
            xi = np.append(plan.X[-1], plan.U[-1]) if end.with_input else plan.X[-1]
            over = max(np.max(plan.X[1:] - x_rows[1 : N + 1]), np.max(plan.U - u_rows[:N]), end.measure(xi) - 1)
            left += over > 1e-6
            x = model.A @ x + model.B @ move.u
    return feasible, lost, left


@pytest.mark.parametrize("at_call", [False, True])
@pytest.mark.parametrize("kind", ["polytope", "ellipsoid"])
def test_what_is_feasible_once_stays_so_under_rows_that_hold_the_set(kind, at_call):
    feasible, lost, left = np.sum([run_loops(seed, kind, at_call, 2) for seed in range(4)], axis=0)
    assert feasible >= 4
    assert (lost, left) == (0, 0)


@pytest.mark.slow
def test_hundreds_of_loops_stay_feasible_under_moving_rows():
    for kind in ("polytope", "ellipsoid"):
        feasible, lost, left = np.sum([run_loops(seed, kind, seed % 2 > 0, 10) for seed in range(100, 140)], axis=0)
        assert feasible >= 200
        assert (lost, left) == (0, 0)


def test_a_set_that_leaves_a_later_row_is_refused_and_earlier_rows_do_not_count(tmp_path):
    model, cost, box = make_cart(), km.Cost(Q=1, R=0.1), {"u_min": -1, "u_max": 1}
    end = km.guarantees.find_terminal_set(model, cost, km.Limits(**box, x_max=[2, 0.5]), [0.0, 0.0])
    rows = np.tile([2.0, 0.5], (12, 1))
    rows[3, 1] = 0.2  # within the first plan: later states are not limited by it
    kept = km.Limits(**box, x_max=rows, terminal=end)
    mpc = km.KoopmanMPC(model, cost, kept, horizon=4)
    same = km.compiled(mpc)
    x = np.array([-1.0, 0.0])
    for _ in range(8):
        a, b = mpc(x, [0.0, 0.0]), same(x, [0.0, 0.0])
        assert a.status is b.status
        assert a.u == pytest.approx(b.u, abs=1e-7)
        x = model.A @ x + model.B @ a.u
    rows[9, 1] = 0.2
    words = r"reaches x1 = 0.5 and the state and output limit of row 9 is 0.2, .* tightest limits of these rows"
    with pytest.raises(km.errors.DataError, match=words):
        km.KoopmanMPC(model, cost, km.Limits(**box, x_max=rows, terminal=end), horizon=4)
    narrow = {"u_min": -1, "u_max": np.full((9, 1), 0.9)}
    with pytest.raises(km.errors.DataError, match=r"the input limit of row 4 is 0\.9"):
        km.KoopmanMPC(model, cost, km.Limits(**narrow, terminal=end), horizon=4)
    plain = km.guarantees.TerminalSet([0.0, 0.0], W=np.eye(2))  # without a feedback
    assert km.KoopmanMPC(model, cost, km.Limits(**box, x_max=1 + rows, terminal=plain), horizon=4)(x, [0, 0])
    with pytest.raises(km.errors.DataError, match="does not tell the input of its feedback"):
        km.KoopmanMPC(model, cost, km.Limits(**narrow, terminal=plain), horizon=4)


def test_a_set_of_some_states_reaches_any_value_of_the_others():
    model, cost, box = make_cart(), km.Cost(Q=1, R=0.1), {"u_min": -1, "u_max": 1}
    some = km.guarantees.TerminalSet([0.0], H=[[2.0], [-2.0]], h=[1, 1], of=km.State("x1"))
    rows = np.tile([np.inf, 0.6], (8, 1))
    mpc = km.KoopmanMPC(model, cost, km.Limits(**box, x_max=rows, terminal=some, rows=("x_max",)), horizon=3)
    assert mpc([-0.1, 0.0], [0.0, 0.0]).status in NORMAL
    with pytest.raises(km.errors.DataError, match=r"reaches x1 = 0\.5 and .* limit of row 3 is 0\.49999,"):
        mpc([-0.1, 0.0], [0.0, 0.0], limits=mpc.limits.with_bounds(x_max=[*rows[:3], [np.inf, 0.49999]]))
    rows[:, 0] = 2.0
    with pytest.raises(km.errors.DataError, match="reaches x0 = inf and the state and output limit of row 4 is 2,"):
        km.KoopmanMPC(model, cost, km.Limits(**box, x_max=rows, terminal=some), horizon=3)


def test_an_ellipsoid_needs_a_cost_to_go_that_grows_in_every_direction():
    limits = km.Limits(u_min=-1, u_max=1, du_max=0.5)
    with pytest.raises(km.errors.DataError, match="weigh every state, and every input whose rate is limited"):
        km.guarantees.find_terminal_set(make_cart(), km.Cost(Q=1, R=0), limits, [0.0, 0.0], kind="ellipsoid")


@pytest.mark.parametrize("kind", ["polytope", "ellipsoid"])
def test_the_reach_of_a_set_is_that_of_its_points(kind):
    model, rng = make_cart(), np.random.default_rng(0)
    cost, limits = km.Cost(Q=1, R=0.1), km.Limits(u_min=-1, u_max=1, x_max=[2, 0.5], x_min=-3, du_max=0.8)
    end = km.guarantees.find_terminal_set(model, cost, limits, [0.3, 0.0], kind=kind)
    G = rng.normal(size=(3, 2))
    reach = measure_reach(end, np.eye(2), G, None)
    spread = np.linalg.norm(np.linalg.pinv(end.rows), axis=0).sum()
    ways = rng.normal(size=(40_000, 3)) * spread
    points = end.center + ways / np.maximum(end.measure(end.center + ways), 1e-9)[:, None]  # on the edge
    values = points[:, :2] @ G.T
    inputs = end.feedback.u + (points - end.center) @ end.feedback.K.T
    for seen, bound in ((values, reach.outputs), (inputs, reach.inputs), (inputs - points[:, 2:], reach.rates)):
        width = bound.high - bound.low
        assert (seen <= bound.high + 1e-9).all()
        assert (seen >= bound.low - 1e-9).all()
        assert (seen.max(axis=0) >= bound.high - 0.05 * width).all()
