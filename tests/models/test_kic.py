"""km.identify.kic: observables of states and inputs, three kinds of input, and the models that controllers take."""

import numpy as np
import pytest

import koopmpc as km

L, M, D = 0.9, 0.5, 1.0  # λ, μ, δ of Proctor, Brunton & Kutz 2018
NAMES = ("x1", "x2")


def step(x, u):
    return np.array([L * x[0], M * x[1] + (L**2 - M) * x[0] ** 2 + D * u[0]])


def data(law, episodes=20, steps=15, seed=0, plant=step):
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(episodes):
        X, U, held = [rng.uniform(-1, 1, 2)], [], rng.uniform(-1, 1, 1)
        for _ in range(steps):
            U.append(np.atleast_1d(law(X[-1], held, rng)))
            X.append(plant(X[-1], U[-1]))
        found.append(km.Episode(X=np.array(X), U=np.array(U)))
    return km.Episodes(found, 1.0, NAMES, ("u",))


LIFTING = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x1²"])
ROWS = {"x1": [L, 0, 0, 0], "x2": [0, M, D, L**2 - M], "x1²": [0, 0, 0, L**2]}  # on x1, x2, u, x1²


@pytest.mark.parametrize(
    ("inputs", "law", "row"),
    [
        ("exogenous", lambda x, held, rng: rng.uniform(-1, 1, 1), [0, 0, 0, 0]),
        ("constant", lambda x, held, rng: held, [0, 0, 1, 0]),
        ("state", lambda x, held, rng: -0.3 * x[0] ** 2, [0, 0, 0, -0.3 * L**2]),
    ],
)
def test_the_exact_example_is_found_and_the_row_of_the_input_says_what_it_is(inputs, law, row):
    episodes = data(law)
    with np.errstate(all="ignore"):
        found = km.identify.kic(episodes, LIFTING, inputs=inputs) if inputs != "state" else blind(episodes)
    m = found.model
    assert m.lifting.names == ("x1", "x2", "u", "x1²")
    Z = m.lift(np.hstack([episodes[0].X[:-1], episodes[0].U]))
    exact = np.array([*list(ROWS.values())[:2], row, ROWS["x1²"]])
    np.testing.assert_allclose(Z @ m.A.T, Z @ exact.T, atol=1e-10)
    if inputs != "state":  # under feedback u and x1² are dependent, and only their sum is known
        np.testing.assert_allclose(m.A, exact, atol=1e-10)


def blind(episodes):
    with pytest.warns(km.FitWarning):
        return km.identify.kic(episodes, LIFTING, inputs="state")


def test_a_constant_input_adds_the_eigenvalue_one_and_an_exogenous_one_zero():
    free = km.identify.kic(data(lambda x, held, rng: rng.uniform(-1, 1, 1)), LIFTING)
    held = km.identify.kic(data(lambda x, held, rng: held), LIFTING, inputs="constant")
    own = [L, M, L**2]
    assert sorted(free.model.eigenvalues.real) == pytest.approx(sorted([*own, 0.0]), abs=1e-9)
    assert sorted(held.model.eigenvalues.real) == pytest.approx(sorted([*own, 1.0]), abs=1e-9)


def test_where_inputs_enter_as_they_are_controllers_take_the_linear_model():
    found = km.identify.kic(data(lambda x, held, rng: rng.uniform(-1, 1, 1)), LIFTING)
    model = found.linear()
    np.testing.assert_allclose(model.A, [[L, 0, 0], [0, M, L**2 - M], [0, 0, L**2]], atol=1e-10)
    np.testing.assert_allclose(model.B, [[0], [D], [0]], atol=1e-10)
    U = np.random.default_rng(1).uniform(-1, 1, (10, 1))
    X = [np.array([0.5, -0.4])]
    for u in U:
        X.append(step(X[-1], u))
    np.testing.assert_allclose(found.rollout(X[0], U), X, atol=1e-9)
    np.testing.assert_allclose(model.rollout(X[0], U), X, atol=1e-9)
    mpc = km.KoopmanMPC(model, km.Cost(Q=[1, 1], R=0.1), km.Limits(u_min=-1, u_max=1), horizon=5)
    assert abs(mpc(X[0], [0.0, 0.0]).u[0]) <= 1


def test_products_and_squares_of_inputs_are_held_exactly_and_go_to_nonlinear_controllers():
    def plant(x, u):
        return np.array([0.9 * x[0] + 0.5 * x[0] * u[0], 0.5 * x[1] + u[0] ** 2])

    episodes = data(lambda x, held, rng: rng.uniform(-1, 1, 1), plant=plant)
    lifting = km.State() + km.Expressions(lambda x: [x[0] * x[2], x[2] ** 2], ["x1 u", "u²"])
    found = km.identify.kic(episodes, lifting)
    for x, u in ((np.array([0.3, 0.2]), np.array([0.7])), (np.array([-0.9, 0.1]), np.array([-0.4]))):
        np.testing.assert_allclose(found.step_map()(x, u), plant(x, u), atol=1e-10)
    mpc = km.NonlinearMPC(found.step_map(), km.Cost(Q=[1, 1], R=0.1), km.Limits(u_min=-1, u_max=1), horizon=5)
    assert abs(mpc([0.5, 0.5], [0.0, 0.0]).u[0]) <= 1
    with pytest.raises(km.KoopmpcError, match="'x1 u' is not linear in the inputs; use step_map"):
        found.linear()


@pytest.mark.unhooked
def test_bad_input_is_refused_in_a_sentence():
    episodes = data(lambda x, held, rng: rng.uniform(-1, 1, 1))
    for bad, options, text in (
        (km.Episodes([km.Episode(X=np.zeros((3, 2)))], 1.0), {}, "the episodes have no inputs; fit them with edmd"),
        (episodes, {"inputs": "random"}, 'pass "exogenous", "state" or "constant"'),
        (episodes, {"inputs": "constant"}, 'episode 0 has inputs that change; pass inputs="exogenous"'),
        (km.Episodes([km.Episode(X=np.zeros((2, 2)), U=[[1.0]])], 1.0), {"inputs": "state"}, "episode 0 has one step"),
    ):
        with pytest.raises(km.KoopmpcError, match=text):
            km.identify.kic(bad, km.State(), **options)
    held = km.identify.kic(data(lambda x, held, rng: held), LIFTING, inputs="constant")
    with pytest.raises(km.KoopmpcError, match='the inputs of the data are "constant"'):
        held.linear()
    lacking = km.State(["x1", "x2"]) + km.Expressions(lambda x: [x[0] ** 2], ["x1²"])
    with pytest.raises(km.KoopmpcError, match="ψ lacks an input"):
        km.identify.kic(episodes, lacking).linear()
