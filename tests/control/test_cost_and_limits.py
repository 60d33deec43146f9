from dataclasses import dataclass

import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.plan.tracking import data_ranges, state_tracking
from tests.bare import shown


def test_a_scalar_and_a_vector_are_diagonals():
    Q, R = km.Cost(Q=2, R=[1, 3]).matrices(3, 2)
    np.testing.assert_array_equal(Q, 2 * np.eye(3))
    np.testing.assert_array_equal(R, np.diag([1, 3]))


def test_a_slack_is_reported_above_its_tolerance():
    """The tolerance is 1e-4 of half the width, and the state stays where it is: no input may push it down."""
    model = km.LinearPredictor([[1.0]], [[1.0]], [[1.0]], km.State(), 0.1, ("x",), ("u",))
    cost, limits = km.Cost(Q=1, R=1), km.Limits(u_min=0, u_max=1, x_min=-1, x_max=9)
    for make in (km.KoopmanMPC, km.BilinearMPC, km.NonlinearMPC):
        mpc = make(model, cost, limits, 3)
        assert mpc([9 + 0.45e-3], [9]).slack == 0
        above = mpc([9 + 1.1e-3], [9])
        assert above.status is km.Status.SOFTENED
        assert above.slack == pytest.approx(1.1e-3, rel=1e-3)


def test_choices_of_a_name():
    """What the type hook of the tests would catch first, as users see it."""
    lines = shown(
        """
model = km.LinearPredictor(np.eye(1), np.eye(1), np.eye(1), km.State(), 0.1, ("x",), ("u",))
show(lambda: km.Cost(1, 1, u_target="rest"))
show(lambda: km.KoopmanMPC(model, km.Cost(1, 1), solver="simplex"))
show(lambda: km.KoopmanMPC(model, km.Cost(1, 1), horizon=2.5))
show(lambda: km.Limits(slack=5))
show(lambda: km.Limits(y_max=1, of="theta"))
show(lambda: km.Cost(1, 1, of="theta"))
show(lambda: km.KoopmanMPC(model, km.Cost(1, 1), moves=np.array([1, 19])))
show(lambda: km.KoopmanMPC(model, km.Cost(1, 1), settings=["eps_abs"]))
show(lambda: km.KoopmanMPC(model, km.Cost(1, 1), estimator="kalman"))
show(lambda: km.KoopmanMPC(model, km.Cost(1, 1), estimator=km.LiftedDisturbance))
show(lambda: km.KoopmanMPC(model, km.Cost(1, 1)).update(None))
show(lambda: km.KoopmanMPC(model, km.Cost(1, 1))([0], [0], applied=[1, 2]))
show(lambda: km.LinearMPC(model, [0], [0], km.Cost(1, 1)))
show(lambda: km.LQR(None, km.Cost(1, 1)))
show(lambda: km.metrics([1, 2]))
"""
    )
    assert lines == [
        """DataError u_target is 'rest'; pass "equilibrium", "zero", an input or rows of inputs""",
        "DataError solver is 'simplex'; there are 'auto', 'osqp', 'daqp', 'piqp'",
        "DataError horizon is 2.5; pass a whole number",
        'ShapeError slack is 5; pass (linear, quadratic), "auto", or None for hard limits',
        'DataError of is a str, expected a Lifting; for example km.Fourier(1, states="theta")',
        'DataError of is a str, expected a Lifting; for example km.State("theta"), or km.Fourier(1, states="theta")',
        "DataError moves is array([ 1, 19]); pass how many moves there are, a tuple of the blocks' lengths, or one by the "
        'name of each input, {"pump": (1, 1, 2, 4)}',
        "DataError settings is a list, expected a Mapping; pass the solver's own by name, for example "
        '{"max_iter": 100}',
        "DataError estimator is 'kalman'; pass an object, for example km.LiftedDisturbance()",
        "DataError estimator is <class 'koopmpc.estimate.disturbance.LiftedDisturbance'>; pass an object, for "
        "example km.LiftedDisturbance()",
        "DataError predictor is a NoneType, expected a LinearPredictor; it replaces another LinearPredictor",
        "ShapeError applied has shape (2,), expected (1,)",
        "DataError step_map is a LinearPredictor, expected a StepMap; discretize the dynamics, or use KoopmanMPC "
        "for a predictor",
        "DataError predictor is a NoneType, expected a LinearPredictor; fit one with edmd, or linearise with "
        "LinearPredictor.local; from_state_space takes matrices",
        "DataError run is a list, expected a Run; simulate returns one",
    ]


def sizes_of(cost, limits, ranges=None):
    return state_tracking(("a", "b", "c"), ("u", "v"), cost, limits, None, ranges).sizes


def test_sizes_are_those_of_two_limits_then_of_the_data_then_of_the_cost_then_of_one_limit():
    cost = km.Cost(Q=[4, 9, 0], R=[2, 0])
    limits = km.Limits([-3, -np.inf], [1, 5], x_min=[-1, -np.inf, -7], x_max=[3, 8, np.inf])
    found = sizes_of(cost, limits)
    price = 4 * 2.0**2  # of a, the one tracked state of known size: half the width of its limits
    assert found.scale == max(price, 2 * 2.0**2)
    np.testing.assert_allclose(found.states, [2, np.sqrt(price / 9), 7])  # b as dear as a; c costs nothing: |limit|
    np.testing.assert_allclose(found.inputs, [2, 1])  # the second has neither two limits nor a price
    seen = sizes_of(cost, limits, {"a": 0.1, "b": 0.5, "c": 0.25})  # of the data, unless two limits say more
    np.testing.assert_allclose(seen.states, [2, 0.5, 0.25])
    assert seen.scale == 16.0
    dear = sizes_of(km.Cost(Q=[4, 9, 0], R=[2, 3]), km.Limits(x_min=-2, x_max=2))
    assert dear.scale == 36.0
    np.testing.assert_allclose(dear.inputs, np.sqrt([18, 12]))
    np.testing.assert_array_equal(dear.states, [2, 2, 2])


def test_the_mean_price_of_what_is_known_gives_the_size_of_what_is_not():
    found = sizes_of(km.Cost(Q=[4, 1, 25], R=1), km.Limits(x_min=[-1, -3, -np.inf], x_max=[1, 3, np.inf]))
    assert found.scale == 9.0
    np.testing.assert_allclose(found.states, [1, 3, np.sqrt((4 + 9) / 2 / 25)])
    np.testing.assert_allclose(found.inputs, [3, 3])


def test_where_no_width_is_known_one_limit_or_the_weights_say_how_large_costs_are():
    one = sizes_of(km.Cost(Q=[4, 1, 0], R=0), km.Limits(x_max=[3, -5, 2]))
    assert one.scale == 36.0
    np.testing.assert_allclose(one.states, [3, 6, 2])  # of equal price, and the limit where there is no price
    np.testing.assert_array_equal(one.inputs, [1, 1])
    none = sizes_of(km.Cost(Q=[4, 1, 0], R=[9, 1]), km.Limits())
    assert none.scale == 9.0
    np.testing.assert_allclose(none.states, [1.5, 3, 1])
    np.testing.assert_allclose(none.inputs, [1, 3])
    nothing = sizes_of(km.Cost(Q=0, R=0), km.Limits())
    assert nothing.scale == 1.0
    np.testing.assert_array_equal([*nothing.states, *nothing.inputs], np.ones(5))


def test_the_range_of_the_data_is_that_of_uniform_data_about_their_mean():
    rng = np.random.default_rng(0)
    X = rng.uniform([-1, 5, 2], [3, 6, 2], (4001, 3))
    data = km.Episodes([km.Episode(X=X, U=rng.uniform(-1, 1, (4000, 1)))], 0.1, ("a", "b", "c"), ("u",))
    lifting = km.State() + km.Constant() + km.Expressions(lambda x: [x[0] * x[1]], ["ab"])
    with pytest.warns(km.FitWarning, match="'c' of '1'"):
        found = data_ranges(km.edmd(data, lifting))
    product = X[:-1, 0] * X[:-1, 1]
    assert set(found) == {"a", "b", "ab"}  # c and the Constant do not move
    np.testing.assert_allclose([found["a"], found["b"]], [2, 0.5], rtol=0.05)
    assert found["ab"] == pytest.approx(np.sqrt(3) * product.std(), rel=1e-3)


def test_a_field_of_limits_that_nobody_knows_is_refused():
    """A limit that is added to `Limits` must not be ignored in silence by what keeps a part of them alone."""

    @dataclass(frozen=True, eq=False)
    class WithEnergy(km.Limits):
        energy_max: float | None = None

    plant = km.discretize(km.load_problem("pendulum").dynamics, 0.05)
    data = km.collect(plant, [0, 0], km.Noise(-1, 1), episodes=2, steps=30)
    model = km.LinearPredictor.local(plant, [0, 0], [0])
    energy = km.Expressions(lambda x: [x[0] ** 2 + x[1] ** 2], ["energy"]).bind(("theta", "omega"))
    cost, inputs = km.Cost(Q=1, R=1), {"u_min": -8, "u_max": 8}
    acts = (
        lambda limits: km.control.PID(1.0, dt=1.0, limits=limits),
        lambda limits: km.LQR(model, cost, limits),
        lambda limits: km.control.EigenfunctionLQR(
            energy, km.Cost(Q=1, R=1, of=energy, u_target="zero"), limits, dt=0.05, B=[[0], [1]], eigenvalue=0.0
        ),
        lambda limits: km.metrics(
            km.simulate(plant, km.LQR(model, cost), x0=[0.1, 0], reference=[0, 0], steps=3, limits=limits)
        ),
    )
    for act in acts:
        act(WithEnergy(**inputs))
        with pytest.raises(km.errors.DataError, match=r"energy_max=2, which .* does not know"):
            act(WithEnergy(**inputs, energy_max=2))
    refused = WithEnergy(**inputs, energy_max=2)
    for act in (
        lambda: km.certify(model, data, refused, x=[0, 0], u=[0]),
        lambda: km.design(data, cost, refused, horizon=3, reference=[0, 0]),
    ):
        with pytest.raises(km.errors.DataError, match=r"energy_max=2, which .* does not know"):
            act()
