"""Multiple shooting: the error from the best state of each segment, its derivatives, and what refine makes of it."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.errors import DataError
from koopmpc.identify.free_starts import FreeStartsError
from koopmpc.identify.records.conversion import SignalUnits, cut_segments, from_standard, to_standard
from koopmpc.identify.records.hidden import RecordSegments, SimulationError, simulate_hidden
from tests.identify.test_hidden_state import random_model, random_segments
from tests.identify.test_subspace import linear_plant, markov, model_markov


@pytest.mark.parametrize("degree", [1, 2])
def test_the_gradient_is_that_of_finite_differences_and_no_start_explains_more(degree):
    rng = np.random.default_rng(8)
    model = random_model(rng, 2, degree)
    data = random_segments(model, rng, 5, 10)
    near = 0.9 * simulate_hidden(model, data.points, data.inputs) + 0.1 * data.outputs
    data = RecordSegments(data.points, data.inputs, near)
    error, theta = FreeStartsError(model), model.parameters
    gradient, matrix = error.derivatives(theta, [data])
    for j in rng.choice(model.E.size + model.H.size, 8, replace=False):
        up, down = theta.copy(), theta.copy()
        up[j] += 1e-5
        down[j] -= 1e-5
        slope = (error.evaluate(up, [data]) - error.evaluate(down, [data])) / 4e-5
        assert gradient[j] == pytest.approx(slope, rel=1e-4, abs=1e-7)
    assert np.linalg.eigvalsh(matrix).min() > -1e-9
    least = error.evaluate(theta, [data])
    assert least < SimulationError(model).evaluate(theta, [data])
    z = error.begin(model, data)
    for _ in range(5):
        moved = z + 1e-3 * rng.standard_normal(z.shape)
        error.begin = lambda model, data, moved=moved: moved
        assert error.evaluate(theta, [data]) > least


def unstable_episodes(seed, noise=0.0):
    """Return six episodes of the output of an unstable plant, |λ| = 1.05, and its matrices."""
    rng = np.random.default_rng(seed)
    A, B, C = linear_plant(rng, 2)
    A = 1.05 * A / np.abs(np.linalg.eigvals(A)).max()
    parts = []
    for _ in range(6):
        x, U, Y = rng.standard_normal(2), rng.uniform(-1, 1, (60, 1)), np.empty((61, 1))
        for k in range(61):
            Y[k] = C @ x
            x = A @ x + (B @ U[k] if k < 60 else 0)
        parts.append(km.Episode(X=Y + noise * rng.standard_normal(Y.shape), U=U))
    return km.Episodes(parts, 0.1, ["y"], ["u"]), (A, B, C)


@pytest.mark.parametrize("seed", range(2))
def test_exact_data_of_an_unstable_plant_are_met_from_coefficients_ten_percent_off(seed):
    data, plant = unstable_episodes(seed)
    true = km.identify.subspace(data, 2, delays=4)
    units = SignalUnits.of(data, None)
    found = to_standard(true, units)
    theta = found.parameters * np.random.default_rng(seed).uniform(0.9, 1.1, found.parameters.size)
    start = from_standard(found.with_parameters(theta), units, data, 4, true.report)
    refined = km.identify.refine(start, data[:4], horizon=20, held_out=data[4:], iterations=100, free_starts=True)
    truth = markov(*plant)
    assert np.abs(model_markov(refined) - truth).max() < 1e-6 * np.abs(truth).max()


@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_where_few_noisy_rows_hide_the_state_of_an_unstable_plant_free_starts_gain_threefold(noise):
    """In 4 of 24 such records they gain, in none they lose; these are two that gain."""
    clean, plant = unstable_episodes(3)
    data, _ = unstable_episodes(3, noise * np.concatenate([e.X for e in clean]).std())
    start, truth, errors = km.identify.subspace(data, 2, delays=2), markov(*plant, 15), list[float]()
    for free in (False, True):
        model = km.identify.refine(start, data[:4], horizon=20, held_out=data[4:], iterations=40, free_starts=free)
        errors.append(float(np.abs(model_markov(model, 15) - truth).max()))
    assert errors[1] < errors[0] / 3


def test_free_starts_are_never_worse_than_their_start_on_the_rows_that_stop_them():
    for seed in range(2):
        data, _ = unstable_episodes(seed, 0.3)
        start = km.identify.subspace(data, 2, delays=3)
        found = km.identify.refine(start, data[:4], horizon=20, held_out=data[4:], free_starts=True)
        units = SignalUnits.of(data[:4], None)
        judged = cut_segments(data[4:], units, 3, 20, 10)
        before, after = (
            SimulationError(one).evaluate(one.parameters, judged)
            for one in (to_standard(m, units) for m in (start, found))
        )
        assert after <= before * (1 + 1e-9)


def test_models_that_begin_at_measured_rows_have_no_free_starts():
    data, _ = unstable_episodes(0)
    model = km.edmd(data, km.State() + km.Constant(), embedding=km.Delay(1))
    with pytest.raises(DataError, match="free_starts is for models with a hidden state"):
        km.identify.refine(model, data, horizon=5, free_starts=True)
