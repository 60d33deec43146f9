import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.example_plants import CartPole, Pendulum, Spring

ALL = [km.plants.Euler(), km.RK4(), km.plants.ImplicitMidpoint(), km.plants.Collocation(2), km.plants.CVODES()]
PLANTS = {repr(integrator): km.discretize(CartPole(), 0.05, integrator) for integrator in ALL}
number = st.floats(-2, 2)


@pytest.mark.parametrize("name", PLANTS)
@given(x=st.tuples(number, number, number, number), u=st.floats(-10, 10))
def test_jacobians_against_central_differences(name, x, u):
    plant, eps = PLANTS[name], 1e-5
    at = np.array([*x, u])
    model = plant.linearize(at[:4], at[4:])
    columns = []
    for step in eps * np.eye(5):
        up, down = at + step, at - step
        columns.append((plant(up[:4], up[4:]) - plant(down[:4], down[4:])) / (2 * eps))
    J = np.array(columns).T
    loose = 1e-3 if name.startswith("CVODES") else 1e-7
    np.testing.assert_allclose(np.hstack([model.A, model.B]), J, rtol=loose, atol=loose)
    np.testing.assert_allclose(
        model.A @ at[:4] + model.B @ at[4:] + model.c, plant(at[:4], at[4:]), rtol=0, atol=1e-12 + loose / 1e3
    )


def test_b_keeps_its_two_axes():
    model = km.discretize(Pendulum(), 0.1).linearize([0.1, 0.0], 0.3)
    assert (model.A.shape, model.B.shape, model.c.shape) == ((2, 2), (2, 1), (2,))
    assert model == km.discretize(Pendulum(), 0.1).linearize([0.1, 0.0], [0.3])


@pytest.mark.parametrize("name", PLANTS)
def test_a_rollout_is_repeated_calls_to_the_bit(name):
    plant = PLANTS[name]
    U = np.random.default_rng(0).normal(size=(20, 1))
    x, X = np.array([0.0, 0.3, 0.0, 0.0]), plant.rollout([0.0, 0.3, 0.0, 0.0], U)
    for k, u in enumerate(U):
        assert X[k].tobytes() == x.tobytes()
        x = plant(x, u)
    assert X[-1].tobytes() == x.tobytes()


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
def test_copies_step_alike(name, copied):
    plant = PLANTS[name]
    plant(np.zeros(4), np.ones(1))  # its buffers are not copied
    twin = copied(plant)
    assert twin([0, 0.3, 0, 0], [1.0]).tolist() == plant([0, 0.3, 0, 0], [1.0]).tolist()
    assert (twin.dt, twin.states, twin.inputs) == (plant.dt, plant.states, plant.inputs)
    assert twin.outputs == plant.outputs


def test_answers_are_fresh_and_arguments_stay():
    plant = PLANTS["RK4(substeps=1)"]
    x, u = np.array([0.0, 0.3, 0.0, 0.0]), np.array([1.0])
    first = plant(x, u)
    kept = first.copy()
    first_measured = plant.measure(x)
    plant(x + 1, u)
    plant.measure(x + 1)
    assert first.tolist() == kept.tolist()
    assert first_measured.tolist() == x.tolist() == [0.0, 0.3, 0.0, 0.0]
    first_measured[:] = 9
    assert x[0] == 0.0


def test_strided_lists_and_integers_are_taken():
    plant = PLANTS["RK4(substeps=1)"]
    wide = np.zeros((4, 2))
    wide[:, 0] = [0, 1, 2, 3]
    want = plant(np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0])).tolist()
    assert plant(wide[:, 0], [1]).tolist() == want
    assert plant([0, 1, 2, 3], 1).tolist() == want
    assert plant(np.arange(4, dtype=np.float32), np.ones(1, dtype=int)).tolist() == want


@pytest.mark.parametrize("name", ["RK4(substeps=1)", "ImplicitMidpoint()"])
def test_threads_do_not_disturb_each_other(name):
    plant, rng = PLANTS[name], np.random.default_rng(1)
    starts, U = rng.normal(size=(8, 4)), rng.normal(size=(300, 1))

    def march(x):
        for u in U:
            x = plant(x, u)
        return x

    alone = [march(x).tolist() for x in starts]
    with ThreadPoolExecutor(4) as pool:
        assert [x.tolist() for x in pool.map(march, starts)] == alone


def test_a_plant_without_inputs_and_with_mixed_outputs():
    plant = km.discretize(Spring(), 0.1)
    assert (plant.nx, plant.nu, plant.ny) == (2, 0, 2)
    X = plant.rollout([1.0, 0.0], np.empty((3, 0)))
    assert X[-1] == pytest.approx([np.cos(0.3), -np.sin(0.3)], abs=1e-6)
    assert plant.measure([1.0, 2.0]).tolist() == [2.0, 5.0]
    assert plant.linearize([1.0, 0.0], []).B.shape == (2, 0)
    assert plant.rollouts([[1.0, 0.0]] * 100, np.empty((100, 300, 0)))[7, :4] == pytest.approx(X, abs=1e-14)


def test_names_have_defaults():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    F, h = ca.Function("F", [x, u], [x * u]), ca.Function("h", [x], [x[0]])
    plain, measured = km.StepMap(F, 0.1), km.StepMap(F, 0.1, h)
    assert (plain.states, plain.inputs, plain.outputs) == (("x0", "x1"), ("u0",), ("x0", "x1"))
    assert measured.outputs == ("y0",)
    assert km.StepMap(F, 0.1, states=["a", "b"]).outputs == ("a", "b")


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_sparse_functions_by_hand_keep_their_zeros(kind):
    x, u = kind.sym("x", 3), kind.sym("u")
    A = ca.DM(ca.diag(ca.DM([0.0, 2.0, 0.0])))
    plant = km.StepMap(ca.Function("F", [x, u], [ca.sparsify(A) @ x + ca.sparsify(ca.DM([0, 0, 1])) @ u]), 1.0)
    assert plant([5.0, 6.0, 7.0], 8.0).tolist() == [0.0, 12.0, 8.0]
    model = plant.linearize([5.0, 6.0, 7.0], 8.0)
    assert model.A.tolist() == A.full().tolist()
    assert model.B.ravel().tolist() == [0, 0, 1]
    assert plant.rollouts([[5.0, 6.0, 7.0]], [[[8.0]]])[0, 1].tolist() == [0.0, 12.0, 8.0]


def test_nan_passes_through_a_step():
    assert np.isnan(PLANTS["RK4(substeps=1)"]([0, np.nan, 0, 0], [0.0])).any()


@pytest.mark.parametrize(("x", "u"), [(3, 1), (5, 1), (4, 2), (4, 0)])
def test_arrays_of_another_length_are_refused_though_their_type_is_right(x, u):
    with pytest.raises(km.errors.ShapeError, match=r"has shape"):
        PLANTS["RK4(substeps=1)"](np.zeros(x), np.zeros(u))


def test_a_step_map_is_frozen():
    with pytest.raises(AttributeError):
        PLANTS["RK4(substeps=1)"].dt = 1.0


x2, u1 = ca.SX.sym("x", 2), ca.SX.sym("u")
GOOD = ca.Function("F", [x2, u1], [x2])


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: km.discretize(CartPole(), 0.0), km.errors.DataError, "dt is 0 s; it must be above zero"),
        (lambda: km.discretize(CartPole(), -0.1), km.errors.DataError, r"dt is -0\.1 s; it must be above zero"),
        (lambda: km.StepMap(GOOD, np.nan), km.errors.DataError, "dt holds 1 NaN or inf"),
        (
            lambda: km.StepMap(ca.Function("F", [x2], [x2]), 1.0),
            km.errors.ShapeError,
            r"F has 1 arguments and 1 results, expected F\(x, u\) with one result",
        ),
        (
            lambda: km.StepMap(ca.Function("F", [x2, u1], [u1]), 1.0),
            km.errors.ShapeError,
            "F returns 1 rows, expected 2",
        ),
        (
            lambda: km.StepMap(ca.Function("F", [x2, u1], [x2.T]), 1.0),
            km.errors.ShapeError,
            r"expected columns: F\(x, u\)",
        ),
        (
            lambda: km.StepMap(GOOD, 1.0, ca.Function("h", [x2, u1, ca.SX.sym("w")], [x2])),
            km.errors.ShapeError,
            r"h has 3 arguments and 1 results, expected h\(x\) with one result or h\(x, u\)",
        ),
        (
            lambda: km.StepMap(GOOD, 1.0, ca.Function("h", [x2, ca.SX.sym("v", 2)], [x2])),
            km.errors.ShapeError,
            "h takes 2 inputs, F has 1; pass h of the same u",
        ),
        (
            lambda: km.StepMap(GOOD, 1.0, ca.Function("h", [u1], [u1])),
            km.errors.ShapeError,
            "h takes 1 states, F has 2; pass h of the same x",
        ),
        (
            lambda: km.StepMap(GOOD, 1.0, states=["a"]),
            km.errors.ShapeError,
            "states has 1 names, expected 2; give one name each",
        ),
        (lambda: km.StepMap(GOOD, 1.0, inputs="ab"), km.errors.DataError, "inputs is 'ab'; pass a tuple of names"),
    ],
)
def test_what_is_no_step_map_is_refused(build, error, message):
    with pytest.raises(error, match=message):
        build()


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda p: p([1, 2, 3], [0]), km.errors.ShapeError, r"x has shape \(3,\), expected \(4,\)"),
        (lambda p: p(np.zeros(4), [0, 0]), km.errors.ShapeError, r"u has shape \(2,\), expected \(1,\)"),
        (lambda p: p(0.0, 0.0), km.errors.ShapeError, r"x has shape \(\), expected \(4,\)"),
        (lambda p: p.measure([1.0]), km.errors.ShapeError, r"x has shape \(1,\), expected \(4,\)"),
        (lambda p: p.rollout(np.zeros(4), [0, 0]), km.errors.ShapeError, r"U has shape \(2,\), expected \(any, 1\)"),
        (lambda p: p.rollout(np.zeros(3), [[0]]), km.errors.ShapeError, r"x0 has shape \(3,\), expected \(4,\)"),
        (
            lambda p: p.rollout(np.zeros(4), [[np.nan]]),
            km.errors.DataError,
            r"U holds 1 NaN or inf, the first at \(0, 0\)",
        ),
        (lambda p: p.rollouts(np.zeros(4), [[0]]), km.errors.ShapeError, r"X0 has shape \(4,\), expected \(any, 4\)"),
        (
            lambda p: p.rollouts(np.zeros((2, 4)), np.zeros((3, 5, 1))),
            km.errors.ShapeError,
            r"U has shape \(3, 5, 1\), expected \(2, any, 1\)",
        ),
        (lambda p: p.linearize(np.zeros(4), [0, 0]), km.errors.ShapeError, r"u has shape \(2,\), expected \(1,\)"),
        (lambda p: p.linearize([np.inf, 0, 0, 0], 0), km.errors.DataError, "x holds 1 NaN or inf"),
    ],
)
def test_bad_arguments_are_named(call, error, message):
    with pytest.raises(error, match=message):
        call(PLANTS["RK4(substeps=1)"])


def test_a_name_that_is_used_twice_is_refused():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    F, h = ca.Function("F", [x, u], [x + u]), ca.Function("h", [x, u], [x[0] + u])
    with pytest.raises(km.errors.DataError, match="two states or inputs are named 'a'; rename one"):
        km.StepMap(F, 0.1, states=["a", "a"])
    with pytest.raises(km.errors.DataError, match="two states or inputs are named 'a'; rename one"):
        km.StepMap(F, 0.1, states=["a", "b"], inputs=["a"])
    with pytest.raises(km.errors.DataError, match=r"two states or inputs are named 'u\[k-1\]'; rename one"):
        km.StepMap(F, 0.1, h, states=["u[k-1]", "b"], inputs=["u"])
