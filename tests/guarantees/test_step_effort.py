"""The most iterations of a step: the bound is attained and never exceeded, and what is observed has its probability."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import koopmpc as km


def make_mpc(limits=None, horizon=6, **options):
    system = scipy.signal.dlti([[1.0, 0.3], [0.0, 1.0]], [[0.0], [0.3]], np.eye(2), np.zeros((2, 1)), dt=0.3)
    model = km.LinearPredictor.from_state_space(system)
    return km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), limits or km.Limits(u_min=-1, u_max=1), horizon, **options)


def test_the_most_is_that_of_the_steps_and_is_exceeded_as_rarely_as_it_says():
    mpc = make_mpc()
    few, more = (km.guarantees.observe_iterations(mpc, (-2, 2), (-1, 1), samples=n) for n in (30, 150))
    assert 0 < few.most <= more.most  # the first steps of both are the same
    assert (1 - more.exceeded) ** 150 == pytest.approx(0.05)
    rng, over = np.random.default_rng(9), 0
    for _ in range(200):
        mpc.reset()
        over += mpc(rng.uniform(-2, 2, 2), rng.uniform(-1, 1, 2)).iterations > more.most
    assert over / 200 <= more.exceeded + 3 * np.sqrt(more.exceeded / 200)
    assert km.guarantees.observe_iterations(mpc, (0, 0), (0, 0), samples=3).most == 0
    assert "observed, not proved" in str(more)


def test_bad_boxes_are_errors():
    with pytest.raises(km.errors.DataError, match="low ≤ high"):
        km.guarantees.observe_iterations(make_mpc(), (1, -1), (0, 0))
    with pytest.raises(km.errors.DataError, match="confidence"):
        km.guarantees.observe_iterations(make_mpc(), (0, 1), (0, 0), confidence=2.0, samples=3)


@pytest.mark.parametrize("limits", [km.Limits(u_min=-1, u_max=1), km.Limits(u_min=-1, u_max=1, x_max=[2.0, 0.6])])
def test_a_grid_finds_a_step_that_takes_the_bound_and_none_that_takes_more(limits):
    mpc = make_mpc(limits, horizon=3)
    bound = km.guarantees.bound_iterations(mpc, (-3, 3), (0, 0))
    most = 0
    for x in np.stack(np.meshgrid(*[np.linspace(-3, 3, 31)] * 2), -1).reshape(-1, 2):
        mpc.reset()
        most = max(most, mpc(x, [0.0, 0.0]).iterations)
    assert most == bound.most > 1
    assert bound.attained


def draw_task(seed):
    """Return a random controller that starts cold, and a box of its states."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    nu = int(rng.integers(1, min(n, 2) + 1))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, nu))
    A *= rng.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    model = km.LinearPredictor.from_state_space(scipy.signal.dlti(A, B, np.eye(n), np.zeros((n, nu)), dt=0.1))
    keep = {"x_max": rng.uniform(0.5, 2)} if rng.uniform() < 0.4 else {}
    keep |= {"du_max": 0.5} if rng.uniform() < 0.3 else {}
    limits, options = km.Limits(u_min=-1, u_max=1, **keep), {"settings": {"cold_start": True}}
    return km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), limits, int(rng.integers(2, 5)), **options), rng


def check_steps(seeds, starts, most=150):
    """Return how many controllers have a bound, and how many of these attain it; no step of a loop exceeds it."""
    bounds = attained = 0
    for seed in seeds:
        mpc, rng = draw_task(seed)
        n, nu, model = mpc.predictor.nx, mpc.predictor.nu, mpc.predictor
        try:
            bound = km.guarantees.bound_iterations(mpc, (-2, 2), (-0.05, 0.05), most_ways=most)
        except (km.errors.DataError, km.errors.CertificateError):
            continue
        assert bound.every_step
        bounds, attained = bounds + 1, attained + bound.attained
        mpc.reset()
        for _ in range(starts):  # loops, begun anew where they leave the box, with references that move
            x = rng.uniform(-2, 2, n)
            mpc.reset(u_prev=rng.uniform(-1, 1, nu))
            for _ in range(5):
                if np.abs(x).max() > 2:
                    break
                move = mpc(x, rng.uniform(-0.05, 0.05, n))
                assert move.iterations <= bound.most, (seed, x)
                x = model.A @ x + model.B @ move.u
    return bounds, attained


def test_no_step_of_a_loop_that_starts_cold_takes_more_than_the_bound():
    bounds, attained = check_steps(range(8), 6)
    assert bounds >= 4
    assert attained == bounds


@pytest.mark.slow
def test_no_step_of_many_controllers_takes_more_than_the_bound():
    bounds, attained = check_steps(range(100, 200), 200, 400)
    assert bounds >= 50
    assert attained == bounds


def test_the_c_code_states_the_bound_and_keeps_it(tmp_path):
    limits = km.Limits(u_min=-1, u_max=1, x_max=[2.0, 0.6])
    warm = make_mpc(replace(limits, rows=("x_max",)), horizon=2, settings={"cold_start": False})
    cold = make_mpc(limits, horizon=2, settings={"cold_start": True})
    bound, box = km.guarantees.bound_iterations(cold, (-3, 3), (0, 0)), ((-3, 3), (0, 0))
    seen = km.guarantees.observe_iterations(warm, *box, samples=20)
    both = (
        (cold, bound, "proved: no step", "all steps start cold"),
        (warm, seen, "observed, not proved", "start warm"),
    )
    for mpc, figure, words, how in both:
        km.export(mpc, tmp_path / words[:3], reference=[0.0, 0.0], iterations=figure)
        header = (tmp_path / words[:3] / "koopmpc_sizes.h").read_text()
        assert f"#define KOOPMPC_MOST_ITERATIONS {figure.most}\n" in header
        assert words in header
        assert how in header
        assert "koopmpc_set_bounds" not in header  # a note of the README alone
        assert words in (tmp_path / words[:3] / "README.md").read_text()
    with pytest.raises(km.errors.DataError, match="start warm"):
        km.export(warm, tmp_path / "c", iterations=km.guarantees.bound_iterations(warm, *box))
    with pytest.raises(km.errors.DataError, match="exact arithmetic"):
        km.export(cold, tmp_path / "c", iterations=bound, precision="float")
    same, rng = km.compiled(cold), np.random.default_rng(0)
    for _ in range(40):
        x = rng.uniform(-3, 3, 2)  # without reset: every step starts cold
        a, b = cold(x, [0.0, 0.0]), same(x, [0.0, 0.0])
        assert a.iterations == b.iterations <= bound.most
        assert a.u == pytest.approx(b.u, abs=1e-9)
    again = same(bound.x, bound.reference)
    assert again.iterations == bound.most


def test_a_bound_over_lifted_states_that_no_state_may_have_is_not_said_to_be_attained():
    lifting = km.State() + km.Monomials(2)
    A, B = np.array([[0.9, 0.2], [0.0, 0.8]]), np.array([[1.0], [0.0]])
    model = km.LinearPredictor(A, B, np.eye(1, 2), lifting, 0.1, ["x"], ["u"])
    mpc = km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), km.Limits(u_min=-1, u_max=1), horizon=2)
    bound = km.guarantees.bound_iterations(mpc, (-3, 3), (0, 0))
    assert bound.most > 1
    assert not bound.attained


def test_what_is_not_in_the_analysis_is_said():
    find = km.guarantees.bound_iterations
    with pytest.raises(km.errors.DataError, match="without an estimator"):
        find(make_mpc(estimator=km.LiftedDisturbance()), (-1, 1), (0, 0))
    with pytest.raises(km.errors.DataError, match="solver="):
        find(make_mpc(solver="osqp"), (-1, 1), (0, 0))
    with pytest.raises(km.errors.CertificateError, match="more than 2 ways"):
        find(make_mpc(), (-3, 3), (0, 0), most_ways=2)
    hard = km.Limits(u_min=-1, u_max=1, x_max=[2.0, 0.6], slack=None)
    with pytest.raises(km.errors.DataError, match="have no plan"):
        find(make_mpc(hard, horizon=3), (-3, 3), (0, 0))
    slow = km.LinearPredictor.from_state_space(scipy.signal.dlti([[0.9]], [[0.1]], [[1.0]], [[0.0]], dt=0.1))
    mpc = km.KoopmanMPC(slow, km.Cost(Q=1, R=0.1), km.Limits(u_min=-1, u_max=1), horizon=3)
    assert find(mpc, (-1, 1), (-0.9, 0.9)).attained
    with pytest.raises(km.errors.DataError, match="target outside the limits"):
        find(mpc, (-1, 1), (-3, 3))
