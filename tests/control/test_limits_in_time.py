"""Limits in time: constant rows change nothing, moving ones give CVXPY's plan, and the present row is always kept."""

import copy

import numpy as np
import pytest
from scipy.signal import StateSpace

import koopmpc as km
from tests.control.models import PRECISE, Told, linear
from tests.control.oracle import oracle

N, T = 8, 30
A, B = np.array([[1.02, 0.2], [-0.1, 0.95]]), np.array([[0.02, 0.1], [0.2, -0.05]])
COST = km.Cost(Q=[2, 0.5], R=[0.1, 0.2])


def constant(limits, steps=40):
    """The same limits, each bound as so many equal rows."""
    ends = {name: getattr(limits, name) for name in ("u_min", "u_max", "x_min", "x_max", "du_min", "du_max")}
    return limits.with_bounds(
        **{name: np.tile(np.atleast_1d(end), (steps, 1)) for name, end in ends.items() if end is not None}
    )


def moving_limits(seed, *, rates=None, slack=(50.0, 5.0)):
    """Limits that wander from row to row, by less than the rates allow."""
    rng = np.random.default_rng(seed)
    t = np.arange(T + N + 2)[:, None] + rng.uniform(0, 9, size=2)
    u_max = 0.5 + 0.25 * np.sin(t / 2)
    x_max = 0.7 + 0.3 * np.cos(t / 3)
    if rates is not None:
        rates = rates + 0.1 * np.cos(t)
    return km.Limits(u_min=-u_max - 0.1, u_max=u_max, x_min=-0.8, x_max=x_max, du_max=rates, slack=slack)


def wander(mpc, model, reference, steps, seed=3, **more):
    """The moves of a noisy closed loop."""
    rng, x, moves = np.random.default_rng(seed), np.array([0.6, -0.4]), []
    mpc.reset(x)
    for k in range(steps):
        rows = reference[k : k + N + 4] if reference.ndim == 2 else reference
        move = mpc(x, rows, **{name: value(k) for name, value in more.items()})
        moves.append(move)
        x = model.A @ x + model.B @ move.u + 0.02 * rng.normal(size=2)
    return moves


REFERENCES = {
    "held": np.array([0.4, 0.0]),
    "beyond the limits": np.array([2.0, -2.0]),
    "moving": np.column_stack([0.9 * np.sin(np.arange(80) / 4), np.zeros(80)]),
}


@pytest.mark.parametrize("reference", REFERENCES.values(), ids=REFERENCES)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"moves": (1, 2, 5)},
        {"moves": {"u0": (2, 6), "u1": (1, 3, 4)}},
        {"latency": 1},
        {"estimator": Told([0.02, -0.05])},
        {"solver": "osqp"},
    ],
    ids=["plain", "blocks", "own blocks", "latency", "estimator", "osqp"],
)
def test_constant_rows_give_the_same_inputs_to_the_bit(options, reference):
    model = linear(A, B)
    own = km.Limits(u_min=-0.6, u_max=[0.5, 0.6], du_max=0.3, x_max=[0.7, np.inf])
    plain = wander(km.KoopmanMPC(model, COST, own, N, **options), model, reference, 25)
    rows = wander(km.KoopmanMPC(model, COST, constant(own), N, **options), model, reference, 25)
    called = wander(
        km.KoopmanMPC(model, COST, own, N, **options),
        model,
        reference,
        25,
        limits=lambda k: constant(own) if k % 3 else None,
    )
    for a, b, c in zip(plain, rows, called, strict=True):
        assert np.array_equal(a.u, b.u)
        assert np.array_equal(a.u, c.u)
        assert (
            (a.status, a.slack, a.iterations) == (b.status, b.slack, b.iterations) == (c.status, c.slack, c.iterations)
        )
    assert {m.status for m in plain} & {km.Status.OPTIMAL, km.Status.SOFTENED}


@pytest.mark.parametrize(
    ("rates", "slack", "blocks"),
    [
        pytest.param(0.3, (50.0, 5.0), None, id="soft"),
        pytest.param(None, (50.0, 5.0), None, id="without rates", marks=pytest.mark.slow),
        pytest.param(0.3, (50.0, 5.0), (1, 2, 5), id="blocks", marks=pytest.mark.slow),
        pytest.param(0.3, None, None, id="hard", marks=pytest.mark.slow),
    ],
)
def test_moving_rows_give_the_plan_of_cvxpy(rates, slack, blocks):
    """At each step of a loop the plan is the optimum within the rows from this step on."""
    model, limits = linear(A, B), moving_limits(2, rates=rates, slack=slack)
    mpc = km.KoopmanMPC(model, COST, limits, N, moves=blocks, settings=PRECISE | {})
    reference, x, u, seen = REFERENCES["moving"], np.array([0.5, -0.3]), np.zeros(2), []
    mpc.reset(x, u_prev=u)
    for k in range(8):
        rows = reference[k : k + N + 1]
        move = mpc(x, rows)
        now = limits.with_bounds(**{end: getattr(limits, end)[k:] for end in limits.count_rows()})
        found = oracle(model, COST, now, x, rows, u_prev=u, blocks=blocks)
        if found is None:
            assert move.status is km.Status.INFEASIBLE
        else:
            plan = mpc.plan()
            assert plan is not None
            np.testing.assert_allclose(plan.U, found[0], atol=2e-5)
            seen.append(move.status)
        box = limits.at(k).inputs(2)
        assert (move.u == np.clip(move.u, *box)).all()
        u, x = move.u, A @ x + B @ move.u
    assert km.Status.OPTIMAL in seen or km.Status.SOFTENED in seen


def test_rows_at_a_call_are_those_of_a_controller_in_that_step():
    model, limits = linear(A, B), moving_limits(5, rates=0.4)
    own = km.KoopmanMPC(model, COST, limits, N)
    other = km.KoopmanMPC(model, COST, limits.base, N)
    rows = {end: getattr(limits, end) for end in limits.count_rows()}
    a = wander(own, model, REFERENCES["moving"], 20)
    b = wander(
        other,
        model,
        REFERENCES["moving"],
        20,
        limits=lambda k: other.limits.with_bounds(**{end: value[k:] for end, value in rows.items()}),
    )
    assert all(np.array_equal(m.u, n.u) for m, n in zip(a, b, strict=True))
    assert len({m.status for m in a}) > 1
    after, plain = other([0.5, 0.2], [0, 0]), km.KoopmanMPC(model, COST, limits.base, N)
    plain.reset(u_prev=b[-1].u)
    assert np.allclose(after.u, plain([0.5, 0.2], [0, 0]).u, atol=1e-12)  # the next call has its own limits again


def test_a_limit_that_falls_faster_than_its_rate_wins_and_the_step_says_so():
    """du_max is 0.1, the box of step 3 ends 0.5 below that of step 2: the plan is solved, and reported as SOFTENED."""
    model = linear(A, B)
    u_max = np.full((N + 5, 2), 1.0)
    u_max[3:] = -0.4
    mpc = km.KoopmanMPC(model, COST, km.Limits(u_min=-1, u_max=u_max, du_max=0.1), N)
    x = np.array([-1.0, -1.0])
    mpc.reset(x, u_prev=[0.9, 0.9])
    inputs = []
    for k in range(6):
        move = mpc(x, [2.0, 2.0])
        inputs.append(move.u)
        assert move.status in {km.Status.SOFTENED, km.Status.OPTIMAL}, move
        assert (move.u <= u_max[k] + 1e-12).all()
        x = A @ x + B @ move.u
    changes = np.diff(np.vstack([[0.9, 0.9], *inputs]), axis=0)
    assert (np.abs(np.delete(changes, 3, axis=0)) <= 0.1 + 1e-7).all()  # every other change keeps its rate


def test_inputs_with_blocks_of_their_own_keep_the_rows_of_all_steps_in_which_they_are_held():
    model, limits = linear(A, B), moving_limits(4, rates=0.3)
    mpc = km.KoopmanMPC(model, COST, limits, N, moves={"u0": (2, 6), "u1": (1, 3, 4)})
    x, solved = np.array([0.6, -0.4]), 0
    for k in range(T):
        move, plan = mpc(x, [1.5, -1.0]), mpc.plan()
        if plan is not None:
            box = limits.input_rows(2, k, N)
            assert (box.low - 1e-9 <= plan.U).all()
            assert (box.high + 1e-9 >= plan.U).all()
            assert np.ptp(plan.U[:2, 0]) == np.ptp(plan.U[1:4, 1]) == 0
            solved += move.status in {km.Status.OPTIMAL, km.Status.SOFTENED}
        x = A @ x + B @ move.u
    assert solved > 5


def test_a_failed_step_keeps_the_row_of_its_step():
    model = linear(A, B)
    u_max = np.linspace(1.0, 0.05, T)[:, None] * np.ones(2)
    mpc = km.KoopmanMPC(model, COST, km.Limits(u_min=-u_max, u_max=u_max), N)
    x = np.array([-2.0, -2.0])
    for k in range(T):
        mpc.solver_fails = k % 3 > 0
        move = mpc(x if k % 5 else [np.nan, 0.0], [2.0, 2.0])
        assert (np.abs(move.u) <= u_max[k] + 1e-12).all()
    mpc.reset()
    assert (np.abs(mpc(x, [2.0, 2.0]).u) <= u_max[0]).all()


def test_copies_files_and_update_go_on_from_the_same_row(tmp_path):
    model, limits = linear(A, B), moving_limits(8)
    mpc = km.KoopmanMPC(model, COST, limits, N)
    x = np.array([0.7, 0.5])
    for _ in range(4):
        mpc(x, [0.4, 0.2])
    twin = copy.copy(mpc)
    mpc.update(model)
    a, b = mpc(x, [0.4, 0.2]), twin(x, [0.4, 0.2])
    np.testing.assert_allclose(a.u, b.u, atol=1e-9)
    mpc.save(tmp_path / "mpc.npz")
    again = km.load_controller(tmp_path / "mpc.npz")
    mpc.reset()
    assert np.array_equal(mpc(x, [0.4, 0.2]).u, again(x, [0.4, 0.2]).u)


def test_a_declared_bound_may_come_at_a_call():
    model = linear(A, B)
    own = km.Limits(u_min=-1, u_max=1, rows=("x_max",), slack=(1e3, 10.0))
    mpc, x, rows = km.KoopmanMPC(model, COST, own, N), np.array([0.3, 0.1]), np.tile([0.6, 0.0], (N + 1, 1))
    free = km.KoopmanMPC(model, COST, km.Limits(u_min=-1, u_max=1), N)
    assert np.allclose(mpc(x, rows).u, free(x, rows).u, atol=1e-9)
    mpc.reset()
    now = own.with_bounds(x_max=[0.4, np.inf])
    move, found = mpc(x, rows, limits=now), oracle(model, COST, now, x, rows)
    np.testing.assert_allclose(move.u, found[0][0], atol=1e-5)
    assert not np.allclose(move.u, free(x, rows).u, atol=1e-3)


def test_bad_rows_are_refused_in_sentences_that_name_row_and_step():
    model, good = linear(A, B), km.Limits(u_min=-1, u_max=1)
    mpc = km.KoopmanMPC(model, COST, good, N)
    falling = np.ones((12, 2))
    falling[7, 1] = -2.0
    with pytest.raises(km.errors.DataError, match="input limits cross for index 1 at step 7"):
        km.Limits(u_min=-1, u_max=falling)
    with pytest.raises(km.errors.ShapeError, match="u_max has 5 rows, the plan reads rows 0 … 7, and row 5 is missing"):
        mpc([0, 0], [0, 0], limits=good.with_bounds(u_max=np.ones((5, 2))))
    x_max = np.full((12, 2), np.inf)
    x_max[3, 0] = 1.0
    with pytest.raises(km.errors.DataError, match=r"x_max limits x0 at step 3.*rows=\(\"x_max\",\)"):
        mpc([0, 0], [0, 0], limits=good.with_bounds(x_max=x_max))
    with pytest.raises(km.errors.DataError, match="another slack"):
        mpc([0, 0], [0, 0], limits=km.Limits(u_min=-1, u_max=1, slack=None))
    with pytest.raises(km.errors.DataError, match="another levels"):
        mpc([0, 0], [0, 0], limits=km.Limits(u_min=-1, u_max=1, levels=[[-1, 1], None]))
    with pytest.raises(km.errors.DataError, match="another priority"):
        mpc([0, 0], [0, 0], limits=km.Limits(u_min=-1, u_max=1, priority={"x0": 1}))
    with pytest.raises(km.errors.DataError, match="no bound v_max"):
        good.with_bounds(v_max=3)
    with pytest.raises(km.errors.DataError, match="pass a tuple of u_min"):
        km.Limits(rows=("theta",))
    low, high = np.tile([-1.0], (12, 1)), np.tile([-0.5], (12, 1))
    low[4:], high[4:] = 0.0, 0.5
    with pytest.raises(km.errors.DataError, match="within a block of 7 held steps"):
        km.KoopmanMPC(model, COST, km.Limits(u_min=low, u_max=high), N, moves=(1, 7))
    with pytest.raises(km.errors.DataError, match="cross for"):
        km.LQR(model, COST, km.Limits(u_min=-1, u_max=falling - 3))
    assert mpc([0.1, 0], [0, 0]).status.value < 4  # a refused call leaves the controller as it was


@pytest.mark.parametrize("rates", [{}, {"du_max": np.linspace(0.1, 0.3, 5)[:, None]}])
def test_laws_without_a_plan_clip_each_input_to_the_row_of_its_step(rates):
    high = np.array([[0.6], [0.5], [0.4], [0.1], [0.3], [0.7]])
    limits = km.Limits(u_min=-1, u_max=high, **rates)
    model = km.LinearPredictor.from_state_space(StateSpace([[1.0]], [[0.1]], [[1.0]], [[0.0]], dt=0.1))
    cost = km.Cost(Q=1, R=0.01)
    for law in (km.LQR(model, cost, limits), km.control.PID(9.0, dt=0.1, limits=limits)):
        free = km.LQR(model, cost) if isinstance(law, km.LQR) else km.control.PID(9.0, dt=0.1)
        for _ in range(2):  # a reset begins at the first row
            law.reset()
            last = 0.0
            for k in range(9):
                change = float(rates["du_max"][min(k, 4), 0]) if rates else np.inf
                wished = float(free([0.0], [1.0]).u[0])
                u = float(law([0.0], [1.0]).u[0])
                assert u == min(np.clip(wished, last - change, last + change), high[min(k, 5), 0])
                last = u
    with pytest.raises(km.errors.DataError, match="rows in time"):
        km.compiled(km.LQR(model, cost, limits))


def test_limits_by_name_that_cross_name_signal_and_step():
    rows = np.repeat([2.0, 1.0], 10)
    for ends, said in (
        ({"u_min": {"u1": 1.5}, "u_max": {"u1": rows}}, "input limits cross for u1 at step 10: lower 1.5 is above"),
        ({"x_min": {"x1": 1.5}, "x_max": {"x1": 1.0}}, "state limits cross for x1: lower 1.5 is above upper 1"),
    ):
        with pytest.raises(km.errors.DataError, match=said):
            km.KoopmanMPC(linear(A, B), COST, km.Limits(**ends), N)


def test_limits_by_name_may_have_a_value_a_step():
    limits = km.Limits(u_max={"pump": [1.0, 0.5, 0.2]}, x_max={"b": 2.0}).resolve(
        ("a [K]", "b [K]"), ("fan", "pump [V]")
    )
    assert np.array_equal(limits.u_max, [[np.inf, 1.0], [np.inf, 0.5], [np.inf, 0.2]])
    assert np.array_equal(limits.x_max, [np.inf, 2.0])
    assert np.array_equal(limits.at(9).u_max, [np.inf, 0.2])
    assert np.array_equal(limits.base.u_max, [np.inf, 1.0])


def test_levels_keep_to_those_inside_the_rows_and_maintenance_stops_a_pump():
    """A pump on levels that may not run in steps 6 to 9: plan, fallback and dwell times obey the row."""
    model = linear(A, B)
    u_max = np.array([[1.0, 0.5]] * T)
    u_max[6:10, 0] = 0.3
    limits = km.Limits(u_min=[0, -0.5], u_max=u_max, levels=[[0, 0.5, 1], None], dwell=[(2, 2), None])
    mpc = km.KoopmanMPC(model, COST, limits, N)
    x, seen = np.array([-0.8, -0.5]), set()
    for k in range(14):
        mpc.solver_fails = k in (7, 11)
        move = mpc(x, [0.6, 0.4])
        seen.add(move.u[0])
        assert move.u[0] in (0.0, 0.5, 1.0)
        assert (move.u <= u_max[k]).all()
        x = A @ x + B @ move.u
    assert len(seen) > 1
    constant_rows, moves = np.tile([1.0, 0.5], (T, 1)), {"u0": (2, 6), "u1": (1, 3, 4)}
    own, rows = (
        [move.u for move in wander(km.KoopmanMPC(model, COST, each, N, moves=moves), model, np.array([0.6, 0.4]), 10)]
        for each in (limits.with_bounds(u_max=[1.0, 0.5]), limits.with_bounds(u_max=constant_rows))
    )
    np.testing.assert_array_equal(own, rows)
    u_max[8, 0], low = 0.4, np.zeros((T, 2))
    low[8, 0] = 0.1
    with pytest.raises(km.errors.DataError, match=r"no level of u0 is between its limits 0\.1 … 0\.4 at step 8"):
        km.KoopmanMPC(model, COST, limits.with_bounds(u_min=low, u_max=u_max), N)
    for kind in (km.BilinearMPC, km.NonlinearMPC):
        with pytest.raises(km.errors.DataError, match=r"no level of u0 is between its limits 0\.1 … 0\.4 at step 8"):
            kind(model, COST, limits.with_bounds(u_min=low, u_max=u_max), N)


@pytest.mark.slow
def test_random_loops_with_rows_levels_prices_and_failures_keep_every_limit():
    """0 exceptions, 0 inputs outside the row of their step, 0 between levels."""
    solved = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        nx, nu, steps, horizon = int(rng.integers(1, 4)), int(rng.integers(1, 3)), 30, int(rng.integers(3, 12))
        A = rng.normal(size=(nx, nx))
        A *= rng.uniform(0.5, 1.08) / np.abs(np.linalg.eigvals(A)).max()
        model = linear(A, rng.normal(size=(nx, nu)))

        def walk(centre, reach, n, rng=rng, steps=steps):
            return np.repeat(rng.uniform(centre - reach, centre + reach, (steps, n)), 4, axis=0)[: steps + 20]

        ends = {"u_min": -walk(1.0, 0.7, nu), "u_max": walk(1.0, 0.7, nu), "x_max": walk(1.5, 1.2, nx)}
        levels = rng.random() < 0.3
        if levels:
            ends["u_min"] = np.minimum(ends["u_min"], -0.01)
        elif rng.random() < 0.5:
            ends["du_max"] = walk(0.5, 0.4, nu)
        rows = km.Limits(**ends, **({"levels": [[-2, -1, 0, 1, 2], *[None] * (nu - 1)]} if levels else {}))
        options = {"latency": int(rng.random() < 0.3), "moves": int(rng.integers(1, horizon + 1))}
        mpc = km.KoopmanMPC(model, km.Cost(Q=1.0, R=0.1, price=walk(0.0, 0.3, nu)), rows, horizon, **options)
        x, reference = rng.normal(size=nx), rng.normal(size=nx)
        mpc.reset(x)
        for k in range(steps):
            mpc.solver_fails = rng.random() < 0.1
            move = mpc(x + (np.nan if rng.random() < 0.03 else 0.0), reference)
            low, high = rows.input_rows(nu, k + options["latency"], 1)
            np.testing.assert_allclose(move.u, np.clip(move.u, low[0], high[0]), atol=1e-9)
            assert not levels or abs(move.u[0] - round(move.u[0])) < 1e-9
            solved += move.fallback is km.control.Fallback.NONE
            x = np.clip(A @ x + model.B @ move.u + 0.02 * rng.normal(size=nx), -1e4, 1e4)
    assert solved > 1000


def test_a_controller_in_words_says_its_widest_limits_and_that_they_move():
    mpc = km.KoopmanMPC(linear(A, B), COST, km.Limits(u_min=-1, u_max=[[0.5, 0.6], [0.7, 0.2]]), N)
    assert "u0 ≤ 0.7" in repr(mpc)
    assert "rows in time" in repr(mpc)


@pytest.mark.parametrize("seed", range(4))
def test_further_calls_with_new_limits_are_those_of_a_controller_that_meets_them_first(seed):
    """A second call takes over numbers alone: the same inputs and statuses, and the same sentences."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2, 2))
    model = km.LinearPredictor(
        A / np.abs(np.linalg.eigvals(A)).max(), np.eye(2), np.eye(2), km.State(), 0.1, ("a", "b"), ("u", "v")
    )
    limits = km.Limits(
        u_min=-1, u_max=1, x_max=[1.0, np.inf], of=km.State("b"), y_max=0.8, **[{}, {"du_max": 0.4}][seed % 2]
    )
    old, x, statuses = km.KoopmanMPC(model, km.Cost(Q=1.0, R=0.1), limits, 4), rng.normal(size=2), set()
    for k in range(8):
        wave = 0.7 + 0.4 * np.sin(k + np.arange(5 + k % 2)[:, None] * rng.uniform(0.3, 1, 2))
        ends = {
            "u_max": wave,
            "u_min": -wave[:, :1],
            "x_max": np.where([True, k == 7], wave, np.inf),
            "y_max": 0.1 * k + 0.3,
        }
        if seed % 2:
            ends["du_max"] = 0.5 * wave
        own = limits.with_bounds(**{end: ends[end] for end in ends if rng.random() < 0.7 or k == 7})
        r = np.round(0.3 * rng.normal(size=2), 1) if k % 3 else 0.3 * np.sin(k + np.arange(10).reshape(5, 2))
        fresh = km.KoopmanMPC(model, km.Cost(Q=1.0, R=0.1), limits, 4)
        fresh.reset(u_prev=np.zeros(2) if k == 0 else move.u)
        if k == 7:
            for each in (old, fresh):
                with pytest.raises(km.errors.DataError, match="x_max limits b at step 0"):
                    each(x, r, limits=own)
            break
        move, first = old(x, r, limits=own), fresh(x, r, limits=own)
        np.testing.assert_allclose(move.u, first.u, rtol=0, atol=1e-9)
        assert move.status is first.status
        statuses.add(move.status)
        x = model.A @ x + move.u
    assert km.Status.UNCONSTRAINED in statuses or seed % 2
