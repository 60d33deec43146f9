"""Wild readings: they do not enter an estimate or a history of delays; a real change does, six steps later."""

from functools import cache

import numpy as np
import pytest

import koopmpc as km
from tests.compiler import avoid_compiling, needs_compiler
from tests.control.test_random_bilinear_loops import PLANTS as OSCILLATORS
from tests.estimate.pendulums import PROBLEM, truth
from tests.estimate.plants import linear
from tests.tiers import few

NOISE = 1e-3
WHOLE = km.Cost(Q=[10.0, 1.0], R=0.1)
LIMITS = km.Limits(u_min=-25, u_max=25)
TRUE = truth(m=1.2)
LIFTING = km.State() + km.Fourier(1, states="theta") + km.Constant()
STEPS, WILD = 70, 45
REFUSALS, BRIDGED = 6, 5  # readings in sequence that are refused; and missed ones that are bridged


@cache
def data():
    plant = km.discretize(PROBLEM.dynamics, PROBLEM.dt)
    pd = km.Feedback([[40, 15]], km.Noise(-20, 20), u_min=-25, u_max=25)
    clean, rng = km.collect(plant, km.Uniform([-1, -1], [1, 1]), pd, episodes=60, steps=60), np.random.default_rng(0)
    seen = [km.Episode(X=e.X + NOISE * rng.normal(size=e.X.shape), U=e.U) for e in clean]
    return km.Episodes(seen, clean.dt, clean.states, clean.inputs)


@cache
def model(kind):
    plain, two = km.State() + km.Constant(), km.Delay(2)
    return {
        "linear": lambda: km.edmd(data(), LIFTING),
        "bilinear": lambda: km.bilinear_edmd(data(), LIFTING, ridge=1e-6),
        "late": lambda: km.edmd(data(), plain, embedding=two, ridge=1e-4),
        "late bilinear": lambda: km.bilinear_edmd(data(), plain, embedding=km.Delay(1), ridge=1e-3),
    }[kind]()


LEARNS = km.LiftedDisturbance()
FILTER = km.LiftedKalman(("theta", "omega"))
KINDS = {
    "KoopmanMPC, disturbance": lambda: km.KoopmanMPC(model("linear"), WHOLE, LIMITS, 20, estimator=LEARNS),
    "KoopmanMPC, filter": lambda: km.KoopmanMPC(model("linear"), WHOLE, LIMITS, 20, estimator=FILTER),
    "LinearMPC": lambda: km.LinearMPC(
        km.discretize(PROBLEM.dynamics, PROBLEM.dt), [0, 0], [0], WHOLE, LIMITS, 20, estimator=LEARNS
    ),
    "BilinearMPC": lambda: km.BilinearMPC(model("bilinear"), WHOLE, LIMITS, 20, estimator=LEARNS),
    "KoopmanMPC, delays": lambda: km.KoopmanMPC(model("late"), WHOLE, LIMITS, 20, estimator=LEARNS),
    "BilinearMPC, delays": lambda: km.BilinearMPC(model("late bilinear"), WHOLE, LIMITS, 20, estimator=LEARNS),
    "LQR, delays": lambda: km.LQR(model("late"), WHOLE, LIMITS),
}


@cache
def built(kind):
    return KINDS[kind]()


def loop(controller, seed, wild=None, plant=TRUE, steps=STEPS, at=WILD):
    """A run from a random start; `wild` (steps, 2) is added to the readings from step 45 on. Return X, U, d, refused."""
    rng = np.random.default_rng(seed)
    x, reference, noise = rng.uniform(-0.6, 0.6, 2), [rng.uniform(-0.5, 0.5), 0], NOISE * rng.normal(size=(steps, 2))
    controller.reset(x)
    X, U, D, refused = [x], [], [], []
    observer = getattr(controller, "observer", None)
    for k in range(steps):
        y = x + noise[k]
        if wild is not None and 0 <= k - at < len(wild):
            y = y + wild[k - at]
        move = controller(y, reference)
        x = plant(x, move.u)
        X.append(x)
        U.append(move.u)
        D.append(np.zeros(2) if observer is None else observer.d[:2].copy())
        refused.append(bool(move.refused))
    return np.array(X), np.array(U), np.array(D), np.array(refused)


def burst(size, length, seed):
    return size * np.random.default_rng(seed).choice([-1.0, 1.0], (length, 2))


@pytest.mark.parametrize("length", [1, 5])
@pytest.mark.parametrize("size", [50.0, 1e6, 1e29])
@pytest.mark.parametrize("kind", KINDS)
def test_ten_steps_after_wild_readings_the_loop_is_where_it_would_be_without_them(kind, size, length):
    controller = built(kind)
    plant = km.discretize(PROBLEM.dynamics, PROBLEM.dt) if kind == "LQR, delays" else TRUE  # it learns no disturbance
    X, U, D, refused = loop(controller, 1, plant=plant)
    assert not refused.any()
    X_w, U_w, D_w, refused_w = loop(controller, 1, burst(size, length, 2), plant)
    assert np.flatnonzero(refused_w).tolist() == list(range(WILD, WILD + length))
    after, extent = WILD + length + 9, np.ptp(X, axis=0)
    assert (np.abs(X_w - X)[after:] <= 0.01 * extent).all()
    assert (np.abs(D_w - D)[after:] <= 0.01 * extent).all()
    assert np.abs(U_w - U).max() < 0.1 * np.ptp(U)  # what the predictions ask, not what the readings would


@pytest.mark.parametrize("length", [1, 5])
@pytest.mark.parametrize("kind", ["KoopmanMPC, disturbance", "KoopmanMPC, filter", "KoopmanMPC, delays"])
def test_twenty_spreads_of_the_innovations_are_wild(kind, length):
    controller = built(kind)
    gate, innovations = controller.observer._gate, []
    judge = gate.judge
    gate.judge = lambda y, predicted: innovations.append(y - predicted) or judge(y, predicted)
    try:
        X, _, D, refused = loop(controller, 3, steps=130)
    finally:
        del gate.judge
    spread = np.std(innovations[80:], axis=0)
    wild = np.zeros((65 + length, 2))
    wild[65:] = burst(20 * spread, length, 4)
    X_w, _, D_w, refused_w = loop(controller, 3, wild, steps=130)
    assert refused_w.sum() == length
    assert not refused.any()
    after = WILD + 65 + length + 9
    assert (np.abs(X_w - X)[after:] <= 0.01 * np.ptp(X, axis=0)).all()
    assert (np.abs(D_w - D)[after:] <= 0.01 * np.ptp(X, axis=0)).all()


A, B = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[0.0], [0.3]])


@pytest.mark.parametrize(("estimator", "left"), [(km.LiftedDisturbance(), 0.03), (km.LiftedKalman(("x0", "x1")), 0.1)])
@pytest.mark.parametrize("spreads", [20, 200])
def test_a_load_step_is_refused_for_six_steps_and_learned_within_ten_more(estimator, left, spreads):
    cost = km.Cost(Q=[1.0, 0.0], R=0.1)
    mpc = km.KoopmanMPC(linear(A, B, [0.0, 0.0]), cost, km.Limits(-5, 5), 20, estimator=estimator)
    rng, x, load, refused = np.random.default_rng(0), np.zeros(2), spreads * NOISE * np.ones(2), []
    for k in range(200 + 1 + REFUSALS + 10):
        move = mpc(x + NOISE * rng.normal(size=2), [0.5 if k < 60 else 0.2, 0.0])
        refused.append(move.refused)
        x = A @ x + B @ move.u + (load if k >= 200 else 0)
    assert sum(refused) in ((0, REFUSALS) if spreads == 20 else (REFUSALS,))
    assert (np.abs(mpc.observer.d[:2] - load) < left * load + 3 * NOISE).all()


def test_readings_that_stay_wild_are_used_after_six_steps():
    controller = built("KoopmanMPC, disturbance")
    refused = loop(controller, 1, np.full((STEPS - WILD, 2), 0.5))[3]
    assert np.flatnonzero(refused)[:REFUSALS].tolist() == list(range(WILD, WILD + REFUSALS))
    assert not refused[WILD + REFUSALS]


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("length", [1, 5])
def test_absurd_readings_are_refused_from_the_third_on(kind, length):
    controller, rng = built(kind), np.random.default_rng(0)
    controller.reset()
    x, refused = np.array([0.4, 0.1]), []
    for k in range(70):
        wild = burst(1e7, length, 3)[k - 3] if 3 <= k < 3 + length else 0
        move = controller(x + NOISE * rng.normal(size=2) + wild, [0.0, 0.0])
        refused.append(move.refused)
        x = TRUE(x, move.u)
    assert np.flatnonzero(refused)[:length].tolist() == list(range(3, 3 + length))
    assert (np.abs(x) < [0.05, 0.2]).all()


PERIODIC, EXTENDED = "KoopmanMPC, period", "BilinearMPC, extended filter"
MORE = KINDS | {
    PERIODIC: lambda: km.KoopmanMPC(
        model("linear"), WHOLE, LIMITS, 20, estimator=km.LiftedDisturbance(period=20 * PROBLEM.dt)
    ),
    EXTENDED: lambda: km.BilinearMPC(model("bilinear"), WHOLE, LIMITS, 20, estimator=km.ExtendedKalman()),
}


def plant_for(kind):
    return km.discretize(PROBLEM.dynamics, PROBLEM.dt) if kind in ("LQR, delays", EXTENDED) else TRUE


@pytest.mark.parametrize("kind", few(MORE, *(kind for kind in MORE if kind != "BilinearMPC")))
def test_an_absurd_reading_among_the_first_does_not_stay_in_the_estimate(kind):
    """Nothing has been shown yet by which it could be refused: it is used, and the next reading shows what it was."""
    controller, plant = MORE[kind](), plant_for(kind)
    X = loop(controller, 1, plant=plant, steps=110)[0]
    for at in range(3):
        for size in (1e6, 1e29):
            for missed in (False, True):
                wild = burst(size, 2, 2)
                wild[0] = np.nan if missed else wild[0]
                X_w = loop(controller, 1, wild if missed else wild[:1], plant, 110, at)[0]
                away = np.abs(X_w - X) / np.ptp(X, axis=0)
                assert (away[at + 15 :] <= 0.4).all(), (at, size, missed)
                assert (away[-20:] <= 0.05).all(), (at, size, missed)


@pytest.mark.parametrize("kind", MORE)
@pytest.mark.parametrize("missed", [1, BRIDGED])
def test_a_wild_reading_after_missed_ones_is_refused(kind, missed):
    controller, plant = MORE[kind](), plant_for(kind)
    X, _, _, refused = loop(controller, 1, plant=plant)
    assert not refused.any()
    wild = np.vstack([np.full((missed, 2), np.nan), burst(50.0, 1, 2)])
    X_w, _, _, refused_w = loop(controller, 1, wild, plant)
    assert np.flatnonzero(refused_w).tolist() == [WILD + missed]
    assert (np.abs(X_w - X)[WILD + missed + 12 :] <= 0.06 * np.ptp(X, axis=0)).all()


@pytest.mark.parametrize("kind", MORE)
def test_six_absurd_readings_are_refused_and_one_that_is_used_does_not_stay_in_the_estimate(kind):
    controller, plant = MORE[kind](), plant_for(kind)
    X = loop(controller, 1, plant=plant, steps=110)[0]
    for count, most, left in ((REFUSALS, 0.2, 0.1), (REFUSALS + 2, 1.0, 0.25)):
        X_w, _, _, refused = loop(controller, 1, burst(1e29, count, 2), plant, 110)
        assert np.flatnonzero(refused)[:REFUSALS].tolist() == list(range(WILD, WILD + REFUSALS))
        away = np.abs(X_w - X) / np.ptp(X, axis=0)
        assert (away <= most).all()
        assert (away[-20:] <= left).all()


@pytest.mark.parametrize("estimator", [LEARNS, km.LiftedKalman(("x0", "x1"))])
@pytest.mark.parametrize("noise", [1e-17, 1e-6])
def test_what_keeps_a_plant_at_rest_is_learned(estimator, noise):
    """A stuck valve: all that is shown is rounding, and each prediction is off by far more."""
    model, rng, u = linear([[1, 0.1], [0, 0.9]], [[0], [0.1]]), np.random.default_rng(0), np.zeros(1)
    mpc = km.KoopmanMPC(model, km.Cost(1, 0.1), km.Limits(-1, 1), 20, estimator=estimator)
    for _ in range(60):
        u = mpc(noise * rng.normal(size=2), [1.0, 0]).u
    np.testing.assert_allclose(mpc.observer.d, -model.B @ u, atol=1e-3)


@pytest.mark.parametrize("kind", ["KoopmanMPC, filter", EXTENDED])
def test_a_wild_entry_beside_a_missing_one_is_refused(kind):
    refused = loop(MORE[kind](), 1, np.array([[np.nan, 50.0]]), plant_for(kind))[3]
    assert np.flatnonzero(refused).tolist() == [WILD]


@pytest.mark.parametrize("kind", ["KoopmanMPC, filter", EXTENDED])
@pytest.mark.parametrize("missing", [0, 1])
def test_an_estimate_that_is_lost_while_an_entry_is_missing_comes_back(kind, missing):
    controller, plant, wild = MORE[kind](), plant_for(kind), np.zeros((1 + BRIDGED, 2))
    X = loop(controller, 1, plant=plant, steps=110)[0]
    wild[1:, missing] = np.nan
    for at in range(3):
        for wild[0] in (1e6, 1e29):
            away = np.abs(loop(controller, 1, wild, plant, 110, at)[0] - X) / np.ptp(X, axis=0)
            assert (away[at + 15 :] <= 0.4).all(), at
            assert (away[-20:] <= 0.05).all(), at


def test_what_moves_a_plant_from_rest_is_no_absurd_reading_for_long():
    mpc, x, refused = km.KoopmanMPC(model("linear"), WHOLE, LIMITS, 20, estimator=LEARNS), np.zeros(2), 0
    for k in range(150):
        move = mpc(x, [0.0, 0.0])
        refused += move.refused
        x = TRUE(x, move.u) + (np.array([0.0, 1.0]) if k == 4 else 0)
    assert refused <= REFUSALS
    assert np.abs(x).max() < 0.02


def test_the_run_of_a_loop_holds_which_readings_were_refused():
    class Wild(km.faults.Fault):
        def start(self, wiring, rng):
            return km.faults.Injection(measured=lambda k, y: y + 1e6 * (20 <= k < 23))

    mpc = built("KoopmanMPC, disturbance")
    run = km.simulate(
        TRUE, mpc, x0=[0.4, 0.0], reference=[0.0, 0.0], steps=40, options=km.loop.LoopOptions(faults=[Wild()])
    )
    assert np.flatnonzero(run.refused).tolist() == [20, 21, 22]
    assert run.refused.dtype == np.int64


def test_a_missing_entry_is_neither_judged_nor_refused():
    mpc = built("KoopmanMPC, filter")
    x = np.array([0.2, 0.0])
    mpc.reset(x)
    for k in range(40):
        move = mpc([x[0], np.nan] if k == 30 else x, [0.0, 0.0])
        assert not move.refused
        x = TRUE(x, move.u)


@needs_compiler
@pytest.mark.parametrize("kind", few(KINDS, *(kind for kind in KINDS if kind != "BilinearMPC, delays")))
def test_machine_code_refuses_the_same_readings(kind):
    controller, wild = built(kind), np.zeros((18, 2))
    code = km.compiled(controller)
    assert code is not controller
    wild[[0, 1, 6, 12, 13, 14, 15, 16]] = burst(50.0, 8, 5)
    steps = WILD + 40
    expected, got = loop(controller, 1, wild, steps=steps), loop(code, 1, wild, steps=steps)
    assert expected[3].sum() == got[3].sum() == 8
    np.testing.assert_array_equal(got[3], expected[3])
    np.testing.assert_allclose(got[1], expected[1], atol=5e-4 if "Bilinear" in kind else 1e-6)
    wild[[1, 2, 14]] = np.nan
    wild[[3, 15]] = burst(1e7, 2, 6)
    for at in (0, 1, WILD):
        expected, got = loop(controller, 2, wild, at=at), loop(code, 2, wild, at=at)
        np.testing.assert_array_equal(got[3], expected[3])
        np.testing.assert_allclose(got[1], expected[1], atol=5e-4 if "Bilinear" in kind else 1e-6)


@pytest.mark.parametrize("count", [pytest.param(1000, marks=pytest.mark.slow), 30])
def test_no_loop_is_lost_to_wild_readings(count):
    """Random starts, plants, sizes from 20 noises to 1e29, bursts of one to five at random moments."""
    controller, rng = built("KoopmanMPC, disturbance"), np.random.default_rng(count)
    plants, lost = [truth(m=m, load=load) for m in (0.8, 1.0, 1.2) for load in (0.0, 2.0)], 0
    for seed in range(count):
        wild, k = np.zeros((STEPS - WILD, 2)), int(rng.integers(0, 15))
        length = int(rng.integers(1, 6))
        wild[k : k + length] = burst(10 ** rng.uniform(-1.7, 29), length, seed)
        X = loop(controller, seed, wild, plants[seed % len(plants)])[0]
        lost += not bool((np.abs(X) < [np.pi, 8.0]).all())
    assert lost == 0


@pytest.mark.parametrize("kind", MORE)
def test_wild_readings_in_a_row_from_the_second_on_are_left_behind(kind):
    """They hide each other; the first true one that follows falls to a share of them that no plant falls to."""
    controller, plant = MORE[kind](), plant_for(kind)
    X = loop(controller, 1, plant=plant, steps=90)[0]
    for at, size in ((0, 1e6), (1, 1e6), (1, 1e29)):
        away = np.abs(loop(controller, 1, burst(size, 5, 2), plant, 90, at)[0] - X) / np.ptp(X, axis=0)
        assert (away[-15:] <= (0.2 if kind == PERIODIC else 0.1)).all(), (at, size)  # harmonics fade over three periods


SIX, TWO = [(1, 1e29), (0, 50.0), (1, 50.0), (0, 50.0), (0, -1e6), (0, 50.0)], [(1, 50.0), (0, 50.0)]


@pytest.mark.parametrize(("plant", "burst"), [(0, SIX), (1, TWO)], ids=["six", "two"])
def test_what_a_nonlinear_model_predicts_from_the_first_wild_readings_is_no_disturbance(plant, burst, monkeypatch):
    """From 50 a cubic spring goes to 3e4: that was learned as d, and let a reading of 50 pass twenty steps later."""
    avoid_compiling(monkeypatch)
    cost, limits = km.Cost(Q=[10.0, 1.0], R=0.1), km.Limits(-3, 3)
    mpc = km.BilinearMPC(OSCILLATORS[plant], cost, limits, 15, estimator=km.LiftedDisturbance())
    wild, x = dict(enumerate(burst, 2)) | {25: (0, 50.0)}, np.array([0.2, 0.1])
    for k in range(26):
        y = x.copy()
        if k in wild:
            y[wild[k][0]] = wild[k][1]
        move = mpc(y, [0.3, 0.0])
        assert k in wild or move.status.name in ("UNCONSTRAINED", "OPTIMAL"), (k, move.status)
        assert np.abs(mpc.observer.d).max() < 1e-6, k
        x = OSCILLATORS[plant](x, move.u)
    assert move.refused
