"""A wild measured disturbance is not learned: the next reading shows which w was wild, and the last one is used."""

from functools import cache

import numpy as np
import pytest

import koopmpc as km
from tests.compiler import needs_compiler
from tests.estimate.plants import linear

NOISE, AT = 1e-3, 40
A, B, E = np.array([[1.02, 0.1], [0.2, 0.95]]), np.array([[0.0], [0.1]]), np.array([[0.0], [0.05]])
LOAD = np.array([0.0, 0.02])
COST, LIMITS = km.Cost(Q=[10.0, 1.0], R=0.1), km.Limits(u_min=-10, u_max=10)


def rows():
    rng, episodes = np.random.default_rng(0), []
    for _ in range(20):
        X, U, W = [rng.uniform(-1, 1, 2)], rng.uniform(-2, 2, (30, 1)), rng.uniform(-1, 1, (30, 1))
        for u, w in zip(U, W, strict=True):
            X.append(A @ X[-1] + B @ u + E @ w)
        episodes.append(km.Episode(X=np.array(X), U=U, W=W))
    return km.Episodes(episodes, 0.1, ["x0", "x1"], ["u0"], ["w0"])


@cache
def model(kind):
    lifting = km.State() + km.Constant()
    return {
        "linear": lambda: linear(A, B, [0.0, 0.0], E),
        "bilinear": lambda: km.bilinear_edmd(rows(), lifting, ridge=1e-9),
        "late": lambda: km.edmd(rows(), lifting, embedding=km.Delay(1), ridge=1e-9),
    }[kind]()


LEARNS = km.LiftedDisturbance()
FILTER = km.LiftedKalman(("x0", "x1"))
KINDS = {
    "disturbance": lambda: km.KoopmanMPC(model("linear"), COST, LIMITS, 10, estimator=LEARNS),
    "filter": lambda: km.KoopmanMPC(model("linear"), COST, LIMITS, 10, estimator=FILTER),
    "delays": lambda: km.KoopmanMPC(model("late"), COST, LIMITS, 10),
    "delays, disturbance": lambda: km.KoopmanMPC(model("late"), COST, LIMITS, 10, estimator=LEARNS),
    "bilinear": lambda: km.BilinearMPC(model("bilinear"), COST, LIMITS, 10, estimator=LEARNS),
    "LQR": lambda: km.LQR(model("late"), COST, LIMITS),
    "latency": lambda: km.KoopmanMPC(model("linear"), COST, LIMITS, 10, estimator=LEARNS, latency=1),
    "period": lambda: km.KoopmanMPC(model("linear"), COST, LIMITS, 10, estimator=km.LiftedDisturbance(period=2.0)),
    "extended": lambda: km.BilinearMPC(model("bilinear"), COST, LIMITS, 10, estimator=km.ExtendedKalman()),
}
IN_C = [kind for kind in KINDS if kind not in ("period", "extended")]


@cache
def built(kind):
    return KINDS[kind]()


def loop(kind, wild=(), step=0.0, steps=66, controller=None):
    """`wild` is added to what the controller is told of w from step 40 on, `step` to w itself. Return X, U, refused."""
    controller = controller or built(kind)
    rng, x, load = np.random.default_rng(1), np.array([0.5, 0.0]), LOAD if kind != "LQR" else 0  # it learns none
    noise, w = NOISE * rng.normal(size=(steps, 2)), 0.02 * rng.normal(size=(steps, 1))
    w[AT:] += step
    told, late = w.copy(), [np.zeros(1)] * (kind == "latency")
    told[AT : AT + len(wild), 0] += wild
    controller.reset(x)
    X, U, refused = [], [], []
    for k in range(steps):
        move = controller(x + noise[k], [0.2, -0.04], w=told[k])
        late.append(move.u)
        x = A @ x + B @ late.pop(0) + E @ w[k] + load
        X.append(x)
        U.append(move.u)
        refused.append(bool(move.refused))
    return np.array(X), np.array(U), np.array(refused)


def wild(size, length):
    return size * np.random.default_rng(length).choice([-1.0, 1.0], length)


@pytest.mark.parametrize("length", [1, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_a_loop_comes_back_after_a_wild_disturbance(kind, length):
    X, _, refused = loop(kind)
    assert not refused.any()
    for size in (50.0, 1e29) if kind in ("bilinear", "extended") else (50.0, 1e6, 1e15, 1e29):
        away = np.abs(loop(kind, wild(size, length))[0] - X) / np.ptp(X, axis=0)
        assert (away[AT + length + 15 :] <= 0.1).all(), size


@pytest.mark.parametrize("kind", KINDS)
def test_a_true_step_of_the_disturbance_is_used_at_once(kind):
    """The model predicts its effect, and the readings show it: the loop hardly feels a step of fifty usual sizes."""
    X, U, _ = loop(kind)
    X_s, U_s, refused = loop(kind, step=1.0)
    assert not refused.any()
    first = AT + 1 + (kind == "latency")
    assert np.abs(X_s - X)[first:].max() < 0.1
    assert U_s[AT, 0] < U[AT, 0] - 0.2


@needs_compiler
@pytest.mark.parametrize("kind", IN_C)
def test_machine_code_finds_the_same_disturbances_wild(kind):
    controller = built(kind)
    code = km.compiled(controller)
    assert code is not controller
    for size, length in ((50.0, 7), (1e6, 5), (1e29, 1)):
        expected, got = loop(kind, wild(size, length)), loop(kind, wild(size, length), controller=code)
        np.testing.assert_array_equal(got[2], expected[2])
        np.testing.assert_allclose(got[1], expected[1], atol=1e-4)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", KINDS)
def test_an_infinite_disturbance_is_a_bad_measurement_without_a_warning(kind):
    controller = built(kind)
    for big in (1e155, 1e200, -np.inf, np.nan):
        controller.reset([0.5, 0.0])
        statuses = [controller([0.5, 0.0], [0.2, -0.04], w=[w]).status.name for w in (0.01, big, 0.01)]
        assert [name == "BAD_MEASUREMENT" for name in statuses] == [False, True, False]
