"""Every controller under every fault: none raises, inputs stay in their limits and rates, runs repeat to the bit."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.example_plants import Swing
from tests.loop.test_faults import Recorded

COST = km.Cost(Q=[10.0, 1.0], R=0.1)
BOX = km.Limits(u_min=-3.0, u_max=5.0)
RATED = km.Limits(u_min=-3.0, u_max=5.0, du_max=1.5, x_min=[-2.0, -2.5], x_max=[2.0, 2.5])
GOOD = {km.Status.UNCONSTRAINED, km.Status.OPTIMAL, km.Status.SOFTENED, km.Status.SATURATED}
ORIGIN = ([0.0, 0.0], [0.0])


PLANT = km.discretize(Swing(), 0.1)
BUILD = {
    "lqr": lambda linear, _: (km.LQR(km.LinearPredictor.local(PLANT, *ORIGIN), COST, RATED), RATED),
    "koopman-lqr": lambda linear, _: (km.LQR(linear, COST, RATED), RATED),
    "linear-mpc": lambda linear, _: (km.LinearMPC(PLANT, *ORIGIN, COST, RATED, 8), RATED),
    "koopman-mpc": lambda linear, _: (km.KoopmanMPC(linear, COST, RATED, 8), RATED),
    "koopman-mpc, daqp": lambda linear, _: (km.KoopmanMPC(linear, COST, RATED, 8, solver="daqp"), RATED),
    "koopman-mpc, latency": lambda linear, _: (km.KoopmanMPC(linear, COST, RATED, 8, latency=1), RATED),
    "offset-free": lambda linear, _: (
        km.KoopmanMPC(linear, COST, RATED, 8, estimator=km.LiftedDisturbance()),
        RATED,
    ),
    "bilinear-mpc": lambda _, bilinear: (km.BilinearMPC(bilinear, COST, BOX, 8), BOX),
    "nonlinear-mpc": lambda *_: (km.NonlinearMPC(PLANT, COST, BOX, 4), BOX),
}


@pytest.fixture(scope="module")
def models():
    data = km.collect(PLANT, km.Uniform([-2, -2], [2, 2]), km.Noise(-3, 3), episodes=60, steps=15)
    lifting = km.State() + km.Fourier(1, states="theta") + km.Constant()
    return km.edmd(data, lifting), km.bilinear_edmd(data, lifting)


@pytest.fixture(scope="module")
def controllers(models):
    return {name: build(*models) for name, build in BUILD.items() if "daqp" not in name or _daqp()}


def _daqp():
    try:
        import daqp  # noqa: F401
    except ImportError:
        return False
    return True


STEPS = 8
SHARE = st.floats(0.0, 1.0)
WINDOW = st.tuples(st.integers(0, 5), st.none() | st.integers(1, 5)).map(
    lambda w: {"begin": w[0], "end": None if w[1] is None else w[0] + w[1]}
)
CHANNELS = st.sampled_from([None, (0,), (1,)])
FAULTS = {  # built in the test: the type hook picks at random what it checks, and strategies must not
    "NaN sensor": st.tuples(st.just(km.faults.NaNSensor), st.tuples(CHANNELS, SHARE), WINDOW),
    "frozen sensor": st.tuples(st.just(km.faults.FrozenSensor), st.tuples(CHANNELS), WINDOW),
    "dropped samples": st.tuples(st.just(km.faults.DroppedSamples), st.tuples(SHARE), WINDOW),
    "half the actuator": st.tuples(st.just(km.faults.ActuatorLoss), st.just((0.5,)), WINDOW),
    "sensor delay": st.tuples(st.just(km.faults.SensorDelay), st.tuples(st.integers(1, 4)), st.just({})),
    "actuator delay": st.tuples(st.just(km.faults.ActuatorDelay), st.tuples(st.integers(1, 4)), st.just({})),
    "failing solver": st.tuples(st.just(km.faults.SolverFailure), st.tuples(SHARE), WINDOW),
}
SETS = {name: st.lists(fault, min_size=1, max_size=1) for name, fault in FAULTS.items()}
SETS["several"] = st.lists(st.one_of(*FAULTS.values()), min_size=2, max_size=5)


def run_of(controller, limits, faults, seed, x0):
    return km.simulate(
        PLANT,
        controller,
        x0=x0,
        reference=[0.0, 0.0],
        steps=STEPS,
        cost=COST,
        limits=limits,
        options=km.loop.LoopOptions(faults=faults, noise=[0.01, 0.02], rng=seed),
    )


@pytest.mark.parametrize("name", BUILD)
@pytest.mark.parametrize("what", SETS)
@settings(max_examples=3)
@given(data=st.data())
def test_none_raises_or_leaves_its_limits_and_runs_repeat(controllers, name, what, data):
    if name not in controllers:
        pytest.skip("daqp is not installed: pip install koopmpc[daqp]")
    controller, limits = controllers[name]
    faults = [kind(*arguments, **window) for kind, arguments, window in data.draw(SETS[what])]
    seed = data.draw(st.integers(0, 2**31))
    x0 = data.draw(st.tuples(st.floats(-3.0, 3.0), st.floats(-4.0, 4.0)))
    watched = Recorded(controller)
    run = run_of(watched, limits, faults, seed, x0)
    low, high = limits.inputs(1)
    given = np.array([move.u for move in watched.moves])
    told = np.array([np.zeros(controller.nu) if applied is None else applied for applied in watched.told])
    for u in (given, run.U):
        assert np.isfinite(u).all()
        assert ((low <= u) & (u <= high)).all()
    if limits.du_max is not None and name != "koopman-mpc, latency":
        assert (given <= np.maximum(told + limits.du_max, low)).all()
        assert (given >= np.minimum(told - limits.du_max, high)).all()
    figures = km.metrics(run)
    assert figures.input_violation == 0
    assert figures.status == Counter(status.name for status in run.status)
    assert sum(figures.fallback.values()) == sum(figures.status.values()) == STEPS
    for status, fallback in zip(run.status, run.fallback, strict=True):
        assert (fallback is km.control.Fallback.NONE) == (status in GOOD)
    again = run_of(Recorded(controller), limits, faults, seed, x0)
    assert replace(again, solve_time=run.solve_time) == run
