"""select: which model wins, on what it is judged, and what it says of the data."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import koopmpc as km
from tests.roundtrip import returned
from tests.searches import select

A, B = np.array([[0.9, 0.2], [-0.1, 0.95]]), np.array([[0.0], [0.3]])


def episodes_of(step, count=20, steps=30, nx=2, nu=1, seed=0, keep=None, names=None):
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        X, U = [rng.uniform(-1, 1, nx)], rng.uniform(-1, 1, (steps, nu))
        for u in U:
            X.append(step(X[-1], u))
        made.append(km.Episode(X=np.array(X)[:, :keep], U=U))
    return km.Episodes(made, 0.1, names)


def linear(x, u):
    return A @ x + B @ u


def quadratic(x, u):
    return np.array([0.9 * x[0], 0.8 * x[1] + 0.3 * x[0] ** 2 + 0.2 * u[0]])


def bilinear(x, u):
    return np.array([0.9 * x[0] + 0.1 * x[1], 0.9 * x[1] - 0.1 * x[0] + 0.4 * u[0] * x[0]])


PLAIN, SQUARES = km.State() + km.Constant(), km.State() + km.Constant() + km.Monomials(2)


def noisy(data, size, seed=1):
    rng = np.random.default_rng(seed)
    return km.Episodes(
        [km.Episode(X=e.X + size * rng.standard_normal(e.X.shape), U=e.U) for e in data], data.dt, data.states
    )


def test_a_linear_plant_gets_the_linear_model_though_larger_ones_hold_it():
    found = select(noisy(episodes_of(linear), 0.01), horizon=8, folds=2, ridges=[0.0, 1e-06], delays=[0])
    assert (found.best.name, found.best.kind, found.chosen) == ("x, 1", "linear", found.chosen_linear)
    assert found.predictor is found.linear
    assert len(found.leaderboard) > 20


def test_a_closed_quadratic_dictionary_wins_and_is_exact_over_the_horizon():
    found = select(episodes_of(quadratic), horizon=10, candidates=[PLAIN, SQUARES], delays=[0])
    assert found.best.nz == 6
    assert found.best.median < 1e-6  # the ridge is as large as that allows
    plain = next(row for row in found.leaderboard if row.kind == "linear" and row.nz == 3)
    assert plain.worst > 0.05


def test_inputs_that_multiply_the_state_get_a_bilinear_model_and_the_best_linear_one_beside_it():
    data = episodes_of(bilinear)
    found = select(data, horizon=8, candidates=[PLAIN], delays=[0])
    assert (found.best.kind, found.best_linear.kind) == ("bilinear", "linear")
    assert found.best.worst < 1e-6 < 0.05 < found.best_linear.worst
    row = found.best
    assert found.predictor == km.bilinear_edmd(data, row.lifting, ridge=row.ridge, difference=True)
    assert found.linear == km.edmd(data, found.best_linear.lifting, ridge=found.best_linear.ridge, towards="affine")
    only = select(data, horizon=8, candidates=[PLAIN], delays=[0], bilinear=False)
    assert {row.kind for row in only.leaderboard} == {"linear"}


def test_a_bilinear_model_is_judged_by_forecasts_that_lift_afresh_as_its_controller_plans():
    """x⁺ is in the span of the observables and the cubes of x⁺ are not: forecasts in z drift, re-lifted ones are exact."""

    def cubic(x, u):
        return np.array([0.9 * x[0] + 0.1 * x[1], 0.9 * x[1] - 0.2 * x[0] ** 3 + 0.4 * u[0] * x[0]])

    data = episodes_of(cubic)
    found = select(data, horizon=15, candidates=[PLAIN + km.Monomials(3)], delays=[0])
    assert found.best.bilinear
    assert found.best.worst < 1e-6
    assert km.score(found.predictor, data, 15, relift=True).total < 1e-6
    assert km.score(found.predictor, data, 15).total > 1e-3


def test_errors_below_a_hundredth_are_alike_for_a_controller_and_not_for_a_forecast():
    """A plant with a cubic term that is worth less than 1 % of the spread over the horizon."""

    def nearly(x, u):
        return A @ x + B @ u + np.array([0.0, 2e-3 * x[0] ** 3])

    # with so much noise no bilinear model reaches a hundredth of the linear one's error, which would be worth its step
    data, candidates = noisy(episodes_of(nearly), 1e-4), [PLAIN, PLAIN + km.Monomials(3)]
    control, forecast = (
        select(data, horizon=10, relift=relift, candidates=candidates, delays=[0]) for relift in (True, False)
    )
    assert (control.best.name[0], control.best.bilinear) == ("0", False)
    assert 1e-6 < control.best.worst < 1e-2
    assert forecast.best.name.startswith("1")
    assert forecast.best.worst < 0.5 * control.best.worst


def test_what_is_not_measured_is_found_in_the_past():
    """Of two linear states one is measured: one delay closes the model."""
    found = select(episodes_of(linear, keep=1), horizon=8, candidates=[km.State()])
    assert found.best.delays == 1
    assert found.best.worst < 1e-6
    assert isinstance(found.predictor.embedding, km.Delay)


def test_neither_units_nor_offsets_change_the_choice_or_the_errors():
    data = noisy(episodes_of(quadratic), 0.01)
    scale, offset = np.array([1e3, 1e-3]), np.array([2e3, 2e-3])
    moved = km.Episodes([km.Episode(X=e.X * scale + offset, U=e.U) for e in data], data.dt)
    kwargs = {"candidates": [PLAIN, SQUARES], "horizon": 6, "delays": [0, 1], "ridges": [0.0]}
    one, other = select(data, **kwargs), select(moved, **kwargs)
    assert [r.title for r in one.leaderboard[:4]] == [r.title for r in other.leaderboard[:4]]
    assert one.best.title == other.best.title
    assert other.best.worst == pytest.approx(
        one.best.worst, rel=5e-3
    )  # offsets make columns long, and a ridge relative


def test_what_runs_away_counts_as_infinite_and_is_taken_only_where_all_does():
    """Noise of sizes from 1e-3 to 1e3: a polynomial of degree 5 runs away, the linear model does not."""
    rng, wild = np.random.default_rng(0), km.State() + km.Monomials(5)
    sizes = [(25, 2)] * 10
    made = [
        km.Episode(X=rng.standard_normal(size) * 10.0 ** rng.integers(-3, 4), U=np.zeros((24, 0))) for size in sizes
    ]
    task = {"horizon": 20, "ridges": [0.0], "delays": [0]}
    with pytest.warns(km.FitWarning) as told:
        found = select(km.Episodes(made, 0.1), candidates=[wild], **task)
    assert any("the forecasts of all 1 candidates run away within 20" in str(one.message) for one in told)
    assert np.isinf(found.best.worst)
    assert "inf" in str(found)
    found = select(km.Episodes(made, 0.1), candidates=[wild, PLAIN], **task)
    assert found.best.name.startswith("1")
    assert np.isfinite(found.best.worst)


def levitated(x, u, dt=0.005, substeps=10):
    """A ball below a magnet, gap [cm] and speed [dm/s]: unstable, e-folding in 22 ms."""
    for _ in range(substeps):
        x = x + dt / substeps * np.array([10 * x[1], 98.1 * (1 - (u[0] / x[0]) ** 2) - 2 * x[1]])
    return x


def test_on_an_unstable_plant_the_next_step_is_not_given_up_for_the_last_one():
    """The linear model that is chosen closes a loop that costs no more than that of plain DMDc."""
    rng = np.random.default_rng(0)
    made = []
    for _ in range(60):
        X, U = [rng.uniform([0.8, -1.0], [1.2, 1.0])], []
        for noise in np.repeat(rng.uniform(-0.12, 0.12, 25), 2):
            U.append([np.clip(1 + 3.5 * (X[-1][0] - 1) + 0.6 * X[-1][1] + noise, 0.3, 1.8)])
            X.append(levitated(X[-1], U[-1]))
        made.append(km.Episode(X=np.array(X), U=np.array(U)))
    data = km.Episodes(made, 0.005)
    model = select(data, horizon=20, candidates=[PLAIN, SQUARES], bilinear=False).linear
    limits, x0, goal = km.Limits(u_min=0.3, u_max=1.8), np.array([1.1, 0.0]), np.array([0.9, 0.0])
    assert model is not None

    def spent(mpc):
        mpc.reset()
        x, sum_ = x0, 0.0
        for _ in range(100):
            u = mpc(x, goal).u
            x = levitated(x, u)
            sum_ += float(np.sum((x - goal) ** 2 * [1.0, 0.01]) + 0.01 * np.sum((u - 0.9) ** 2))
        return sum_

    Q, R = [1.0, 0.01], [0.01]
    chosen = spent(km.KoopmanMPC(model, km.Cost(Q=Q, R=R), limits, 20))
    plain = spent(km.KoopmanMPC(km.dmdc(data), km.Cost(Q=Q, R=R, tail=0), limits, 20))
    assert chosen < 1.1 * plain < 1.0


def test_delays_are_taken_only_where_they_halve_the_error():
    """All of the state is measured, with noise: the past tells a little more, and a controller needs none of it."""
    data = noisy(episodes_of(quadratic), 0.02)
    found = select(data, horizon=8, candidates=[SQUARES], delays=[0, 1, 2], bilinear=False)
    assert found.best.delays == 0
    assert min(row.worst for row in found.leaderboard if row.delays) > 0.5 * found.best.worst


def test_workers_change_nothing_and_a_lifting_of_ones_own_reaches_them():
    import casadi as ca

    own = km.Expressions(lambda x: [x[0], x[1], ca.sin(x[0]) * x[1]], ("a", "b", "c"))
    data = episodes_of(quadratic, count=8)
    told = []
    found = [
        select(
            data,
            horizon=5,
            candidates=[SQUARES, own],
            delays=[0],
            workers=workers,
            progress=lambda *args: told.append(args),
        )
        for workers in (None, 2)
    ]
    timeless = [tuple(replace(row, seconds=0.0) for row in each.leaderboard) for each in found]
    assert timeless[0] == timeless[1]
    assert found[0].predictor == found[1].predictor
    assert told[0] == ("candidates", 0, 4)
    assert ("candidates", 4, 4) in told


def test_a_source_is_chosen_on_a_sample_and_fitted_to_all():
    sets = [episodes_of(quadratic, count=4, steps=20, seed=s) for s in range(12)]
    found = select(
        km.data.Stream(sets), horizon=5, ridges=[1e-06], candidates=[SQUARES], delays=[0], sample=300, bilinear=False
    )
    assert found.predictor.report.samples == 12 * 4 * 20
    assert "chosen on" in found.notes[0]
    assert "fitted to all" in found.notes[0]
    with pytest.raises(km.errors.DataError, match="a selection reads its data several times"):
        select(km.data.Stream(iter(sets)), candidates=[SQUARES])


def test_one_long_episode_is_cut_into_blocks_and_the_choice_says_so():
    found = select(episodes_of(quadratic, count=1, steps=400), horizon=5, candidates=[SQUARES], delays=[0])
    assert found.folds == 5
    assert "1 episode is too few for 5 folds: cut into" in str(found)


@pytest.mark.parametrize(
    ("lengths", "expected"),
    [([40] * 20, 20), ([3] * 20 + [40] * 10, 20), ([15] * 20, 13), ([15] * 20 + [400], 20), ([60], 13), ([500], 20)],
)
def test_the_usual_horizon_is_twenty_steps_or_what_most_data_allow_and_then_a_note_says_so(lengths, expected):
    X = np.random.default_rng(0).standard_normal((501, 1))
    data = km.Episodes([km.Episode(X=X[: n + 1], U=np.zeros((n, 0))) for n in lengths], 0.1)
    found = select(data, candidates=[km.State()], delays=[2], ridges=[1e-6])
    assert found.horizon == expected
    assert any(f"judged {expected} steps ahead, not 20" in note for note in found.notes) == (expected < 20)


def test_a_few_short_episodes_do_not_shorten_the_horizon():
    data = episodes_of(quadratic, count=20, steps=40)
    short = [km.Episode(X=e.X[:5], U=e.U[:4]) for e in data]
    found = select(km.Episodes([*data, *short], data.dt), candidates=[SQUARES], delays=[0])
    assert found.horizon == 20
    assert any("20 of 40 episodes are shorter than the 20 steps" in note for note in found.notes)


def test_a_ridge_is_never_below_its_floor_nor_below_what_the_misfit_of_a_step_supports():
    """Noise of a share s of the state's size, where it is not smoothed away, is worth a ridge of s²."""
    clean = episodes_of(quadratic)
    given = select(clean, horizon=6, ridges=[0.0], candidates=[SQUARES], delays=[0], bilinear=False)
    assert {row.ridge for row in given.leaderboard} == {1e-9}
    size = 0.03 * np.sqrt(np.mean(np.concatenate([e.X for e in clean]) ** 2))
    rough, options = noisy(clean, size), {"horizon": 6, "delays": [0, 1], "bilinear": False}
    found = select(rough, candidates=[SQUARES], smooth=False, **options)
    assert min(row.ridge for row in found.leaderboard) == pytest.approx(1e-3)


def test_what_is_constant_in_the_data_is_named():
    data = episodes_of(linear)
    held = km.Episodes([km.Episode(X=np.c_[e.X, 3 + 0 * e.X[:, 0]], U=np.c_[e.U, 0 * e.U]) for e in data], data.dt)
    with pytest.warns(km.FitWarning) as told:
        found = select(held, horizon=6, candidates=[PLAIN], delays=[0])
    said = [str(one.message) for one in told]
    assert "x2 is constant in these data, so what it does cannot be learned; excite it, or leave it out" in said
    assert any(text.startswith("u1 is constant") for text in said)
    assert found.linear.rollout([0.1, 0.2, 3.0], np.ones((5, 2)))[-1, 2] == pytest.approx(3.0, rel=1e-6)


def test_a_wrapped_angle_is_named():
    rng = np.random.default_rng(0)
    turning = [np.cumsum(np.full((40, 1), 0.3), axis=0) + rng.uniform(-3, 3) for _ in range(6)]
    wrapped = [km.Episode(X=(t + np.pi) % (2 * np.pi) - np.pi, U=np.zeros((39, 0))) for t in turning]
    with pytest.warns(km.FitWarning, match=r"theta jumps by 2π \d+ times: it was wrapped"):
        select(km.Episodes(wrapped, 0.1, ["theta"]), horizon=4, candidates=[PLAIN], delays=[0])


def test_a_lifting_made_for_the_states_is_tried_without_delays_only():
    bells = km.State() + km.Gaussian(np.zeros((1, 2)), 1.0)
    found = select(episodes_of(linear), horizon=5, candidates=[bells, PLAIN], bilinear=False)
    assert {row.delays for row in found.leaderboard if row.name.startswith("0")} == {0}
    assert {row.delays for row in found.leaderboard if row.name.startswith("1")} == {0, 1, 2}


def test_measured_disturbances_are_in_the_fit_and_in_the_forecast():
    rng = np.random.default_rng(0)
    made = []
    for e in episodes_of(linear, count=8):
        W, X = rng.uniform(-1, 1, (len(e), 1)), e.X.copy()
        for k in range(len(e)):
            X[k + 1] = A @ X[k] + B @ e.U[k] + [0.2, 0.0] * W[k]
        made.append(km.Episode(X=X, U=e.U, W=W))
    found = select(km.Episodes(made, 0.1), horizon=6, candidates=[PLAIN])
    assert found.best.kind == "linear"
    assert found.best.worst < 1e-6
    assert found.predictor.disturbances == ("w0",)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ridges": [-1.0]}, "ridges is"),
        ({"ridges": []}, "at least one"),
        ({"delays": []}, "delays is empty"),
        ({"folds": 1}, "folds is 1; it must be at least 2"),
        ({"candidates": []}, "there is no candidate"),
        ({"horizon": 300}, "pass a shorter horizon"),
    ],
)
def test_a_mistake_is_told(change, words):
    with pytest.raises(km.errors.DataError, match=words):
        select(episodes_of(linear, count=4), **({"candidates": [PLAIN]} | change))


def test_a_selection_is_data():
    found = select(episodes_of(linear, count=6), horizon=5, folds=2, candidates=[PLAIN])
    assert returned(found) == found


def test_the_table_shows_the_choice_the_plain_model_and_fits_a_terminal():
    lines = str(select(episodes_of(bilinear, count=8), horizon=5, folds=2, ridges=[0.0], delays=[0])).splitlines()
    assert lines[0].startswith("chosen: bilinear: ")
    assert any(line.startswith("→ ") for line in lines)
    assert any("linear: x, 1 " in line for line in lines)
    assert max(map(len, lines)) <= 120


def test_the_table_shows_a_model_that_was_tried_twice_once():
    found = select(episodes_of(bilinear, count=8), horizon=5, folds=2, candidates=[PLAIN, PLAIN, SQUARES], delays=[0])
    shown = [line for line in str(found).splitlines()[4:] if "linear: " in line]
    assert len(found.leaderboard) == 6
    assert len(shown) == 4
    assert sum("; 1 more alike" in line for line in shown) == 2


def test_a_bilinear_model_with_a_hundredth_of_the_error_is_worth_its_step():
    """x⁺ = A x + B u + 0.002 u N x: a linear model errs by less than 1 % of the spread, a bilinear one by rounding."""

    def product(x, u):
        return [0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + u[0] + 0.002 * u[0] * x[0]]

    exact = select(episodes_of(product), horizon=8, candidates=[PLAIN])
    assert min(row.worst for row in exact.leaderboard if row.kind == "linear") < 0.01
    assert exact.best.kind == "bilinear"
    hidden = select(noisy(episodes_of(product), 0.02), horizon=8, candidates=[PLAIN])
    assert hidden.best.kind == "linear"


def level(offset, rng):
    """Return logs of a plant whose output stays about an offset."""
    y, u = np.zeros(301), rng.uniform(-1, 1, 300)
    for k in range(300):
        y[k + 1] = 0.9 * y[k] + 0.5 * u[k]
    whole = km.Episode(X=(offset + y)[:, None], U=u[:, None])
    return km.Episodes([whole.cut(25 * i, 25 * i + 25) for i in range(12)], 0.1, ["y"], ["u"])


@pytest.mark.parametrize(("offset", "turns"), [(0.0, True), (95.0, False)])
def test_a_number_without_a_unit_is_an_angle_only_if_it_comes_near_zero(offset, turns):
    found = select(level(offset, np.random.default_rng(0)), delays=[0], bilinear=False, ridges=[1e-6], horizon=4)
    assert any("fourier 1" in row.name for row in found.leaderboard) is turns


def test_of_centres_at_one_place_one_is_kept():
    rng = np.random.default_rng(0)
    data = level(0.0, rng)
    steps = [np.round(e.X, 0) for e in data]  # a coarse sensor, whose readings jitter by a millionth
    jitter = [1e-6 * rng.standard_normal(x.shape) for x in steps]
    coarse = data.with_episodes([km.Episode(X=x + d, U=e.U) for x, d, e in zip(steps, jitter, data, strict=True)])
    found = select(coarse, delays=[0], bilinear=False, ridges=[1e-6], horizon=4, smooth=False)
    names = {row.name for row in found.leaderboard if "gaussian" in row.name}
    assert names == {f"gaussian {len(np.unique(np.concatenate(steps)))}"}


def test_more_of_the_past_is_tried_where_two_rows_of_it_forecast_better_than_one():
    """One hidden speed needs one past row, though noise and smoothing make more look better; three hidden states do not."""
    rng, found = np.random.default_rng(0), []
    springs = np.array([[0.0, 1.0, 0.0, 0.0], [-2.0, -0.1, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [1.0, 0.0, -1.0, -0.1]])
    for F in (springs[:2, :2], springs):
        n = len(F)
        G = np.zeros((n, 1))
        G[-1] = 1.0
        AB = expm(0.3 * np.block([[F, G], [np.zeros((1, n + 1))]]))
        logs = []
        for _ in range(12):
            x, U = rng.uniform(-1, 1, n), rng.uniform(-1, 1, (40, 1))
            X = [x]
            for u in U:
                X.append(AB[:n, :n] @ X[-1] + AB[:n, n:] @ u)
            logs.append(km.Episode(X=np.array(X)[:, :1] + 1e-3 * rng.standard_normal((41, 1)), U=U))
        data = km.Episodes(logs, dt=0.3)
        chosen = select(data, horizon=10, candidates=[km.State() + km.Constant()], bilinear=False)
        found.append(max(row.delays for row in chosen.leaderboard))
    assert found == [2, 4]
