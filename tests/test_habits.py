"""What users of Python and of other libraries try first: names, versions, printing, hints, DataFrames, state space."""

from importlib.metadata import version

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.bare import shown

PLANT = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
MODEL = km.LinearPredictor.local(PLANT, [0, 0], [0])


def test_the_version_is_that_of_the_package():
    assert km.__version__ == version("koopmpc")


NAMES = ["Limits", "Cost", "simulate", "LinearPredictor", "collect", "LiftedKalman", "lqr"]


def test_signatures_fit_on_a_screen_and_their_annotations_still_name_types():
    lines = shown(  # in a process without beartype, which reads annotations as they are
        "import inspect, typing\n"
        "from numpy.typing import ArrayLike\n"
        f"for name in {NAMES}:\n"
        "    print(name, str(inspect.signature(getattr(km, name))))\n"
        "print(typing.get_type_hints(km.lqr)['A'] == ArrayLike)\n"
        "print(typing.get_type_hints(km.simulate)['x0'] == ArrayLike | None)\n"
        "print('slack' in typing.get_type_hints(km.Limits.__init__))\n",
        fresh=True,
    )
    assert lines[-3:] == ["True"] * 3
    assert [line.split()[0] for line in lines[:-3]] == NAMES
    for line in lines[:-3]:
        assert "_SupportsArray" not in line
        assert "ArrayLike" in line
        assert len(line) < 1500


@pytest.mark.parametrize(("owner", "name", "hint"), [
    (km, "load", "load_episodes"), (km, "EDMD", "km.edmd"), (km, "koopmanmpc", "km.KoopmanMPC"),
    (MODEL, "predict", "model.rollout"), (MODEL, "score", "km.score"),
    (km.KoopmanMPC(MODEL, km.Cost(Q=[1, 1], R=1), None, horizon=5), "solve", r"mpc\(y, reference\)"),
])  # fmt: skip
def test_what_others_call_it_is_answered_with_its_name_here(owner, name, hint):
    with pytest.raises(AttributeError, match=hint):
        getattr(owner, name)
    assert not hasattr(owner, name)


def test_a_run_says_how_it_is_drawn():
    run = km.simulate(PLANT, km.LQR(MODEL, km.Cost(Q=[1, 1], R=1)), x0=[0.1, 0], reference=[0, 0], steps=3)
    with pytest.raises(AttributeError, match=r"km\.plot\.run"):
        run.plot()


def test_a_controller_prints_what_it_is():
    limits = km.Limits(u_min=-8, u_max=8, x_max=[1, np.inf])
    cost = km.Cost(Q=[1, 1], R=1)
    text = repr(km.KoopmanMPC(MODEL, cost, limits, horizon=20))
    for part in (
        "KoopmanMPC",
        "3 observables of theta, omega",
        "horizon 20 = 1 s",
        "-8 ≤ torque ≤ 8",
        "theta ≤ 1",
        "daqp",
    ):
        assert part in text
    alone = km.LinearPredictor([[0.9]], [[1]], [[1]], km.State().bind(["theta"]), 0.05, ["theta"], ["u"])
    assert "(1 observable of theta;" in repr(km.KoopmanMPC(alone, km.Cost(Q=[1], R=1), None, horizon=5))
    assert "horizon 5" in repr(km.NonlinearMPC(PLANT, cost, limits, horizon=5))
    assert repr(km.LQR(MODEL, cost)).startswith("LQR(3 observables")


def test_monomials_of_some_states_are_those_of_a_plant_with_these_states():
    whole = km.Monomials(3).bind(("a", "c"))
    part = km.Monomials(3, states=["a", "c"]).bind(("a [m]", "b", "c"))
    X = np.random.default_rng(0).normal(size=(20, 3))
    assert part.names == whole.names
    np.testing.assert_array_equal(part(X), whole(X[:, [0, 2]]))
    with pytest.raises(km.KoopmpcError, match="'d'"):
        km.Monomials(2, states="d").bind(("a", "b"))


@settings(max_examples=25, deadline=None)
@given(st.permutations(["theta", "omega [rad/s]"]), st.booleans())
def test_weights_and_limits_by_name_are_those_by_position(order, unit):
    weights = {"theta": 10.0, "omega [rad/s]": 2.0}
    torque = "torque [N m]" if unit else "torque"
    named = km.Cost(Q={name: weights[name] for name in order}, R={torque: 0.1}, R_delta={torque: 0.2})
    plain = km.Cost(Q=[10, 2], R=0.1, R_delta=0.2)
    bounds = km.Limits(u_min={torque: -3}, u_max={torque: 3}, x_max={"omega": 1.5}, du_max={torque: 2})
    rows = km.Limits(u_min=-3, u_max=3, x_max=[np.inf, 1.5], du_max=2)
    for build in (
        lambda *of: km.KoopmanMPC(MODEL, *of, horizon=10),
        lambda *of: km.BilinearMPC(km.BilinearPredictor(MODEL.A, MODEL.B, np.zeros((1, 3, 3)), MODEL.C, MODEL.lifting, 0.05, MODEL.states, MODEL.inputs), *of, horizon=5),
        lambda *of: km.LQR(MODEL, *of),
    ):  # fmt: skip
        a, b = build(named, bounds), build(plain, rows)
        if isinstance(a, km.LQR):
            a, b = km.LQR(MODEL, named), km.LQR(MODEL, plain)
        assert np.array_equal(a([0.4, 0.1], [0, 0]).u, b([0.4, 0.1], [0, 0]).u)


def test_an_omitted_name_has_no_weight_and_no_limit():
    mpc = km.KoopmanMPC(MODEL, km.Cost(Q={"theta": 10}, R={"torque": 1}), km.Limits(x_min={"omega": -1}), horizon=5)
    assert np.array_equal(mpc.cost.matrices(2, 1)[0], np.diag([10.0, 0.0]))
    assert np.array_equal(mpc.limits.states(2)[0], [-np.inf, -1.0])


def test_a_run_is_judged_by_the_weights_of_its_names():
    named, plain = km.Cost(Q={"omega": 3}, R={"torque": 1}), km.Cost(Q=[0, 3], R=1)
    limits = km.Limits(u_max={"torque": 2}), km.Limits(u_max=2)
    mpc = km.LQR(MODEL, plain)
    a, b = (
        km.metrics(km.simulate(PLANT, mpc, x0=[0.3, 0], reference=[0, 0], steps=20, cost=c, limits=box))
        for c, box in zip((named, plain), limits, strict=True)
    )
    assert a.cost == b.cost
    assert a.input_violation == b.input_violation


@pytest.mark.parametrize(("cost", "message"), [
    (km.Cost(Q={"angle": 1}, R=1), r"Q names 'angle', which is not there; the names are theta \[rad\], omega \[rad/s\]"),
    (km.Cost(Q={"theta": 1, "theta [rad]": 1}, R=1), "is given twice"),
    (km.Cost(Q=1, R={"u": 1}), r"R names 'u', which is not there; the names are torque \[N m\]"),
])  # fmt: skip
def test_a_name_that_the_plant_does_not_have_is_refused(cost, message):
    with pytest.raises(km.KoopmpcError, match=message):
        km.KoopmanMPC(MODEL, cost, None, horizon=5)


def test_every_input_is_named_in_R_and_weights_are_not_negative():
    two = km.LinearPredictor(np.eye(1), np.ones((1, 2)), np.eye(1), km.State(), 0.1, ["x"], ["a", "b"])
    with pytest.raises(km.KoopmpcError, match="R has no value for b; name each of a, b"):
        km.LQR(two, km.Cost(Q=1, R={"a": 1}))
    with pytest.raises(km.KoopmpcError, match="Q"):
        km.Cost(Q={"x": -1}, R=1)
    with pytest.raises(km.KoopmpcError, match="pass names of signals"):
        km.Cost(Q={}, R=1)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(0.01, 0.5))
def test_a_continuous_system_is_sampled_with_a_zero_order_hold(seed, dt):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    model = km.LinearPredictor.from_state_space(scipy.signal.StateSpace(A, B, np.eye(3), np.zeros((3, 2))), dt=dt)
    from scipy.linalg import expm

    both = expm(dt * np.block([[A, B], [np.zeros((2, 5))]]))
    np.testing.assert_allclose(np.hstack([model.A, model.B]), both[:3], rtol=1e-9, atol=1e-12)
    assert model.dt == dt
    again = km.LinearPredictor.from_state_space(model.to_state_space())
    assert np.array_equal(again.A, model.A)
    assert again.dt == dt


def test_a_system_without_a_sample_time_or_with_feedthrough_is_refused():
    with pytest.raises(km.KoopmpcError, match=r"system is a list; pass scipy.signal.StateSpace or control.ss"):
        km.LinearPredictor.from_state_space([[0.5]], dt=0.1)
    system = scipy.signal.StateSpace([[0.0]], [[1.0]], [[1.0]], [[0.0]])
    with pytest.raises(km.KoopmpcError, match="pass dt="):
        km.LinearPredictor.from_state_space(system)
    with pytest.raises(km.KoopmpcError, match="D is not zero"):
        km.LinearPredictor.from_state_space(scipy.signal.StateSpace([[0.0]], [[1.0]], [[1.0]], [[1.0]]), dt=0.1)
    with pytest.raises(km.KoopmpcError, match=r"has dt = 0.2 s, but dt= is 0.1 s"):
        km.LinearPredictor.from_state_space(scipy.signal.dlti([[0.5]], [[1.0]], [[1.0]], [[0.0]], dt=0.2), dt=0.1)


def test_a_controller_says_how_a_system_becomes_its_model():
    lines = shown(
        "import scipy.signal\n"
        "system, cost = scipy.signal.StateSpace([[0.0]], [[1.0]], [[1.0]], [[0.0]]), km.Cost(Q=1, R=1)\n"
        "show(lambda: km.LQR(system, cost))\n"
        "show(lambda: km.KoopmanMPC(system, cost, None, horizon=5))\n"
    )
    assert len(lines) == 2
    assert all("from_state_space" in line for line in lines)
