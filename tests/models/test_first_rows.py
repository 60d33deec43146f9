"""estimate_start: the state in which a record begins, from fewer rows than the model's past and from noisy ones."""

import numpy as np
import pytest

import koopmpc as km
from tests.models.test_hidden_state import saturating_record
from tests.models.test_subspace import linear_plant, record_of


@pytest.mark.parametrize("rows", [3, 4, 12])
@pytest.mark.parametrize("seed", range(3))
def test_as_many_rows_as_the_state_has_entries_give_it_exactly(seed, rows):
    rng = np.random.default_rng(seed)
    data = record_of(linear_plant(rng, 3), rng, steps=300)
    model, (e,) = km.identify.subspace(data, 3, delays=6), data
    start = km.identify.estimate_start(model, e.X[100 : 100 + rows], e.U[100 : 99 + rows])
    free = model.rollout(start, e.U[99 + rows : 180])
    assert np.abs(free - e.X[99 + rows : 181]).max() < 1e-8 * e.X.std()


def test_a_state_that_one_row_and_the_growth_of_another_tell_is_exact_after_a_growth_of_a_hundred_thousand():
    """The squared condition number of these rows is above 1e20; x1 and x2 stay apart as the first row says."""
    A, B, K = np.array([[1.5, 1, 1], [0, 1, 0], [0, 0, 1]]), np.array([[1.0], [0], [0]]), np.array([[1.2, 1, 1]])
    rng = np.random.default_rng(0)

    def run(steps, gain):
        X, U = [rng.uniform(-1, 1, 3)], []
        for _ in range(steps):
            U.append(0.3 * rng.standard_normal(1) - gain * K @ X[-1])
            X.append(A @ X[-1] + B @ U[-1])
        return km.Episode(X=np.array(X), U=np.array(U))

    model = km.edmd(km.Episodes([run(6, 0) for _ in range(40)], 0.1), km.State())
    held = run(30, 1)
    seen = np.array(held.X)
    seen[1:, 1:] = np.nan
    seen[0] += [0, 0.5, -0.5]
    start = km.identify.estimate_start(model, seen, held.U)
    assert start == pytest.approx(held.X[-1] + [0, 0.5, -0.5], abs=1e-9)


def test_more_rows_take_noise_out_of_the_state():
    rng = np.random.default_rng(1)
    plant = linear_plant(rng, 2)
    model = km.identify.subspace(record_of(plant, rng, steps=400), 2, delays=2)
    (clean,) = record_of(plant, rng, steps=300)
    errors = np.zeros(2)
    for k in range(0, 240, 12):
        seen = clean.X[k : k + 21] + 0.1 * rng.standard_normal((21, 1))
        history = km.Episode(X=seen, U=clean.U[k : k + 20])
        plain = model.rollout(seen[-1], clean.U[k + 20 : k + 30], history=history)
        start = km.identify.estimate_start(model, seen, clean.U[k : k + 20])
        found = model.rollout(start, clean.U[k + 20 : k + 30])
        errors += [np.sum((X[1:] - clean.X[k + 21 : k + 31]) ** 2) for X in (plain, found)]
    assert errors[1] < 0.5 * errors[0]


def test_a_hidden_state_with_polynomials_begins_with_four_rows():
    data, fresh = (saturating_record(np.random.default_rng(seed), 400) for seed in (0, 1))
    rails = (-np.inf, 1.2)
    model = km.identify.polynomial_state_space(data, [2], [2], horizon=30, rails=rails)
    step, (e,), errors = model.step_map(), fresh, np.zeros(2)
    for k in range(0, 360, 60):
        X, U, ahead = e.X[k : k + 4], e.U[k : k + 3], e.U[k + 3 : k + 23]
        past = km.Episode(X=np.vstack([np.repeat(X[:1], 5, axis=0), X]), U=np.vstack([np.repeat(U[:1], 5, axis=0), U]))
        for i, start in enumerate((model.start(X[-1], past), km.identify.estimate_start(model, X, U))):
            errors[i] += np.sum((step.rollout(start, ahead)[1:, 0] - e.X[k + 4 : k + 24, 0]) ** 2)
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("fit", [km.identify.subspace, km.identify.narx], ids=["subspace", "narx"])
def test_units_of_an_output_change_no_start(fit):
    rng = np.random.default_rng(4)
    (e,), starts = record_of(linear_plant(rng, 2), rng, steps=300, noise=0.05), []
    for unit in (1.0, 1e6, 1e-6):
        data = km.Episodes([km.Episode(X=unit * e.X, U=e.U)], 0.1)
        model = fit(data, delays=3, **({"degrees": 1} if fit is km.identify.narx else {}))
        starts.append(km.identify.estimate_start(model, unit * e.X[100:110], e.U[100:109])[0] / unit)
    assert starts[1:] == pytest.approx([starts[0]] * 2, rel=1e-6)


@pytest.mark.parametrize("rows", [2, 3])
@pytest.mark.parametrize("fit", [km.identify.subspace, km.identify.narx], ids=["subspace", "narx"])
def test_units_of_an_input_change_no_free_run_from_fewer_rows_than_the_past(fit, rows):
    rng = np.random.default_rng(4)
    (e,), runs = record_of(linear_plant(rng, 2), rng, steps=300, noise=0.05), []
    for unit in (1.0, 1e3, 1e-3):
        data = km.Episodes([km.Episode(X=e.X, U=unit * e.U)], 0.1)
        model = fit(data, delays=3, **({"degrees": 1} if fit is km.identify.narx else {}))
        start = km.identify.estimate_start(model, e.X[100 : 100 + rows], unit * e.U[100 : 99 + rows])
        runs.append(model.rollout(start, unit * e.U[99 + rows : 130])[:, 0])
    assert max(np.abs(run - runs[0]).max() for run in runs) < 1e-6


def test_what_tells_no_start_is_refused_in_a_sentence():
    rng = np.random.default_rng(0)
    data = record_of(linear_plant(rng, 2), rng, steps=200)
    model = km.identify.subspace(data, 2, delays=3)
    with pytest.raises(km.errors.DataError, match="no row of X is whole"):
        km.identify.estimate_start(model, [[np.nan], [np.nan]], [[0.0]])
    with pytest.raises(km.errors.DataError, match="no row of X is whole"):
        km.identify.estimate_start(model, np.zeros((0, 1)), np.zeros((0, 1)))
    with pytest.raises(km.errors.ShapeError, match="U has shape"):
        km.identify.estimate_start(model, [[0.0], [0.0]], [[0.0], [0.0]])
    grows = km.edmd(km.Episodes([km.Episode(X=1.5 ** np.arange(8.0)[:, None], U=np.zeros((7, 0)))], 0.1), km.State())
    with pytest.raises(km.errors.DataError, match="overflows; pass fewer"):
        km.identify.estimate_start(grows, np.zeros((2500, 1)), np.zeros((2499, 0)))
