"""subspace: exact data give the plant back, the state is balanced, units do not count, feedback does not bias."""

import numpy as np
import pytest

import koopmpc as km
from tests.compiler import needs_compiler


def linear_plant(rng, order, ny=1, nu=1):
    """Return a stable (A, B, C) with poles between .4 and .95."""
    poles = rng.uniform(0.4, 0.95, order)
    basis = np.linalg.qr(rng.standard_normal((order, order)))[0]
    return (
        basis @ np.diag(poles) @ basis.T,
        rng.standard_normal((order, nu)),
        rng.standard_normal((ny, order)),
    )


def record_of(plant, rng, steps=600, noise=0.0, offset=0.0, law=None, innovation=0.0):
    """Return one record of y = C x + offset; `law` feeds y back."""
    A, B, C = plant
    x, Y, U = np.zeros(len(A)), [], []
    for _ in range(steps + 1):
        y = C @ x + offset + noise * rng.standard_normal(len(C))
        u = rng.uniform(-1, 1, B.shape[1]) + (0.0 if law is None else law @ y)
        Y.append(y)
        U.append(u)
        x = A @ x + B @ u + innovation * rng.standard_normal(len(A))
    names = [f"y{i}" for i in range(len(C))], [f"u{i}" for i in range(B.shape[1])]
    return km.Episodes([km.Episode(X=np.array(Y), U=np.array(U[:-1]))], 0.1, *names)


def markov(A, B, C, count=50):
    found, power = [], np.array(B)
    for _ in range(count):
        found.append(C @ power)
        power = A @ power
    return np.array(found)


def model_markov(model, count=50):
    return markov(model.A, model.B, model.C, count)


@pytest.mark.parametrize(("order", "ny", "nu"), [(1, 1, 1), (3, 1, 1), (4, 2, 2), (2, 1, 2)])
def test_exact_data_give_order_response_and_free_run(order, ny, nu):
    rng = np.random.default_rng(order)
    plant = linear_plant(rng, order, ny, nu)
    model = km.identify.subspace(record_of(plant, rng, offset=3.0))
    assert model.nz == order + 1
    assert np.abs(model_markov(model) - markov(*plant)).max() < 1e-6
    (fresh,) = record_of(plant, rng, steps=200, offset=3.0)
    past = model.embedding.steps
    begun = km.Episode(X=fresh.X[: past + 1], U=fresh.U[:past])
    free = model.rollout(fresh.X[past], fresh.U[past:], history=begun)
    assert np.abs(free - fresh.X[past:]).max() < 1e-6


def test_the_state_is_balanced():
    """Over the p forecasts that the state is made of, covariance and observability Gramian are one diagonal matrix."""
    rng = np.random.default_rng(2)
    plant = linear_plant(rng, 3)
    data = record_of(plant, rng, steps=4000)
    model = km.identify.subspace(data, 3, delays=8)
    A, C = model.A[:3, :3], model.C[:, :3]
    y_size = np.concatenate([e.X[9:] for e in data]).std(axis=0)
    Z = model.lifting(model.embed(data)[0].X[:-1])[:, :3]
    S = np.cov((Z @ A.T).T, bias=True)  # of s = A z
    gramian = sum((C @ np.linalg.matrix_power(A, i) / y_size).T @ (C @ np.linalg.matrix_power(A, i) / y_size)
                  for i in range(8))  # fmt: skip
    assert np.allclose(S, np.diag(S.diagonal()), atol=1e-6 * S.max())
    assert np.allclose(gramian, S, atol=1e-3 * S.max())


def test_units_and_origins_do_not_count():
    rng = np.random.default_rng(1)
    data = record_of(linear_plant(rng, 2, ny=2), rng, noise=0.05)
    factor, shift = np.array([1e3, 1e-2]), np.array([40.0, -2.0])
    moved = km.Episodes(
        [km.Episode(X=e.X * factor + shift, U=5 * e.U - 1) for e in data], data.dt, data.states, data.inputs
    )
    one, other = km.identify.subspace(data, 2, delays=6), km.identify.subspace(moved, 2, delays=6)
    assert np.allclose(model_markov(one) * factor[:, None] / 5, model_markov(other), rtol=1e-6, atol=1e-9)


def test_feedback_does_not_bias_it():
    """Under y → u with process noise the response stays that of the plant."""
    rng = np.random.default_rng(0)
    plant = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    data = record_of(plant, rng, steps=20_000, law=np.array([[-0.8]]), innovation=0.5)
    model = km.identify.subspace(data, 2, delays=10)
    truth = markov(*plant, 20)
    assert np.abs(model_markov(model, 20) - truth).max() < 0.1 * np.abs(truth).max()


def test_controllers_files_and_c_take_the_model(tmp_path):
    rng = np.random.default_rng(4)
    A, B, C = linear_plant(rng, 2)
    data = record_of((A, B, C), rng, noise=0.01)
    model = km.identify.subspace(data, 2, delays=4)
    model.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == model
    mpc = km.KoopmanMPC(model, km.Cost(Q=1.0, R=1e-4), km.Limits(u_min=-2, u_max=2), 20)
    assert km.export(mpc, tmp_path / "c")
    x = np.zeros(2)
    for _ in range(80):
        x = A @ x + B @ mpc(C @ x, [0.3]).u
    assert abs(C @ x - 0.3) < 0.01


@needs_compiler
@pytest.mark.parametrize("estimator", [None, km.LiftedDisturbance()], ids=["plain", "offset-free"])
def test_c_of_a_controller_on_a_hidden_state_gives_the_inputs_of_python(estimator):
    rng = np.random.default_rng(6)
    A, B, C = linear_plant(rng, 2)
    model = km.identify.subspace(record_of((A, B, C), rng, noise=0.01), 2, delays=4)
    limits = km.Limits(u_min=-0.5, u_max=0.5)
    mpc = km.KoopmanMPC(model, km.Cost(Q=1.0, R=1e-2), limits, 15, estimator=estimator)
    machine = km.compiled(mpc)
    x, worst, bound = np.zeros(2), 0.0, 0
    for k in range(200):
        y, goal = C @ x + 0.01 * rng.standard_normal(1), [np.sign(np.sin(0.1 * k))]
        u, same = mpc(y, goal).u, machine(y, goal).u
        worst, bound = max(worst, float(np.abs(u - same).max())), bound + bool(np.abs(u[0]) > 0.499)
        x = A @ x + B @ u + 0.05
    assert worst < 1e-9
    assert 0 < bound < 200  # with the limit and without


def test_what_cannot_be_fitted_is_refused_in_a_sentence():
    rng = np.random.default_rng(0)
    short = record_of(linear_plant(rng, 1), rng, steps=6)
    with pytest.raises(km.errors.DataError, match="past rows"):
        km.identify.subspace(short, delays=[8, 12])
    still = km.Episodes([km.Episode(X=np.ones((50, 1)), U=rng.uniform(-1, 1, (49, 1)))], 0.1, ["y"], ["u"])
    with pytest.raises(km.errors.DataError, match="no output moves"):
        km.identify.subspace(still, 2, delays=3)
