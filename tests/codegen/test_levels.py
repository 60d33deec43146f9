"""Inputs on levels in C: the search, dwell times and fallbacks give what Python gives, step by step."""

import subprocess

import numpy as np
import pytest

import koopmpc as km
import koopmpc.codegen.programs
from tests.compiler import find_compiler, needs_compiler
from tests.control.test_levels import COST, TANK, draw_model

pytestmark = needs_compiler
slow = pytest.mark.slow


def draw_controller(rng, nu):
    """A controller whose inputs are all on levels, with limits, dwell times, rates and blocks at random."""
    model, N = draw_model(rng, nu), int(rng.integers(2, 9))
    counts = rng.integers(2, 5, nu)
    rows = [rng.uniform(-1, 0) + rng.uniform(0.3, 1) * np.arange(c) for c in counts]
    limits = {"levels": rows, "u_min": np.full(nu, -3.0), "u_max": np.full(nu, 4.0)}
    if rng.random() < 0.6:
        on, off = rng.integers(1, 5, (2, nu)).tolist()
        limits["dwell"] = [(on[i], off[i]) if c == 2 else on[i] for i, c in enumerate(counts)]
    if rng.random() < 0.4:
        limits["du_max"] = [(row[1] - row[0]) * rng.uniform(1, 2) for row in rows]
    if rng.random() < 0.6:
        limits["x_max"] = rng.uniform(0.3, 2, 3)
    if rng.random() < 0.2:
        limits["slack"] = None
    options = {"latency": int(rng.random() < 0.2), "moves": [None, 2, {"u0": 2}][int(rng.integers(0, 3))]}
    if rng.random() < 0.3:
        options["estimator"] = km.LiftedDisturbance()
    return km.KoopmanMPC(model, km.Cost(Q=1.0, R=0.05, R_delta=0.02), km.Limits(**limits), N, **options)


def compare(mpc, rng, steps=20):
    """Step Python and C through wild readings, other inputs than planned and a reset; return the statuses."""
    fast, seen = km.compiled(mpc), set()
    assert fast is not mpc
    for _ in range(2):
        mpc.reset()
        fast.reset()
        x, r, last = rng.standard_normal(3), np.zeros(3), None
        for _ in range(steps):
            y = np.full(3, np.nan) if rng.random() < 0.08 else x
            r = 0.3 * rng.standard_normal(3) if rng.random() < 0.1 else r
            applied = last if rng.random() < 0.3 else None
            one, other = mpc(y, r, applied), fast(y, r, applied)
            np.testing.assert_array_equal(other.u, one.u)
            assert (other.status, other.fallback, other.gap) == (one.status, one.fallback, one.gap)
            assert other.slack == pytest.approx(one.slack, rel=1e-6, abs=1e-9)
            seen.add(one.status.name)
            last = one.u
            x = mpc.predictor.A @ x + mpc.predictor.B @ one.u + 0.1 * rng.standard_normal(3)
    return seen


@pytest.mark.parametrize("seed", [*range(6), *(pytest.param(seed, marks=slow) for seed in range(6, 60))])
def test_c_and_python_take_the_same_levels(seed):
    rng = np.random.default_rng([5, seed])
    assert {"OPTIMAL", "SOFTENED"} & compare(draw_controller(rng, int(rng.integers(1, 3))), rng)


def test_a_plan_that_rests_on_its_levels_is_taken_at_once_in_c():
    mpc = km.KoopmanMPC(TANK, km.Cost(Q=1.0, R=0.1), km.Limits(levels=[[0, 1]], dwell=[2]), 4)
    fast = km.compiled(mpc)
    for y, r in ((0.0, 0.0), (2.0, 2.0), (2.0, 1.0), (0.0, 0.0)):
        one, other = mpc([y], [r]), fast([y], [r])
        assert (other.status, other.iterations > 0) == (one.status, one.iterations > 0)
        np.testing.assert_array_equal(other.u, one.u)
    assert one.status is km.Status.UNCONSTRAINED


def test_rows_of_limits_leave_some_levels_in_c_as_in_python():
    limits = km.Limits(levels=[[0, 1, 2]], dwell=[2], u_max=np.array([[2.0], [2.0], [1.2], [0.4], [2.0], [2.0]]))
    mpc = km.KoopmanMPC(TANK, COST, limits, 3)
    fast = km.compiled(mpc)
    for k in range(8):
        one, other = mpc([0.2], [2.5]), fast([0.2], [2.5])
        np.testing.assert_array_equal(other.u, one.u)
        assert other.status is one.status
        assert other.u[0] <= limits.u_max[min(k, 5), 0]


def test_single_precision_leaves_out_no_level_on_its_limit():
    """Rounded to single precision, such a limit is up to 4e-6 of the spacing below its level."""
    row = -3.0 + 0.15 * np.arange(40)
    for highest in (33, 34, 38):
        mpc = km.KoopmanMPC(TANK, COST, km.Limits(levels=[row], u_max=[[row[highest]], [row[-1]]]), 3)
        for each in (mpc, km.compiled(mpc, precision="float")):
            assert each([0.0], [50.0]).u == pytest.approx(row[highest], rel=1e-5)


def test_a_run_with_rows_starts_on_a_level_in_c_as_in_python():
    """Zero, where a run starts, is between two levels, and a change of more than 0.5 breaks the rate."""
    limits = km.Limits(levels=[[-0.1, 0.4]], du_max=0.5, u_max=np.full((3, 1), 1.0))
    mpc = km.KoopmanMPC(TANK, COST, limits, 3)
    for each in (mpc, km.compiled(mpc)):
        move = each([0.0], [1.0])
        assert (move.u, move.status, move.slack) == (0.4, km.Status.OPTIMAL, 0.0)


def test_a_step_without_a_plan_has_no_slack_in_c_as_in_python():
    """The last input was far outside its limits, so that its change must be large, and no plan meets x ≤ 1."""
    mpc = km.KoopmanMPC(TANK, COST, km.Limits(levels=[[0, 1, 2]], du_max=1, x_max=1, slack=None), 4)
    fast = km.compiled(mpc)
    one, other = (each([9.0], [0.0], [7.0]) for each in (mpc, fast))
    assert (one.status, one.slack) == (other.status, other.slack) == (km.Status.INFEASIBLE, 0.0)


def test_a_search_that_meets_its_bound_in_c_says_what_its_plan_may_miss(monkeypatch):
    rng, gaps = np.random.default_rng(3), []
    for _ in range(3):
        mpc = km.KoopmanMPC(draw_model(rng, 1), COST, km.Limits(levels=[[-1, 1]]), 9)
        best = km.compiled(mpc)
        monkeypatch.setattr(koopmpc.codegen.programs, "NODES", 9)
        cut = km.compiled(mpc)
        monkeypatch.undo()
        x = rng.standard_normal(3)
        one, other = (each(x, np.zeros(3)) for each in (best, cut))
        assert one.gap == 0
        assert (other.status is km.Status.TIME_LIMIT) == (other.gap > 0)
        gaps.append(other.gap)
    assert 0 < max(gaps) <= 1


def test_the_c_of_levels_has_no_warning(tmp_path):
    limits = km.Limits(levels=[[0, 1, 2]], dwell=[2], du_max=1, x_max=3, u_max=np.full((4, 1), 2.0))
    folder = km.export(km.KoopmanMPC(TANK, COST, limits, 4), tmp_path / "c")
    compiler = f"CC={' '.join(find_compiler() or ())}"
    done = subprocess.run(["make", "-s", "strict", compiler], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_levels_of_some_inputs_or_steps_are_refused_in_c(tmp_path):
    rng = np.random.default_rng(0)
    for nu, limits in ((2, {"levels": [[0, 1], None]}), (1, {"levels": [[0, 1]], "level_steps": 2})):
        mpc = km.KoopmanMPC(draw_model(rng, nu), COST, km.Limits(**limits), 5)
        with pytest.raises(km.errors.DataError, match="only some of its inputs or steps"):
            km.export(mpc, tmp_path)
