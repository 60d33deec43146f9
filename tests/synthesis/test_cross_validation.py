"""Cross-validation shares features, sums and steps between folds and ridges, and scores as if it shared nothing."""

from functools import partial, reduce

import numpy as np
import pytest

import koopmpc as km
from koopmpc.models.moments.moments import Moments
from koopmpc.models.moments.read import second_moments
from koopmpc.models.records.hidden_structure import HiddenStructure
from koopmpc.synthesis.search.candidates import Candidate
from koopmpc.synthesis.search.cross_validation import Trial, cross_validate, fit_ridges, leave_one_out
from koopmpc.synthesis.search.folds import select_fold

RIDGES = (1e-7, 1e-4, 1e-2)
FOLD, HORIZON, FIRST = (0, 1, 2, 0, 1, 2), 5, 2


def record(steps: int = 10, nw: int = 0) -> km.Episodes:
    """Return six noisy episodes of a quadratic plant whose input acts by its state, under measured disturbances."""
    rng = np.random.default_rng(3)
    parts: list[km.Episode] = []
    for _ in FOLD:
        U, W, X = 0.5 * rng.uniform(-1, 1, (steps, 2)), rng.uniform(-1, 1, (steps, nw)), [0.5 * rng.uniform(-1, 1, 2)]
        for u, w in zip(U, W, strict=True):
            a, b = X[-1]
            X.append(np.array([0.9 * a + 0.2 * b + 0.1 * w.sum(), 0.8 * b + 0.3 * a * a + 0.2 * u[0] + 0.1 * u[1] * a]))
        parts.append(km.Episode(X=np.array(X) + 0.002 * rng.standard_normal((steps + 1, 2)), U=U, W=W))
    return km.Episodes(parts, 0.1)


def forecast(model: km.BilinearPredictor | km.LinearPredictor, e: km.Episode, k: int, relift: bool) -> np.ndarray:
    """Return x̂ of one model from one start, a step and a product at a time."""
    past = 0 if model.embedding is None else model.embedding.steps
    history = e.cut(k - past, k) if past else None
    point = model.start(e.X[k], history)
    z, rows = model.lifting(point), []
    for u, w in zip(e.U[k : k + HORIZON], e.W[k : k + HORIZON], strict=True):
        z_next = model.A @ z + model.B @ u + model.E @ w
        if isinstance(model, km.BilinearPredictor):
            z_next += sum(v * (N @ z) for v, N in zip([*u, *w], [*model.N, *model.S], strict=True))
            z_next += sum(v * (M @ u) for v, M in zip(w, model.M, strict=True))
        rows.append(model.C @ z_next)
        if relift:
            point = rows[-1] if model.embedding is None else model.embedding.shift(point, u, rows[-1])
            z_next = model.lifting(point)
        z = z_next
    return np.array(rows)


@pytest.mark.parametrize(("nw", "delays"), [(1, 0), (0, 1)])
@pytest.mark.parametrize(("bilinear", "relift"), [(False, True), (True, False), (True, True)])
def test_a_score_is_that_of_a_fit_and_a_forecast_for_each_fold_ridge_and_start(nw, delays, bilinear, relift):
    data = record(nw=nw)
    lifting, embedding = km.State() + km.Constant(), km.Delay(delays) if delays else None
    given = km.synthesis.Candidate("", lifting if delays else lifting + km.Monomials(2), embedding, bilinear)
    candidate = given.bind(data.states, data.inputs)
    result = cross_validate(Trial(candidate, data, FOLD, HORIZON, FIRST, RIDGES, relift=relift))
    read = partial(
        second_moments, lifting=candidate.lifting, embedding=candidate.embedding, route="qr", bilinear=bilinear
    )
    spread = np.concatenate([e.X for e in data]).std(axis=0)
    for f in range(3):
        rest = reduce(
            Moments.__add__,
            [read(select_fold(data.driven(products=bilinear), FOLD, other)) for other in {0, 1, 2} - {f}],
        )
        for i, ridge in enumerate(RIDGES):
            (model,) = fit_ridges(candidate, rest, data, (ridge,))
            gaps = [
                (e.X[k + 1 : k + HORIZON + 1] - forecast(model, e, k, bilinear and relift)) / spread
                for e, own in zip(data, FOLD, strict=True)
                if own == f
                for k in range(FIRST, len(e) - HORIZON + 1)
            ]
            expected = np.sqrt(np.mean(np.square(gaps), axis=(0, 2)))
            assert result.errors[i, f] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("count", [2, 3, 6])
def test_shared_sums_are_those_of_the_other_parts(count):
    data = record(steps=20)
    parts = [second_moments(data[i : i + 1], km.State() + km.Constant(), route="qr") for i in range(count)]
    *rests, total = leave_one_out(parts)
    for i, rest in enumerate([*rests, total]):
        others = data.with_episodes([data[j] for j in range(count) if j != i])
        plain = second_moments(others, km.State() + km.Constant(), route="gram").sums
        assert rest.samples == sum(map(len, others))
        assert np.allclose(rest.sums.T @ rest.sums, plain, rtol=1e-12, atol=1e-12)


def test_a_hidden_state_whose_blocks_are_too_short_is_not_chosen():
    rng = np.random.default_rng(0)
    blocks = [km.Episode(X=rng.normal(size=(6, 1)), U=rng.normal(size=(5, 1))) for _ in range(4)]
    structure = HiddenStructure(1, 1, 8, 20, None, np.ones(8), True, 3)
    candidate = Candidate("hidden", km.State() + km.Constant(), km.Delay(8), False, structure)
    data = km.Episodes(blocks, 0.1, ["y"], ["u"])
    result = cross_validate(Trial(candidate.bind(data.states, data.inputs), data, (0, 0, 1, 1), 2, 8, (0.0,)))
    assert np.isinf(result.errors).all()
    assert np.isfinite(result.A).all()


def test_hidden_states_learn_from_measured_rows_and_are_judged_beside_the_others():
    """Smoothed rows of the past hold the future: models that learned from them err more in 9 of 9 records."""
    data = record(steps=20)
    raw = data.with_episodes([km.Episode(X=e.X + 0.1 * np.sin(np.arange(len(e.X)))[:, None], U=e.U) for e in data])
    structure = HiddenStructure(1, 1, 4, 0, None, np.ones(8), True, 3)
    candidate = Candidate("hidden", km.State() + km.Constant(), km.Delay(4), False, structure)
    candidate = candidate.bind(data.states, data.inputs)
    fold = (0, 1) * (len(data) // 2)
    found = [cross_validate(Trial(candidate, d, fold, 2, 4, (0.0,), raw=r)) for d, r in ((data, raw), (raw, None))]
    assert np.array_equal(found[0].A, found[1].A)
    assert not np.array_equal(found[0].errors, found[1].errors)
