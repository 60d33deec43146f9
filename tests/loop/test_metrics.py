from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.control.models import linear, step_map

STATES = ("theta [rad]", "omega [rad/s]")


def random_run(rng, T=12, cost=None, limits=None, nr=2, angles=(), dt=0.1):
    statuses = rng.choice(list(km.Status), T)
    fallbacks = rng.choice(list(km.control.Fallback), T)
    X = 4 * rng.normal(size=(T + 1, 2))
    return km.Run(
        X=X,
        Y=X + 0.1 * rng.normal(size=X.shape),
        U=rng.normal(size=(T, 1)),
        reference=rng.normal(size=(T + 1, nr)),
        status=tuple(statuses),
        fallback=tuple(fallbacks),
        solve_time=rng.uniform(0, 0.2, T),
        iterations=rng.integers(0, 9, T),
        cost=cost,
        limits=limits,
        dt=dt,
        states=STATES,
        inputs=("u",),
        outputs=STATES,
        angles=angles,
        u_reference=rng.normal(size=(T, 1)),
    )


def wrapped(angle):
    while angle > np.pi:
        angle -= 2 * np.pi
    while angle <= -np.pi:
        angle += 2 * np.pi
    return angle


@given(seed=st.integers(0, 2**32 - 1), angles=st.sampled_from([(), (0,), (0, 1)]))
def test_each_figure_is_what_its_equation_says_summed_step_by_step(seed, angles):
    rng = np.random.default_rng(seed)
    Q, R = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[0.7]])
    of = km.Fourier(1, states=["theta"])
    limits = km.Limits(-1, 0.8, x_min=[-3, -np.inf], x_max=[2, 5], of=of, y_max=[0.5, 0.9])
    run = random_run(rng, cost=km.Cost(Q, R), limits=limits, angles=angles)
    found = km.metrics(run)
    T, cost, squares, violation, over, effort = run.steps, 0.0, np.zeros(2), 0.0, 0.0, 0.0
    for k in range(T + 1):
        error = run.X[k] - run.reference[k]
        error = np.array([wrapped(e) if i in angles else e for i, e in enumerate(error)])
        if k:
            cost += error @ Q @ error
            squares += error**2
            theta, omega = run.X[k]
            violation = max(violation, -3 - theta, theta - 2, omega - 5, np.sin(theta) - 0.5, np.cos(theta) - 0.9)
        if k < T:
            u = run.U[k]
            cost += (u - run.u_reference[k]) @ R @ (u - run.u_reference[k])
            over = max(over, u[0] - 0.8, -1 - u[0])
            effort += u @ u * run.dt
    assert found.cost == pytest.approx(cost)
    np.testing.assert_allclose(found.tracking_rmse, np.sqrt(squares / T))
    np.testing.assert_allclose(found.final_error, error)
    assert found.violation == pytest.approx(violation)
    assert found.input_violation == pytest.approx(over)
    assert found.effort == pytest.approx(effort)
    assert found.late == sum(t > run.dt for t in run.solve_time)
    wide = km.Limits(-1, 0.8, x_min=[-3, -10], x_max=[2, 5])
    share = max([0.0, *(max((-3 - t) / 5, (t - 2) / 5, (-10 - w) / 15, (w - 5) / 15) for t, w in run.X[1:])])
    assert km.metrics(replace(run, limits=wide)).violation_share == pytest.approx(share)
    assert found.solve_time_max == max(run.solve_time)
    assert found.solve_time_p50 == pytest.approx(np.median(run.solve_time))
    assert found.solve_time_p50 <= found.solve_time_p99 <= found.solve_time_max
    for counts, kinds in ((found.status, run.status), (found.fallback, run.fallback)):
        assert sum(counts.values()) == T
        assert all(counts[kind.name] == kinds.count(kind) for kind in kinds)


def test_an_angle_a_turn_away_is_no_error():
    rng = np.random.default_rng(0)
    cost = km.Cost([1, 0], 0)
    run = random_run(rng, cost=cost, angles=(0,))
    turned = replace(run, X=run.X + np.array([2 * np.pi, 0]))
    assert km.metrics(turned).cost == pytest.approx(km.metrics(run).cost)
    assert km.metrics(replace(turned, angles=())).cost > km.metrics(replace(run, angles=())).cost + 1
    for error, expected in ((np.pi, np.pi), (-np.pi, np.pi), (3.0, 3.0), (3.2, 3.2 - 2 * np.pi)):
        one = replace(run, X=np.tile([error, 0], (13, 1)), reference=np.zeros((13, 2)))
        np.testing.assert_allclose(km.metrics(one).final_error, [expected, 0], atol=1e-9)


def test_tracked_observables_wrap_only_where_they_are_the_angle():
    rng = np.random.default_rng(1)
    of = km.Expressions(lambda x: [x[1]], ["rate"])
    run = random_run(rng, cost=km.Cost(1, 0, of=of), nr=1, angles=(0,))
    np.testing.assert_allclose(km.metrics(run).final_error, run.X[-1, 1:] - run.reference[-1])
    both = random_run(rng, cost=km.Cost(1, 0, of=of + km.State()), nr=3, angles=(0,))
    error = both.X[-1, 0] - both.reference[-1, 1]
    np.testing.assert_allclose(km.metrics(both).final_error[1], wrapped(error))


@pytest.mark.parametrize(
    ("errors", "settled"),
    [
        ([1, 0.5, 0.019, 0.01, 0], 0.2),
        ([1, 0.01, 0.5, 0.01, 0], 0.3),
        ([1, 0.5, 0.3, 0.2, 0.021], np.inf),
        ([1, 0, 0, 0, 0], 0.1),
        ([0, 0, 0, 0, 0], 0.0),
        ([0, 0, 1, 0, 0], 0.3),
        ([0, 0, 1, 0, 1], np.nan),  # it has no first error to measure by
        ([1, np.nan, 0, 0, 0], 0.2),
        ([np.nan, 0, 0, 0, 0], np.inf),
    ],
)
def test_a_run_settles_after_the_last_step_outside_two_percent(errors, settled):
    run = random_run(np.random.default_rng(2), T=4, cost=km.Cost(1, 0))
    X = np.column_stack([errors, np.zeros(5)])
    assert km.metrics(replace(run, X=X, reference=np.zeros((5, 2)))).settling_time == pytest.approx(
        settled, nan_ok=True
    )


@pytest.mark.parametrize("more", [{"output_price": [0.5, 0]}, {"Q_rows": [[0.0, 1.0], [1.0, 1.0]]}])
def test_prices_and_weights_in_time_do_not_move_the_settling_time(more):
    X = np.column_stack([[-1, -0.5, 0.019, 0.01, 0], np.zeros(5)])
    run = replace(
        random_run(np.random.default_rng(2), T=4), X=X, reference=np.zeros((5, 2)), cost=km.Cost(1, 1, **more)
    )
    assert km.metrics(run).settling_time == pytest.approx(0.2)


def test_without_a_cost_there_is_none_and_measurements_stand_in_for_a_hidden_state():
    rng = np.random.default_rng(3)
    run = random_run(rng)
    found = km.metrics(run)
    assert np.isnan(found.cost)
    assert "none was given" in str(found)
    assert (found.violation, found.input_violation) == (0.0, 0.0)
    np.testing.assert_allclose(found.final_error, run.X[-1] - run.reference[-1])
    hidden = replace(run, X=np.full_like(run.X, np.nan), cost=km.Cost(1, 1))
    assert km.metrics(hidden).cost == km.metrics(replace(run, X=run.Y, cost=km.Cost(1, 1))).cost
    blind = replace(hidden, outputs=("cos", "sin"))
    assert np.isnan(km.metrics(blind).cost)


def test_rest_on_the_reference_costs_nothing():
    """x⁺ = 0.5 x + u stays at 1 under u = 0.5: cost zero with that u_reference, its charge without."""
    rng = np.random.default_rng(5)
    run = random_run(rng, cost=km.Cost(1, 2.0))
    rest = replace(run, X=run.reference, U=np.full_like(run.U, 0.5), u_reference=np.full_like(run.U, 0.5))
    assert km.metrics(rest).cost == 0.0
    free = replace(rest, u_reference=np.zeros_like(run.U))
    assert km.metrics(free).cost == pytest.approx(2.0 * 0.25 * run.steps)
    assert km.metrics(free).effort == km.metrics(rest).effort


def test_metrics_print_a_figure_a_line():
    """A line a figure: every number that the fields hold can be found in it."""
    run = random_run(np.random.default_rng(6), cost=km.Cost(1, 1))
    found = replace(km.metrics(run), settling_time=2.35, solve_time_p50=13e-6, solve_time_p99=4.2e-3)
    lines = dict(line.split("  ", 1) for line in str(found).splitlines() if "  " in line)
    lines = {name: value.strip() for name, value in lines.items()}
    assert f"{found.cost:.6g}" == lines["cost"]
    assert lines["settling time"] == "2.35 s"
    assert "13 µs, 4.2 ms, " in str(found)
    for name, counts in (("status", found.status), ("fallback", found.fallback)):
        assert lines[name] == ", ".join(f"{n} {kind}" for kind, n in counts.items())
    assert len(str(found).splitlines()) == 11
    assert "does not settle" in str(replace(found, settling_time=np.inf))
    assert "starts on its reference" in str(replace(found, settling_time=np.nan))


@given(st.floats(1e-8, 1e4))
def test_a_solve_time_is_shown_right_to_its_digits(seconds):
    found = replace(km.metrics(random_run(np.random.default_rng(0))), solve_time_max=seconds)
    number, unit = found.figures()["solve time p50, p99, max"].split(", ")[-1].split()
    size = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}[unit]
    assert float(number) * size == pytest.approx(seconds, rel=6e-3)


@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e200])
def test_an_infinite_measurement_beside_a_hidden_state_costs_no_number(value):
    """Warnings are errors here. What is beyond no limit is not beyond: only the upper one stands."""
    run = random_run(np.random.default_rng(7), cost=km.Cost(1, 1), limits=km.Limits(x_max=[np.inf, 100.0]))
    Y = run.Y.copy()
    Y[3], Y[5, 0] = [0.0, value], -np.inf
    found = km.metrics(replace(run, X=np.full_like(run.X, np.nan), Y=Y))
    assert found.violation == max(value - 100.0, 0.0)
    assert not np.isfinite(found.cost)


def test_figures_of_named_outputs_stand_each_in_a_line():
    found = km.metrics(random_run(np.random.default_rng(6)))
    names = [f"y{i}" for i in range(len(found.tracking_rmse))]
    plain, named = found.figures(), found.figures(names)
    for what, values in (("tracking rmse", found.tracking_rmse), ("final error", found.final_error)):
        lines = [named.pop(f"{what}, {name}") for name in names]
        np.testing.assert_allclose([float(line) for line in lines], values, rtol=1e-3)
        plain.pop(what)
    assert named == plain


A, B = np.array([[1.05, 0.1], [0.08, 1.0]]), np.array([[0.005], [0.1]])


def test_the_change_of_the_inputs_is_charged_and_its_limits_count_as_limits():
    cost, limits = km.Cost(1, 0.1), km.Limits(-1, 1)
    mpc = km.KoopmanMPC(linear(A, B), cost, limits, 10)
    go = lambda cost, limits: km.metrics(  # noqa: E731
        km.simulate(step_map(A, B), mpc, x0=[0.6, 0.0], reference=[0.0, 0.0], steps=20, cost=cost, limits=limits)
    )
    plain = go(cost, limits)
    result = km.simulate(step_map(A, B), mpc, x0=[0.6, 0.0], reference=[0.0, 0.0], steps=20)
    changes = np.diff(result.U[:, 0])
    dearer = go(km.Cost(1, 0.1, R_delta=2.0), limits)
    assert dearer.cost == pytest.approx(plain.cost + 2.0 * changes @ changes)
    rated = go(cost, km.Limits(-1, 1, du_max=0.05))
    assert plain.violation == 0.0
    assert rated.violation == pytest.approx(np.abs(changes).max() - 0.05)
    assert rated.input_violation == 0.0
    assert rated.violation_share == pytest.approx(rated.violation / 0.1)


def test_the_steps_of_each_solver_are_counted():
    model, limits = linear(A, B), km.Limits(-1, 1)
    for asked in ("osqp", "daqp"):
        mpc = km.KoopmanMPC(model, km.Cost(1, 0.1), limits, 10, solver=asked)
        run = km.simulate(step_map(A, B), mpc, x0=[0.6, 0.0], reference=[0.0, 0.0], steps=80)
        found, free = km.metrics(run), run.status.count(km.Status.UNCONSTRAINED)
        assert 0 < free < 80
        assert sum(found.solver.values()) == 80 - free
        assert found.solver.get("daqp", 0) == run.solver.count("daqp")
        assert asked == "osqp" or set(found.solver) == {"daqp"}
        assert f"{run.solver.count(asked)} {asked}" in str(found)


def test_a_step_that_takes_exactly_the_sampling_time_is_not_late():
    run = replace(random_run(np.random.default_rng(0), T=4, dt=0.1), solve_time=np.array([0.1, 0.05, 0.1, 0.2]))
    assert km.metrics(run).late == 1
    assert km.metrics(replace(run, metadata={"time unit": "h"})).late == 0  # a tenth of an hour
    assert km.metrics(replace(run, metadata={"time unit": "ms"})).late == 4


def test_references_bear_the_names_of_what_is_tracked_where_these_are_known():
    run = random_run(np.random.default_rng(0), cost=km.Cost(1, 1))
    assert run.name_references(len(run.states)) == run.states
    assert run.name_references(1) == ("reference 0",)
