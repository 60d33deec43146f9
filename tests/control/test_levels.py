"""On/off and stepped inputs: plans against enumeration, levels and dwell times in random loops, and their errors."""

import copy
import itertools

import numpy as np
import pytest

import koopmpc as km
import koopmpc.control.solvers.levels
import koopmpc.control.solvers.sequences

OFF = 1e-9  # an input is on its level to this


def draw_model(rng, nu):
    """A random stable linear model of three states."""
    A = rng.standard_normal((3, 3))
    A *= rng.uniform(0.5, 1.05) / np.abs(np.linalg.eigvals(A)).max()
    states, inputs = ("a", "b", "c"), tuple(f"u{i}" for i in range(nu))
    return km.LinearPredictor(A, rng.standard_normal((3, nu)), np.eye(3), km.State().bind(states), 0.1, states, inputs)


def keeps_dwell(index, start, steps, least_on, least_off):
    """Whether a sequence of levels, after `steps` steps at `start`, holds each for its least time; to the end counts."""
    level, held = start, steps
    for each in index:
        if each != level:
            if held < (least_off if level == 0 else least_on):
                return False
            level, held = each, 0
        held += 1
    return True


def cost_of(model, cost, limits, x, r, before, U):
    """The cost of input sequences (K, N, nu), from its definition."""
    X = np.tile(x, (len(U), 1))
    total, last = np.zeros(len(U)), np.tile(before, (len(U), 1))
    target = np.asarray(cost.u_target)
    N = U.shape[1]
    for k in range(N):
        u = U[:, k]
        total += ((u - target) ** 2 * cost.R).sum(axis=1) + ((u - last) ** 2 * cost.R_delta).sum(axis=1)
        X = X @ model.A.T + u @ model.B.T
        weight = cost.Q_N if k == N - 1 else cost.Q
        total += ((X - r) ** 2 * np.diagonal(weight) if np.ndim(weight) == 2 else (X - r) ** 2 * weight).sum(axis=1)
        slack = np.maximum(X - limits.x_max, 0)
        total += (limits.slack[0] * slack + limits.slack[1] * slack**2).sum(axis=1)
        last = u
    return total


def compare_with_enumeration(rng, nu, N):
    """Solve a random case and all of its sequences; return the case's cost and the least one."""
    model = draw_model(rng, nu)
    counts = [2] * nu if nu * N > 6 or rng.random() < 0.5 else [3] * nu
    rows = [np.round(rng.uniform(-1, 1), 2) + np.round(rng.uniform(0.3, 2), 2) * np.arange(c) for c in counts]
    on, off = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    dwell = [(on, off) if c == 2 else (on, on) for c in counts]
    Q = rng.uniform(0, 2, 3)
    cost = km.Cost(
        Q=Q,
        R=rng.uniform(0.01, 1, nu),
        R_delta=rng.uniform(0.01, 0.5, nu),
        Q_N=np.diag(Q + 1),
        u_target=[rng.uniform(row[0], row[-1]) for row in rows],
    )
    limits = km.Limits(levels=rows, dwell=dwell, x_max=rng.uniform(0.2, 1.5, 3), slack=(3.0, 5.0))
    mpc = km.KoopmanMPC(model, cost, limits, N)
    x, r = 2 * rng.standard_normal(3), rng.standard_normal(3)
    start = [int(rng.integers(0, c)) for c in counts]
    before = np.array([row[i] for row, i in zip(rows, start, strict=True)])
    mpc.reset(u_prev=before)
    steps = [10**6] * nu
    for _ in range(2):
        move = mpc(x, r)
        assert move.status in (km.Status.OPTIMAL, km.Status.SOFTENED, km.Status.UNCONSTRAINED)
        singles = [
            [s for s in itertools.product(range(c), repeat=N) if keeps_dwell(s, start[i], steps[i], *dwell[i])]
            for i, c in enumerate(counts)
        ]
        grids = np.meshgrid(*[np.arange(len(s)) for s in singles], indexing="ij")
        parts = [rows[i][np.array(singles[i])[grids[i].ravel()]] for i in range(nu)]
        costs = cost_of(model, cost, limits, x, r, before, np.stack(parts, axis=-1))
        plan = mpc.plan().U
        reached = cost_of(model, cost, limits, x, r, before, plan[None])[0]
        np.testing.assert_array_equal(move.u, plan[0])
        index = [[int(np.abs(rows[i] - v).argmin()) for v in plan[:, i]] for i in range(nu)]
        for i in range(nu):
            np.testing.assert_allclose(rows[i][index[i]], plan[:, i], atol=OFF)
            assert keeps_dwell(index[i], start[i], steps[i], *dwell[i])
        assert reached <= costs.min() * (1 + 1e-8) + 1e-10
        x, before = model.A @ x + model.B @ move.u + 0.3 * rng.standard_normal(3), move.u
        for i in range(nu):
            steps[i] = 1 if index[i][0] != start[i] else steps[i] + 1
            start[i] = index[i][0]


@pytest.mark.parametrize("seed", range(15))
def test_plans_are_the_best_of_all_sequences(seed):
    rng = np.random.default_rng(seed)
    compare_with_enumeration(rng, *[(1, 7), (2, 3), (1, 8)][seed % 3])


@pytest.mark.slow
@pytest.mark.parametrize("block", range(20))
def test_a_thousand_plans_are_the_best_of_all_sequences(block):
    for seed in range(50):
        rng = np.random.default_rng([1, block, seed])
        compare_with_enumeration(rng, *[(1, 10), (2, 5), (3, 3), (1, 6)][seed % 4])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_plans_of_twenty_binaries_are_the_best_of_all_sequences(seed):
    compare_with_enumeration(np.random.default_rng([2, seed]), 2, 10)


@pytest.mark.parametrize("seed", range(12))
def test_quadratic_programs_and_sequences_find_the_same_plans(seed, monkeypatch):
    rng = np.random.default_rng([4, seed])
    nu = int(rng.integers(1, 3))
    limits = {"levels": [[0, 1, 2], [0, 1]][:nu], "x_max": rng.uniform(0.3, 2, 3)}
    if seed % 3 == 0:
        limits["dwell"] = [2, 3][:nu]
    if seed % 4 == 1:
        limits["du_max"] = [1, 1][:nu]
    if seed % 4 == 2:
        limits |= {"slack": None, "x_max": rng.uniform(3, 6, 3)}
    moves = [None, 4, {"u0": (1, 1, 2, 2)}][seed % 3]
    model, cost, limits = draw_model(rng, nu), km.Cost(Q=1.0, R=0.05, R_delta=0.02), km.Limits(**limits)
    by_sequences, by_programs = (km.KoopmanMPC(model, cost, limits, 6, moves=moves) for _ in range(2))
    monkeypatch.setattr(by_programs._step.solver.qps, "_sequences", None)
    assert by_sequences._step.solver.qps._sequences is not None
    x, statuses = rng.standard_normal(3), set()
    for _ in range(12):
        one, other = (mpc(x, np.ones(3)) for mpc in (by_sequences, by_programs))
        assert (one.status, one.gap) == (other.status, 0)
        statuses.add(one.status)
        if one.status in (km.Status.OPTIMAL, km.Status.SOFTENED):
            np.testing.assert_array_equal(by_sequences.plan().U, by_programs.plan().U)
            assert one.slack == pytest.approx(other.slack, rel=1e-6, abs=1e-9)
        x = model.A @ x + model.B @ one.u + 0.3 * rng.standard_normal(3)
    assert statuses & {km.Status.OPTIMAL, km.Status.SOFTENED}


TANK = km.LinearPredictor([[0.9]], [[0.2]], np.eye(1), km.State().bind(("level",)), 1.0, ("level",), ("pump",))
COST = km.Cost(Q=1.0, R=0.0, R_delta=0.01)


def drive(mpc, limits, seed, steps=25, break_at=()):
    """Run a random model with random noise, NaN, and failures of the solver; return the inputs and the moves."""
    rng = np.random.default_rng(seed)
    model = mpc.predictor
    x, U, moves = rng.standard_normal(model.nz), [], []
    for k in range(steps):
        mpc.solver_fails = k in break_at
        y = np.full_like(x, np.nan) if rng.random() < 0.05 else x
        move = mpc(y, np.zeros_like(x), None if rng.random() < 0.7 or not U else U[-1])
        U.append(move.u)
        moves.append(move)
        x = np.clip(model.A @ x + model.B @ move.u + 0.1 * rng.standard_normal(len(x)), -1e3, 1e3)
    return np.array(U), moves


def draw_controller(rng, nu):
    model, N = draw_model(rng, nu), int(rng.integers(1, 9))
    counts = rng.integers(2, 5, nu)
    rows = [rng.uniform(-1, 0) + rng.uniform(0.3, 1) * np.arange(c) for c in counts]
    if nu > 1 and rng.random() < 0.5:
        rows[-1] = None
    limits = {"levels": rows, "u_min": np.full(nu, -3.0), "u_max": np.full(nu, 4.0)}
    if rng.random() < 0.6:
        pairs = [(int(rng.integers(1, 5)), int(rng.integers(1, 5))) for _ in range(nu)]
        limits["dwell"] = [
            None if row is None else pair if len(row) == 2 else pair[0] for row, pair in zip(rows, pairs, strict=True)
        ]
    if rng.random() < 0.4:
        limits["du_max"] = [
            rng.uniform(0.5, 1) if row is None else (row[1] - row[0]) * rng.uniform(1, 2) for row in rows
        ]
    if rng.random() < 0.5:
        limits["x_max"] = rng.uniform(0.3, 2, 3)
    if rng.random() < 0.3:
        limits["level_steps"] = int(rng.integers(1, N + 1))
    options = {"latency": int(rng.random() < 0.2), "moves": int(rng.integers(1, N + 1)) if rng.random() < 0.3 else None}
    if rng.random() < 0.3:
        options["estimator"] = km.LiftedDisturbance()
    if rng.random() < 0.2:
        options["time_limit"] = 1e-4
    limits = km.Limits(**limits)
    return km.KoopmanMPC(model, km.Cost(Q=1.0, R=0.05, R_delta=0.02), limits, N, **options), limits


def run_random_loop(seed):
    """Every input of a loop is on its levels, keeps its dwell times, its limits, and the rates of its limits."""
    rng = np.random.default_rng([3, seed])
    nu = int(rng.integers(1, 3))
    mpc, limits = draw_controller(rng, nu)
    U, moves = drive(mpc, limits, seed, break_at=rng.integers(0, 25, 4))
    off, early = limits.input_levels(nu).count_broken(U)
    assert (off, early) == (0, 0)
    low, high = limits.inputs(nu)
    assert (low <= U).all()
    assert (high >= U).all()
    rates = limits.rates(nu)
    if rates is not None:
        assert (np.abs(np.diff(U, axis=0)) <= rates.high + 1e-9).all()
    assert all(np.isfinite(move.gap) and 0 <= move.gap <= 1 for move in moves)
    return [move.status for move in moves]


def test_random_loops_stay_on_levels_through_every_failure():
    statuses = [status for seed in range(10) for status in run_random_loop(seed)]
    assert {km.Status.OPTIMAL, km.Status.FAILED, km.Status.BAD_MEASUREMENT} <= set(statuses)


@pytest.mark.slow
@pytest.mark.parametrize("block", range(10))
def test_a_thousand_random_loops_stay_on_levels(block):
    for seed in range(100 + 96 * block, 196 + 96 * block):
        run_random_loop(seed)


def test_a_fallback_is_rounded_and_keeps_the_dwell_time():
    mpc = km.KoopmanMPC(TANK, COST, km.Limits(levels=[[0, 1]], dwell=[4]), 5)
    assert mpc([0.0], [2.0]).u == 1
    mpc.solver_fails = True
    for _ in range(3):  # the level is far above, and the pump would stop
        move = mpc([50.0], [0.0])
        assert (move.u, move.status) == (1, km.Status.FAILED)
    assert [float(mpc([50.0], [0.0]).u[0]) for _ in range(4)][-1] == 0


def test_without_time_for_a_plan_the_input_is_held():
    mpc = km.KoopmanMPC(TANK, COST, km.Limits(levels=[[0, 1]]), 30, time_limit=1e-9)
    for last in (0.0, 1.0):
        mpc.reset(u_prev=[last])
        move = mpc([1.0], [1.3])
        assert (move.u, move.status, move.fallback) == (last, km.Status.TIME_LIMIT, km.control.Fallback.HOLD)


def test_the_gap_of_a_search_that_is_cut_off_bounds_what_its_plan_misses(monkeypatch):
    rng, seen = np.random.default_rng(3), 0
    limits = km.Limits(levels=[[-1, 1]], x_max=1e6, slack=(3.0, 5.0))
    for _ in range(12):
        model = draw_model(rng, 1)
        cost = km.Cost(Q=np.ones(3), R=np.ones(1), R_delta=np.full(1, 0.1), Q_N=np.eye(3), u_target=[0.0])
        free = km.KoopmanMPC(model, cost, km.Limits(), 9)
        best, cut = (km.KoopmanMPC(model, cost, limits, 9) for _ in range(2))
        x, r, costs = 2 * rng.standard_normal(3), np.zeros(3), []
        for mpc in (free, best, cut):
            monkeypatch.setattr(koopmpc.control.solvers.levels, "NODES", 36 if mpc is cut else 200_000)
            monkeypatch.setattr(koopmpc.control.solvers.sequences, "WIDTH", 2 if mpc is cut else 128)
            mpc.reset(u_prev=[-1.0])
            move = mpc(x, r)
            if move.fallback is km.control.Fallback.NONE:
                costs.append(cost_of(model, cost, limits, x, r, np.array([-1.0]), mpc.plan().U[None])[0])
        if len(costs) == 3:
            missed = (costs[2] - costs[1]) / (costs[2] - costs[0])
            assert -1e-9 <= missed <= move.gap + 1e-9
            seen += move.gap > 0
            assert (move.status is km.Status.TIME_LIMIT) == (move.gap > 0)
        else:
            assert move.status is km.Status.MAX_ITERATIONS
    assert seen > 1


def test_levels_of_the_first_steps_alone_leave_later_ones_between():
    limits = km.Limits(levels=[[0, 1]], level_steps=2)
    mpc = km.KoopmanMPC(TANK, km.Cost(Q=1.0, R=0.0), limits, 6)
    mpc([0.9], [0.9])
    U = mpc.plan().U[:, 0]
    assert set(U[:2]) <= {0.0, 1.0}
    assert ((U[2:] > 0.01) & (U[2:] < 0.99)).any()


def test_no_dwell_time_of_an_earlier_run_counts_after_a_reset():
    mpc = km.KoopmanMPC(TANK, COST, km.Limits(levels=[[0, 1]], dwell=[4]), 5)
    first = mpc([0.0], [2.0]).u
    assert first == 1
    mpc.reset()
    mpc.solver_fails = True
    assert mpc([np.nan], [2.0]).u == 0  # held from zero, not from the pump that ran


def test_levels_by_name_are_those_by_order():
    by_name = km.Limits(levels={"pump": [0, 1]}, dwell={"pump": (3, 2)})
    by_order = km.Limits(levels=[[0, 1]], dwell=[(3, 2)])
    a, b = (km.KoopmanMPC(TANK, COST, limits, 6) for limits in (by_name, by_order))
    for y in ([0.2], [1.5], [0.4]):
        np.testing.assert_array_equal(a(y, [1.0]).u, b(y, [1.0]).u)


def test_copies_and_files_keep_levels_and_repeat_to_the_bit(tmp_path):
    mpc = km.KoopmanMPC(TANK, COST, km.Limits(levels=[[0, 1, 2]], dwell=[2]), 5)
    mpc.save(tmp_path / "mpc.npz")
    twin = km.load_controller(tmp_path / "mpc.npz")
    assert twin.limits == mpc.limits
    runs = [drive(each, mpc.limits, 5)[0] for each in (mpc, twin)]
    np.testing.assert_array_equal(*runs)
    copied = copy.copy(mpc)
    np.testing.assert_array_equal(copied([0.3], [1.0]).u, mpc([0.3], [1.0]).u)
    mpc.reset()
    np.testing.assert_array_equal(drive(mpc, mpc.limits, 5)[0], runs[0])


def test_metrics_measure_the_distance_from_the_nearest_level():
    plant = km.discretize(km.load_problem("pendulum").dynamics, 0.05)
    run = km.simulate(
        plant, lambda y, r: [0.4], x0=[0, 0], reference=[0, 0], steps=3, limits=km.Limits(levels=[[0, 1]])
    )
    assert km.metrics(run).input_violation == pytest.approx(0.4)
    assert km.metrics(run).early_changes == 0


def test_metrics_count_changes_before_their_dwell_time():
    plant = km.discretize(km.load_problem("pendulum").dynamics, 0.05)
    inputs = iter([0.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0])  # on for 2 of 3 steps, off for 1 of 2
    limits = km.Limits(levels=[[0, 1]], dwell=[(3, 2)])
    run = km.simulate(plant, lambda y, r: [next(inputs)], x0=[0, 0], reference=[0, 0], steps=8, limits=limits)
    assert km.metrics(run).early_changes == 2
    assert "changes before dwell" in str(km.metrics(run))


def test_levels_by_name_have_the_box_of_their_ends():
    limits = km.Limits(levels={"pump": [0, 1]})
    assert limits.resolve(("level",), ("pump",)).inputs(1) == (0, 1)


def test_a_station_rounds_whoever_acts():
    mpc = km.KoopmanMPC(TANK, COST, km.Limits(levels=[[0, 1]]), 5)
    station = km.supervise.Station(
        mpc, lambda y, r: r - y, limits=km.Limits(levels=[[0, 1]], dwell=[3]), mode="manual", hand=[0.7]
    )
    rng, U, last = np.random.default_rng(0), [], None
    for k in range(60):
        station.switch(("manual", "automatic", "standby")[k // 5 % 3])
        last = station(rng.uniform(0, 2, 1), [1.0], last).u
        U.append(last)
    assert station.limits.input_levels(1).count_broken(np.array(U)) == (0, 0)
    assert len(set(np.ravel(U))) == 2


REFUSED = {
    "two or more": {"levels": [[1]]},
    "evenly spaced": {"levels": [[0, 1, 3]]},
    "evenly spaced ones from": {"levels": [[1, 0]]},
    "pass them by name": {"levels": "on"},
    "one list for each input": {"levels": [0, 1]},
    "between its limits": {"levels": [[0, 1]], "u_min": 2, "u_max": 3},
    "may change by": {"levels": [[0, 2]], "du_max": 1.5},
    "dwell time of input 0": {"levels": [[0, 1]], "dwell": [0]},
    "pass steps by name": {"levels": [[0, 1]], "dwell": "3"},
    "one time for all": {"levels": [[0, 1, 2]], "dwell": [(2, 3)]},
    "pass levels, or leave": {"dwell": [3]},
    "entries, the plant 1": {"levels": [[0, 1], [0, 1]]},
    "level_steps": {"levels": [[0, 1]], "level_steps": 0},
    "has a dwell time and no levels": {"levels": [None], "dwell": [2]},
    "tap": {"levels": {"tap": [0, 1]}},
    "NaN|finite": {"levels": [[0, np.nan]]},
}


@pytest.mark.parametrize("said", REFUSED)
def test_levels_that_cannot_be_are_refused(said):
    with pytest.raises((km.errors.DataError, km.errors.ShapeError), match=said):
        km.KoopmanMPC(TANK, COST, km.Limits(**REFUSED[said]), 5)


def test_laws_that_do_not_search_refuse_levels():
    limits = km.Limits(levels=[[0, 1]])
    plant = km.discretize(km.load_problem("pendulum").dynamics, 0.05)
    data = km.collect(plant, [0, 0], km.Noise(-1, 1), episodes=2, steps=30)
    refused = (
        (lambda: km.LQR(TANK, COST, limits), "an LQR does not keep"),
        (lambda: km.control.PID(1.0, dt=1.0, limits=limits), "a PID does not keep"),
        (lambda: km.design(data, km.Cost(Q=1, R=1), limits, horizon=3, reference=[0, 0]), "a design does not keep"),
        (lambda: km.KoopmanMPC(TANK, COST, limits, 5, solver="osqp"), 'need "daqp"'),
    )
    for act, said in refused:
        with pytest.raises(km.errors.DataError, match=said):
            act()
