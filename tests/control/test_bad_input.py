"""Input that cannot be meant so is refused with a sentence; input that is merely unusual is answered."""

import numpy as np
import pytest

import koopmpc as km
from tests.bare import shown
from tests.searches import select

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
MODEL = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("p", "v"), ("u",))
COST = km.Cost(1, 0.1)
CONTROLLERS = (km.KoopmanMPC, km.BilinearMPC, km.NonlinearMPC)


def loop(rows):
    """Run ten steps under a u_target of these rows."""
    cost = km.Cost(1, 1, u_target=rows)
    mpc = km.KoopmanMPC(MODEL, cost, None, 5)
    return km.simulate(MODEL.step_map(), mpc, x0=[0, 0], reference=[0, 0], steps=10, cost=cost)


REFUSED = {
    "a negative tail": (lambda: km.Cost(1, 1, tail=-1), r"tail is -1; it must be at least 0"),
    "Q_N and a tail": (
        lambda: km.Cost(1, 1, Q_N=1.0, tail=3),
        r"Q_N and tail = 3 are given; Q_N takes the tail's place: pass one of them",
    ),
    "too few rows of u_target": (
        lambda: loop(np.zeros((3, 1))),
        r"u_target has 3 rows, the run 10 steps; pass one row, or one a step",
    ),
    "rows of u_target for two inputs": (
        lambda: loop(np.zeros((3, 2))),
        r"u_target has shape \(3, 2\), expected \(1,\) or rows \(k, 1\), one value an input",
    ),
    "an estimator that cannot see p": (
        lambda: km.KoopmanMPC(MODEL, COST, None, 5, estimator=km.LiftedKalman("v")),
        r"not detectable from v: with λ = 1, 'p' can move without a trace in y; measure one of them, drop it from",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_it_is_refused_with_what_was_got_and_what_to_do(what):
    make, sentence = REFUSED[what]
    with pytest.raises((km.errors.DataError, km.errors.ShapeError), match=sentence):
        make()


def test_a_tail_of_nan_and_settings_without_names_are_refused():
    lines = shown(
        'show(lambda: km.Cost(1, 1, tail=float("nan")))\n'
        "model = km.LinearPredictor([[1.0]], [[1.0]], [[1.0]], km.State(), 0.1, ('p',), ('u',))\n"
        "show(lambda: km.KoopmanMPC(model, km.Cost(1, 1), None, 5, settings=3))"
    )
    assert lines[0] == "DataError tail is nan; pass a whole number"
    assert lines[1].startswith("DataError settings is an int, expected a Mapping; pass the solver's own by name")


@pytest.mark.parametrize("kind", CONTROLLERS)
def test_a_u_target_outside_the_limits_is_refused_by_every_controller(kind):
    sentence = r"u_target is 2 for input 0 in row 0, outside its limits -1 … 1; pass inputs that the limits allow"
    with pytest.raises(km.errors.DataError, match=sentence):
        kind(MODEL, km.Cost(1, 1, u_target=[2.0]), km.Limits(-1, 1), 5)


@pytest.mark.parametrize("kind", CONTROLLERS)
def test_limits_without_width_or_with_one_end_are_limits(kind):
    assert kind(MODEL, COST, km.Limits(0.5, 0.5), 5)([0.2, 0], [0, 0]).u == pytest.approx(0.5)
    soft = kind(MODEL, COST, km.Limits(-1, 1, x_min=[-np.inf, 0], x_max=[np.inf, 0]), 5)([0, 0.05], [1, 0])
    assert soft.status is km.Status.OPTIMAL
    assert soft.u == pytest.approx(-0.5, abs=1e-3)  # v is at its only value after one step
    upper = kind(MODEL, COST, km.Limits(x_max=[np.inf, 0.1]), 5)([0, 0], [50, 0])
    assert upper.u == pytest.approx(1.0, abs=1e-3)


def test_a_state_that_never_moved_in_the_data_may_have_a_limit():
    """Neither its range nor a cost says how large it is; its slack then counts by |limit|."""
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(5):
        U, X = rng.uniform(-1, 1, (40, 1)), np.ones((41, 2))
        for k in range(40):
            X[k + 1, 1] = 0.9 * X[k, 1] + U[k, 0]
        episodes.append(km.Episode(X=X, U=U))
    model = km.edmd(km.Episodes(episodes, 0.1, ["p", "v"], ["u"]), km.State())
    mpc = km.KoopmanMPC(model, km.Cost([0, 1], 0.1), km.Limits(-1, 1, x_max=[2, 1]), 5)
    assert mpc([1, 0.5], [1, 0]).status is km.Status.UNCONSTRAINED
    assert mpc([3, 0.5], [1, 0]).status is km.Status.SOFTENED


def episodes(count, steps, still=None):
    """Return episodes of a driven first-order lag v and its integral p; the column `still` is constant."""
    rng, found = np.random.default_rng(0), []
    for _ in range(count):
        U, X = rng.uniform(-1, 1, (steps, 1)), np.zeros((steps + 1, 2))
        if still == "u":
            U[:] = 0.5
        X[0] = rng.uniform(-1, 1, 2)
        for k in range(steps):
            X[k + 1] = X[k, 0] + 0.1 * X[k, 1], 0.9 * X[k, 1] + 0.2 * U[k, 0] + 0.01 * rng.standard_normal()
        if still == "p":
            X[:, 0] = 3.0
        found.append(km.Episode(X=X, U=U))
    return km.Episodes(found, 0.1, ["p", "v"], ["u"])


FEW = {"candidates": [km.State() + km.Constant()], "horizon": 10, "delays": [0], "ridges": [1e-6], "bilinear": False}


def test_select_cuts_one_episode_into_blocks_says_so_and_its_model_controls():
    found = select(episodes(1, 200), **FEW)
    assert "1 episode is too few for 5 folds: cut into" in str(found)
    mpc = km.KoopmanMPC(found.predictor, COST, km.Limits(-1, 1), 10)
    assert mpc([0.5, 0.0], [0.0, 0.0]).status in (km.Status.UNCONSTRAINED, km.Status.OPTIMAL)


def test_select_refuses_one_episode_that_is_too_short():
    with pytest.raises(
        km.errors.DataError, match=r"choice needs two of 10 steps or more, or one of 40: pass a shorter horizon"
    ):
        select(episodes(1, 15), **FEW)


@pytest.mark.parametrize("still", ["p", "u"])
@pytest.mark.filterwarnings("ignore:feedback made A and B inseparable")
def test_select_says_which_column_is_constant_and_its_model_controls(still):
    with pytest.warns(km.FitWarning, match=f"{still} is constant in these data, so what it does cannot be learned"):
        found = select(episodes(8, 40, still), **FEW)
    mpc = km.KoopmanMPC(found.predictor, COST, km.Limits(-1, 1, x_max=[4, 1]), 10)
    assert np.abs(mpc([3.0, 0.5], [3.0, 0.0]).u).max() <= 1.0


TWO = km.LinearPredictor(
    [[1.05, 0.1], [0.08, 1.0]], [[0.1, 0.02], [0.0, 0.2]], np.eye(2), km.State(), 0.1, ("a", "b"), ("u", "v")
)
WEIGHTS, RATES = km.Cost(Q=[1, 2], R=0.3, R_delta=0.1), km.Limits(-0.8, 0.8, du_max=0.3)
MAKERS = {
    "lqr": lambda: km.LQR(TWO, WEIGHTS, RATES),
    "koopman": lambda: km.KoopmanMPC(TWO, WEIGHTS, RATES, 6, solver="daqp"),
    "estimating": lambda: km.KoopmanMPC(TWO, WEIGHTS, RATES, 6, solver="daqp", estimator=km.LiftedDisturbance(0.3)),
    "bilinear": lambda: km.BilinearMPC(TWO, WEIGHTS, RATES, 6),
    "nonlinear": lambda: km.NonlinearMPC(TWO, WEIGHTS, RATES, 6),
}


@pytest.mark.parametrize("kind", list(MAKERS))
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e31])
def test_what_is_no_number_in_one_place_is_as_if_nothing_were_told(kind, value):
    """An applied input that is partly known is not used; a reference of which a part is none makes no plan."""
    told, other = MAKERS[kind](), MAKERS[kind]()
    x = np.array([0.5, -0.4])
    for k in range(4):
        a, b = told(x, [0.1, 0.0], [0.2, value] if k else None), other(x, [0.1, 0.0])
        assert a.status is b.status
        np.testing.assert_allclose(a.u, b.u, atol=1e-9)
        x = TWO.A @ x + TWO.B @ a.u
    for mpc in (told, other):
        mpc.solver_fails = False
    failed = told(x, [0.1, value], [0.0, value])
    assert failed.status is km.Status.BAD_MEASUREMENT
    again = other([0.5, value], [0.1, 0.0])
    assert again.status is km.Status.BAD_MEASUREMENT
    np.testing.assert_allclose(failed.u, again.u, atol=1e-9)
    for mpc in (told, other):  # the next step goes on
        assert mpc(x, [0.1, 0.0]).fallback is km.control.Fallback.NONE


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_a_reading_whose_forecast_leaves_all_numbers_is_no_exception(solver):
    A, B = np.array([[1.3, 0.3], [0.0, 0.9]]), np.array([[0.0], [0.5]])
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("p", "q"), ("u",))
    mpc = km.KoopmanMPC(model, km.Cost(1.0, 0.1), km.Limits(-1, 1, x_max=[1.0, 2.0]), 15, solver=solver)
    twin = km.compiled(mpc)
    for y in ([1e29, 1e29], [9e29, 9e29], [0.1, 0.2]):
        move, other = mpc(y, [0, 0]), twin(y, [0, 0])
        assert np.abs(move.u).max() <= 1
        assert solver == "osqp" or (move.status, move.fallback) == (other.status, other.fallback)
    assert move.status in (km.Status.OPTIMAL, km.Status.UNCONSTRAINED)
