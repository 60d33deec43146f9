"""Hidden states with neurons: exact derivatives, exact conversion, and friction that a polynomial cannot hold."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.levenberg_marquardt import minimise
from koopmpc.identify.records import hidden_fit
from koopmpc.identify.records.conversion import SignalUnits, from_standard, to_standard
from koopmpc.identify.records.hidden import (
    RecordSegments,
    SimulationError,
    simulate_hidden,
    smooth_basis,
    start_with_differences,
)
from koopmpc.identify.records.hidden_structure import HiddenStructure
from koopmpc.identify.records.neurons import ContainedError, contain
from koopmpc.lifting import Neurons
from tests.identify.test_hidden_state import random_model, random_segments


@pytest.mark.parametrize(("degree", "ny", "nu"), [(1, 1, 1), (2, 2, 2)])
def test_the_derivatives_by_the_neurons_are_those_of_finite_differences(degree, ny, nu):
    rng = np.random.default_rng(0)
    plain = random_model(rng, 2, degree, ny, nu)
    model = plain.add_neurons(rng.standard_normal((3, 3)))
    data = random_segments(model, rng, nu=nu)
    assert SimulationError(model).evaluate(model.parameters, [data]) == pytest.approx(
        SimulationError(plain).evaluate(plain.parameters, [data]), rel=1e-12
    )  # their weights begin at zero
    error = SimulationError(model)
    theta = model.parameters + 0.1 * rng.standard_normal(model.parameters.size)
    gradient, matrix = error.derivatives(theta, [data])
    for j in range(theta.size):
        up, down = theta.copy(), theta.copy()
        up[j] += 1e-6
        down[j] -= 1e-6
        slope = (error.evaluate(up, [data]) - error.evaluate(down, [data])) / 4e-6
        assert gradient[j] == pytest.approx(slope, rel=1e-4, abs=1e-7)
    assert np.linalg.eigvalsh(matrix).min() > -1e-9 * np.abs(matrix).max()


def test_differences_go_on_as_a_parabola_does():
    model = start_with_differences(1, 1, 3, 12)
    time = np.arange(-12.0, 1.0)[::-1]
    y = 0.3 * time**2 - time + 2
    zeta = np.concatenate([y[:1], np.column_stack([np.zeros(12), y[1:]]).ravel()])
    z = model.T @ np.append(zeta, 1.0)
    for k in (1, 2, 3):
        z = model.E[:, 1:4] @ z
        assert (model.H[:, :-1] @ z)[0] == pytest.approx(0.3 * k**2 - k + 2, abs=1e-9)
    basis = smooth_basis(1, 1, 12)
    assert np.allclose(basis @ basis.T, np.eye(len(basis)), atol=1e-12)
    assert np.allclose(zeta @ basis.T @ basis, zeta, atol=1e-9)  # a parabola is smooth


def test_neurons_are_functions_of_the_chosen_states():
    lifting = Neurons([[2.0, 0.5], [-1.0, 0.0]], states="v [m/s]").bind(["p [m]", "v [m/s]"])
    x = np.array([[3.0, 0.25]])
    assert np.allclose(lifting(x), np.tanh([[1.0, -0.25]]))
    symbol = ca.SX.sym("x", 2)
    assert np.allclose(np.asarray(ca.Function("f", [symbol], [lifting.symbolic(symbol)])(x.ravel())).T, lifting(x))
    with pytest.raises(ShapeError, match="3 states"):
        Neurons([[1.0, 0.0]]).bind(["a", "b", "c"])


def growing_model(rng, radius=1.05):
    model = random_model(rng, 3, 1).add_neurons(rng.standard_normal((2, 4)))
    E = model.E.copy()
    E[:, 1:4] = np.diag([radius, 0.7, 0.2]) + 0.05 * rng.standard_normal((3, 3))
    E[:, -2:] = rng.standard_normal((3, 2))
    return replace(model, E=E)


def test_the_weight_on_growth_has_the_derivative_of_finite_differences():
    rng = np.random.default_rng(1)
    model = growing_model(rng)
    data, theta = random_segments(model, rng), model.parameters
    plain, error = SimulationError(model), ContainedError(SimulationError(model))
    gradient = error.derivatives(theta, [data])[0] - plain.derivatives(theta, [data])[0]
    assert np.abs(gradient).max() > 100
    for j in range(model.E.size):
        up, down = theta.copy(), theta.copy()
        up[j] += 1e-6
        down[j] -= 1e-6
        slope = (error.evaluate(up, [data]) - error.evaluate(down, [data])) / 4e-6
        own = (plain.evaluate(up, [data]) - plain.evaluate(down, [data])) / 4e-6
        assert gradient[j] == pytest.approx(slope - own, rel=1e-4, abs=1e-3)


def test_a_contained_model_never_leaves_all_numbers():
    rng = np.random.default_rng(2)
    wild = growing_model(rng)
    inputs, points = rng.uniform(-1, 1, (300, 1, 1)), rng.standard_normal((1, 5))
    stopped = np.abs(simulate_hidden(wild, points, inputs)).max()  # where a state has 1000 spreads
    model = contain(wild)
    assert np.abs(np.linalg.eigvals(model.E[:, 1:4])).max() <= 1
    assert np.abs(simulate_hidden(model, points, inputs)).max() < 0.5 * stopped
    assert contain(model) is model
    z = 1e6 * rng.standard_normal((3, 1))
    far = z.copy()
    for _ in range(2000):
        far = model.E[:, 1:4] @ far  # what is left of the dynamics far away
    assert np.abs(far).max() < 100 * np.abs(z).max()


def test_only_eigenvalues_above_one_move_and_they_end_at_one():
    model = growing_model(np.random.default_rng(3))
    error, n = ContainedError(SimulationError(model)), model.order
    model = model.with_parameters(error.project(model.parameters))
    assert np.array_equal(error.project(model.parameters), model.parameters)
    E, turn = model.E.copy(), np.array([[1.0, 0.3, 0.0], [0.2, 1.0, 0.1], [0.0, -0.4, 1.0]])
    E[:, 1 : 1 + n] = turn @ np.diag([1.3, 0.7, -0.2]) @ np.linalg.inv(turn)
    found = replace(model, E=E)
    found = found.with_parameters(error.project(found.parameters))
    assert np.allclose(found.E[:, 1 : 1 + n], turn @ np.diag([1.0, 0.7, -0.2]) @ np.linalg.inv(turn), atol=1e-9)
    assert np.array_equal(found.E[:, 1 + n :], E[:, 1 + n :])


@pytest.mark.parametrize("seed", [5, 6, 8])
def test_a_fit_that_starts_beside_the_bound_on_eigenvalues_reaches_the_plant(seed):
    rng = np.random.default_rng(seed)
    start = start_with_differences(1, 1, 2, 3)
    plant = replace(start, E=np.array([[0, 0.9, 0.2, 0.3], [0, -0.3, 0.8, 0.5]]))
    noisy = random_segments(plant, rng, count=6, steps=40)
    data = RecordSegments(noisy.points, noisy.inputs, simulate_hidden(plant, noisy.points, noisy.inputs))
    near = replace(start, E=np.array([[0, 0.999, 0, 0.1], [0, 0, 0.999, 0.1]]))
    error = ContainedError(SimulationError(near))
    theta, _ = minimise(error, near.parameters, [data], [data], 20, project=error.project)
    assert error.evaluate(theta, [data]) < 1e-20 < 1 < error.evaluate(near.parameters, [data])


def test_a_growing_free_run_is_refused_in_a_sentence(monkeypatch):
    rng = np.random.default_rng(0)
    data = km.Episodes(
        [km.Episode(X=rng.standard_normal((400, 1)), U=rng.standard_normal((399, 1)))], 1.0, ["y"], ["u"]
    )  # fmt: skip
    monkeypatch.setattr("koopmpc.identify.records.hidden_fit.is_calm_hidden", lambda *_, **__: False)
    with pytest.raises(DataError, match="with neurons and without; pass another order"):
        km.identify.neural_state_space(data, order=1, neurons=1)


def friction_record(seed, steps=1500):
    """Return the record of a velocity under dry friction, with noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, steps // 15 + 1), 15)[:steps]
    y, v = np.zeros(steps + 1), 0.0
    for k in range(steps):
        v = 0.95 * v + 0.2 * u[k] - 0.08 * np.tanh(20 * v)
        y[k + 1] = v
    y += 0.002 * rng.standard_normal(steps + 1)
    return km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 0.1, ["v [m/s]"], ["u"])


@pytest.mark.slow
def test_dry_friction_is_found_and_the_model_is_used_as_any_other(tmp_path):
    data, fresh = friction_record(0), friction_record(1)
    model = km.identify.neural_state_space(data, order=1, neurons=[1, 2])
    other = km.identify.polynomial_state_space(data, 1, 3)

    def error(one):
        free = one.step_map().rollout(one.embed(fresh)[0].X[0], fresh[0].U[one.embedding.steps :])[:, 0]
        return float(np.sqrt(np.mean((free - fresh[0].X[one.embedding.steps :, 0]) ** 2)))

    assert error(model) < 0.004
    assert error(model) < 0.5 * error(other)
    model.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == model
    units = SignalUnits.of(data, None)
    again = from_standard(to_standard(model, units), units, data, model.embedding.steps, model.report)
    for name in ("A", "B", "N", "C"):
        assert np.allclose(getattr(model, name), getattr(again, name), rtol=1e-9, atol=1e-9)


def test_an_output_that_never_moves_is_refused_in_a_sentence():
    data = km.Episodes([km.Episode(X=np.ones((201, 1)), U=np.random.default_rng(0).uniform(-1, 1, (200, 1)))], 0.1)
    with pytest.raises(DataError, match="no output moves"):
        km.identify.neural_state_space(data, order=2, neurons=1)


def test_a_short_record_is_fitted_from_several_sets_of_neurons(monkeypatch):
    u, y = np.random.default_rng(0).uniform(-1, 1, 150), np.zeros(151)
    for k in range(150):
        y[k + 1] = 0.9 * y[k] + u[k] - 0.3 * np.tanh(10 * y[k])
    data = km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 0.1, ["y"], ["u"])
    chain = hidden_fit.fit_chain

    def fit_chain(data, structure, neurons, **options):
        found = chain(data, replace(structure, start=0), neurons, **options)
        return found if structure.start else [next(found)]  # no neurons in the first set

    monkeypatch.setattr(hidden_fit, "fit_chain", fit_chain)
    plan = HiddenStructure(1, 1, 8, 50, None, np.ones(1), True, 4, neurons=1)
    model = hidden_fit.fit_hidden(plan, data)
    start = model.embed(data)[0].X[0]
    assert abs(model.step_map().rollout(start, u[8:, None])[:, 0] - y[8:]).max() < 0.02 * y.std()
