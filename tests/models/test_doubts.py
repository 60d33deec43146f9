"""A doubtful fit warns once, says why, and keeps the sentence in its report."""

import warnings
from inspect import currentframe
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from tests.models.plants import random_episodes


def warned(data: km.Episodes, lifting: km.Lifting, **options: float) -> tuple[km.LinearPredictor, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = km.edmd(data, lifting, **options)
    assert all(issubclass(w.category, km.FitWarning) for w in caught)
    sentences = [str(w.message) for w in caught]
    assert model.report is not None
    assert list(model.report.warnings) == sentences  # each once, and in the report
    assert np.isfinite(model.A).all()
    assert np.isfinite(model.B).all()
    return model, sentences


def test_fewer_snapshots_than_coefficients_are_doubted() -> None:
    data = random_episodes(0, [5], 2, 1)
    model, sentences = warned(data, km.Constant() + km.State() + km.Monomials(2))
    assert len(sentences) == 1
    assert sentences[0].startswith("rank-deficient: 5 snapshot pairs cannot determine 7 coefficients a row")
    assert model.report.condition == np.inf
    assert model.report.rank == 5


def test_a_state_that_never_moves_doubles_the_constant() -> None:
    data = random_episodes(0, [60], 2, 1)
    still = km.Episodes([km.Episode(X=e.X * [1, 0] + [0, 3], U=e.U) for e in data], 0.1, ["x [m]", "m [kg]"])
    model, sentences = warned(still, km.Constant() + km.State())
    assert len(sentences) == 1
    assert "1 of 3 observables are linear functions of others" in sentences[0]
    assert "'m [kg]' of '1'" in sentences[0] or "'1' of 'm [kg]'" in sentences[0]
    assert model.report.rank == 3
    assert model.report.columns == 4
    assert "qr" in model.report.route


def test_a_duplicate_column_is_named() -> None:
    data = random_episodes(0, [60], 2, 0)
    double = km.Episodes([km.Episode(X=np.column_stack([e.X, 2 * e.X[:, 0]])) for e in data], 0.1, ["a", "b", "c"])
    _, sentences = warned(double, km.State())
    assert len(sentences) == 1
    assert "'c' of 'a'" in sentences[0] or "'a' of 'c'" in sentences[0]
    assert "'b'" not in sentences[0]
    assert "…" not in sentences[0]  # the list is whole


def test_of_many_duplicate_columns_some_are_named_and_the_list_says_that_it_goes_on() -> None:
    data = random_episodes(0, [90], 2, 0)
    copies = np.arange(1.0, 13.0)
    many = km.Episodes([km.Episode(X=np.column_stack([e.X, np.outer(e.X[:, 0], copies)])) for e in data], 0.1)
    _, sentences = warned(many, km.State())
    assert "12 of 14 observables are linear functions of others" in sentences[0]
    assert ", …" in sentences[0]


@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_the_condition_number_is_that_of_columns_of_unit_norm(size: float) -> None:
    data = random_episodes(0, [60], 2, 1)
    scaled = km.Episodes([km.Episode(X=e.X * [1.0, size], U=e.U) for e in data], 0.1)
    model, sentences = warned(scaled, km.State())
    P = np.vstack([np.hstack([e.X[:-1], e.U]) for e in scaled])
    assert not sentences
    assert model.report.condition == pytest.approx(np.linalg.cond(P / np.linalg.norm(P, axis=0)), rel=1e-6)


def test_inputs_that_move_together_are_named() -> None:
    data = random_episodes(0, [60], 2, 1)
    both = km.Episodes([km.Episode(X=e.X, U=np.hstack([e.U, -e.U])) for e in data], 0.1)
    model, sentences = warned(both, km.State())
    assert len(sentences) == 1
    assert "1 of 2 inputs are linear functions of others" in sentences[0]
    assert np.allclose(model.B[:, 0], -model.B[:, 1])


def test_feedback_makes_A_and_B_inseparable() -> None:
    data = random_episodes(0, [60], 2, 1)
    fed = km.Episodes([km.Episode(X=e.X, U=e.X[:-1] @ [[0.5], [-2]]) for e in data], 0.1)
    for ridge in (0.0, 1e-3):  # a ridge hides it, and cures nothing
        _, sentences = warned(fed, km.State(), ridge=ridge)
        assert len(sentences) == 1
        assert sentences[0].startswith("feedback made A and B inseparable")
        assert "rank [Z U] = 2, rank Z + rank U = 3" in sentences[0]
        assert "add noise to the input, or pass a known B to dmdc" in sentences[0]


def test_noise_on_the_feedback_separates_them() -> None:
    data = random_episodes(0, [60], 2, 1)
    fed = km.Episodes([km.Episode(X=e.X, U=e.X[:-1] @ [[0.5], [-2]] + 0.1 * e.U) for e in data], 0.1)
    _, sentences = warned(fed, km.State())
    assert not sentences


def test_an_input_that_was_always_zero_is_named_and_gets_a_zero_column() -> None:
    data = random_episodes(0, [60], 2, 2)
    idle = km.Episodes([km.Episode(X=e.X, U=e.U * [1, 0]) for e in data], 0.1, inputs=["u [N]", "idle [N]"])
    model, sentences = warned(idle, km.State())
    assert len(sentences) == 1
    assert "'idle [N]' was 0 in all snapshots" in sentences[0]
    assert np.array_equal(model.B[:, 1], [0, 0])
    alone = km.edmd(km.Episodes([km.Episode(X=e.X, U=e.U[:, :1]) for e in idle], 0.1), km.State())
    assert np.allclose(model.A, alone.A, atol=1e-12)
    assert np.allclose(model.B[:, :1], alone.B, atol=1e-12)


def test_data_of_zeros_do_not_crash() -> None:
    still = km.Episodes([km.Episode(X=np.zeros((9, 2)), U=np.zeros((8, 1)))], 0.1)
    model, sentences = warned(still, km.State())
    assert len(sentences) == 1
    assert "'x0', 'x1', 'u0' was 0 in all snapshots" in sentences[0]
    assert not model.A.any()
    model, sentences = warned(still, km.State(), rank=1)
    assert not model.A.any()
    assert "the snapshots have rank 0" in sentences[1]
    with pytest.warns(km.FitWarning, match="was 0 in all snapshots"):
        km.dmdc(still)
    with pytest.warns(km.FitWarning, match="was 0 in all snapshots"):
        km.dmd(km.Episodes([km.Episode(X=np.zeros((9, 2)))], 0.1))


def test_nearly_parallel_observables_are_ill_conditioned() -> None:
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (60, 1))
    data = km.Episodes([km.Episode(X=np.hstack([X, X + 1e-11 * rng.uniform(-1, 1, X.shape)]))], 0.1)
    model, sentences = warned(data, km.State())
    assert len(sentences) == 1
    assert sentences[0].startswith("ill-conditioned: the observables have condition number")
    assert "pass a ridge" in sentences[0]
    assert model.report.condition > 1e10
    assert not warned(data, km.State(), ridge=1e-6)[1]  # the user has seen to it


def test_a_rank_that_the_data_do_not_have_is_lowered() -> None:
    data = random_episodes(0, [60], 2, 0)
    flat = km.Episodes([km.Episode(X=e.X[:, [0, 1, 0]]) for e in data], 0.1)
    model, sentences = warned(flat, km.State(), rank=3)
    assert len(sentences) == 1
    assert "rank 3 was asked for, the snapshots have rank 2, which is taken" in sentences[0]
    assert model.A.shape == (2, 2)
    assert not warned(flat, km.State(), rank=2)[1]


@pytest.mark.unhooked
def test_a_doubt_points_at_the_callers_line() -> None:
    data = km.Episodes([km.Episode(X=np.ones((6, 2)), U=np.zeros((5, 0)))], 0.1)
    line = currentframe().f_lineno + 2
    with pytest.warns(km.FitWarning) as caught:
        km.edmd(data, km.State() + km.Monomials(2))
    assert {(Path(warning.filename).name, warning.lineno) for warning in caught} == {("test_doubts.py", line)}


def test_three_dependent_columns_are_named_and_more_are_hinted_at() -> None:
    data = random_episodes(0, [60], 1, 0)
    for count in (3, 4):
        X = [np.column_stack([(i + 1) * e.X[:, 0] for i in range(count + 1)]) for e in data]
        _, sentences = warned(km.Episodes([km.Episode(X=each) for each in X], 0.1), km.State())
        assert f"{count} of {count + 1} observables are linear functions of others" in sentences[0]
        assert sentences[0].count(" of 'x") == 3
        assert (", …)" in sentences[0]) == (count > 3)
