"""Priors: brute-force CVXPY on the full data, KKT conditions, what they say of each entry, clear refusals."""

import warnings

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.models.plants import brute_force, one_step_pairs, random_episodes
from tests.roundtrip import returned

LIFTING = km.State() + km.Constant()
NAN, INF = np.nan, np.inf


def linear(A: np.ndarray, B: np.ndarray, noise: float = 0.0, seed: int = 0) -> km.Episodes:
    rng = np.random.default_rng(seed)
    return one_step_pairs(
        lambda x, u: A @ x + B @ u + noise * rng.standard_normal(len(x)), len(A), B.shape[1], 60, seed
    )


PINNED = {"known entries": [2], "known rows": [0, 2], "masks": [0], "contraction": [0, 1]}  # rows without an intercept


def oracle(data: km.Episodes, lifting, ridge: float, constrain, pinned=()) -> np.ndarray:
    """Solve the program on every row of the data, in raw units; return [A B]."""
    D = brute_force(data, lifting.bind(data.states))
    nz = lifting.bind(data.states).nz
    P, T = D[:, :-nz], D[:, -nz:]
    A, B = cp.Variable((nz, nz)), cp.Variable((nz, P.shape[1] - nz))
    K = cp.hstack([A, B])
    unit = np.linalg.norm(T, axis=0)
    misfit = cp.sum_squares(T / unit - P @ cp.multiply(K, 1 / np.outer(unit, np.ones(P.shape[1]))).T)
    size = np.tile(np.linalg.norm(P - P.mean(axis=0), axis=0), (nz, 1))
    size[list(pinned)] = np.linalg.norm(P, axis=0)
    penalty = ridge * cp.sum_squares(cp.multiply(K, size / unit[:, None]))
    cp.Problem(cp.Minimize(misfit + penalty), constrain(A, B)).solve(
        solver=cp.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12
    )
    return np.hstack([A.value, B.value])


def found(model) -> np.ndarray:
    return np.hstack([model.A, model.B])


STORE = np.diag([2.0, 1.0, 0.0])
CASES = {
    "known entries": (
        km.identify.Prior(A=[[NAN, 0.1, NAN], [NAN] * 3, [0, 0, 1]], B=[[0.0], [NAN], [0.0]]),
        lambda A, B: [A[0, 1] == 0.1, B[0, 0] == 0, A[2] == [0, 0, 1], B[2, 0] == 0],
    ),
    "known rows": (
        km.identify.Prior(rows={"x0": {"x0": 1.0, "x1": 0.1}, "1": {"1": 1.0}}),
        lambda A, B: [A[0] == [1, 0.1, 0], A[2] == [0, 0, 1], B[0] == 0, B[2] == 0],
    ),
    "masks": (
        km.identify.Prior(mask_A=[[1, 1, 0], [0, 1, 1], [0, 0, 1]], mask_B=[[0], [1], [0]]),
        lambda A, B: [A[0, 2] == 0, A[1, 0] == 0, A[2, :2] == 0, B[0] == 0, B[2] == 0],
    ),
    "bounds": (
        km.identify.Prior(lower_A=0.0, upper_A=[[0.02] * 3, [np.inf] * 3, [1.0] * 3], upper_B=0.01),
        lambda A, B: [A >= 0, A[0] <= 0.02, A[2] <= 1, B <= 0.01],
    ),
    "symmetric": (km.identify.Prior(symmetric=True), lambda A, B: [A == A.T]),
    "combinations": (
        km.identify.Prior(combinations=[km.identify.Combination(1, 1, A=np.ones((3, 3))), km.identify.Combination(0.2, np.inf, B=np.ones((3, 1)))]),
        lambda A, B: [cp.sum(A) == 1, cp.sum(B) >= 0.2],
    ),
    "combinations of both": (
        km.identify.Prior(combinations=[
            km.identify.Combination(-np.inf, -0.5, A=np.eye(3), B=2 * np.ones((3, 1))),
            km.identify.Combination(0.3, 0.4, B=[[1], [0], [0]]),
        ]),
        lambda A, B: [cp.trace(A) + 2 * cp.sum(B) <= -0.5, B[0, 0] >= 0.3, B[0, 0] <= 0.4],
    ),
    "contraction": (
        km.identify.Prior(dissipation=km.identify.Dissipation(STORE, decay=0.5), mask_A=[[1, 1, 0], [1, 1, 0], [1, 1, 1]]),
        lambda A, B: [
            A[:2, 2] == 0,
            cp.bmat([[0.25 * STORE[:2, :2], (np.sqrt(STORE[:2]) @ A[:, :2]).T],
                     [np.sqrt(STORE[:2]) @ A[:, :2], np.eye(2)]]) >> 0,
        ],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("ridge", [0.0, 0.1])
def test_equals_brute_force_on_all_rows(name: str, ridge: float) -> None:
    prior, constrain = CASES[name]
    data = random_episodes(3, [40, 30], 2, 1)
    model = km.identify.constrained_edmd(data, LIFTING, prior=prior, ridge=ridge)
    assert np.allclose(found(model), oracle(data, LIFTING, ridge, constrain, PINNED.get(name, ())), rtol=0, atol=2e-6)
    assert model.report.changes
    assert returned(prior) == prior


def test_passivity_holds_and_equals_the_program_in_raw_units() -> None:
    data = random_episodes(5, [60], 2, 1)
    P, C, D = np.diag([1.0, 2.0]), np.array([[0.3, 0.1]]), np.array([[0.2]])
    model = km.identify.constrained_edmd(
        data, km.State(), prior=km.identify.Prior(dissipation=km.identify.Dissipation(P, C=C, D=D))
    )

    def passive(A, B):  # in z, u directly: P⁻¹ instead of a factor
        return [cp.bmat([[P, C.T, A.T], [C, D + D.T, B.T], [A, B, np.linalg.inv(P)]]) >> 0]

    assert np.allclose(found(model), oracle(data, km.State(), 0.0, passive), rtol=0, atol=1e-6)
    rng = np.random.default_rng(0)
    for z, u in zip(rng.standard_normal((200, 2)), rng.standard_normal((200, 1)), strict=True):
        after = model.A @ z + model.B @ u
        assert 0.5 * after @ P @ after <= 0.5 * z @ P @ z + u @ (C @ z + D @ u) + 1e-7


@given(st.integers(0, 999))
@settings(max_examples=10)
def test_bounds_meet_the_KKT_conditions(seed: int) -> None:
    data = random_episodes(seed, [50], 3, 1)
    lower = np.where(np.random.default_rng(seed).uniform(size=(3, 3)) < 0.5, 0.02, -np.inf)
    model = km.identify.constrained_edmd(data, km.State(), prior=km.identify.Prior(lower_A=lower, upper_B=0.0))
    D = brute_force(data, km.State().bind(data.states))
    P, T = D[:, :4], D[:, 4:]
    slope = (found(model) @ P.T - T.T) @ P / len(P)  # of ½ the mean squared residual
    K = found(model)
    low = np.hstack([lower, np.full((3, 1), -np.inf)])
    high = np.hstack([np.full((3, 3), np.inf), np.zeros((3, 1))])
    assert (low <= K).all()
    assert (high >= K).all()
    at_low, at_high = low + 1e-7 >= K, high - 1e-7 <= K
    assert np.abs(slope[~at_low & ~at_high]).max(initial=0) < 1e-6
    assert (slope[at_low] > -1e-6).all()
    assert (slope[at_high] < 1e-6).all()


A_TRUE = np.array([[0.9, 0.1, 0.0], [0.1, 0.7, 0.0], [0.0, 0.0, 0.5]])
B_TRUE = np.array([[0.0], [0.5], [0.0]])
TRUTHS = [
    km.identify.Prior(rows={"x2": {"x2": 0.5}}),
    km.identify.Prior(B=B_TRUE),
    km.identify.Prior(mask_A=A_TRUE != 0, mask_B=B_TRUE != 0),
    km.identify.Prior(lower_A=-1e-9, lower_B=-1e-9, upper_A=1.0),
    km.identify.Prior(symmetric=True),
    km.identify.Prior(combinations=[km.identify.Combination(2.1, 2.1, A=np.eye(3))]),
    km.identify.Prior(dissipation=km.identify.Dissipation([1, 1, 1])),
]


@pytest.mark.parametrize("prior", TRUTHS)
def test_a_true_prior_does_not_move_the_fit_of_exact_data(prior: km.identify.Prior) -> None:
    data = linear(A_TRUE, B_TRUE)
    model, plain = km.identify.constrained_edmd(data, km.State(), prior=prior), km.edmd(data, km.State())
    assert np.allclose(found(model), found(plain), rtol=0, atol=1e-11)
    assert np.allclose(found(model), np.hstack([A_TRUE, B_TRUE]), rtol=0, atol=1e-11)


def test_a_known_B_separates_what_feedback_made_inseparable() -> None:
    A, B = np.array([[1.5, 0], [0, 0.1]]), np.array([[1.0], [0.0]])
    data = one_step_pairs(lambda x, u: A @ x + B @ u, 2, 1, 50)
    closed = km.Episodes([type(e)(X=[e.X[0], A @ e.X[0] - B @ e.X[0, :1]], U=[-e.X[0, :1]]) for e in data], data.dt)
    model = km.identify.constrained_edmd(
        closed, km.State(), prior=km.identify.Prior(B=B)
    )  # no FitWarning: nothing doubtful is left
    assert np.allclose(model.A, A, atol=1e-12)


def test_units_mean_nothing_under_bounds() -> None:
    data = random_episodes(2, [80], 2, 1)
    units = np.array([1e-4, 1e4])
    scaled = km.Episodes([type(e)(X=e.X * units, U=1e3 * e.U) for e in data], data.dt)
    a = km.identify.constrained_edmd(data, km.State(), prior=km.identify.Prior(lower_A=0.0, lower_B=0.0))
    b = km.identify.constrained_edmd(scaled, km.State(), prior=km.identify.Prior(lower_A=0.0, lower_B=0.0))
    assert np.allclose(b.A * units / units[:, None], a.A, atol=1e-7)
    assert np.allclose(b.B * 1e3 / units[:, None], a.B, atol=1e-7)


def test_measured_disturbances_are_the_last_columns_of_B() -> None:
    rng = np.random.default_rng(0)
    X, U, W = rng.standard_normal((40, 2)), rng.standard_normal((39, 1)), rng.standard_normal((39, 1))
    data = km.Episodes([type(random_episodes(0, [2], 1, 0)[0])(X=X, U=U, W=W)], 0.1)
    model = km.identify.constrained_edmd(data, km.State(), prior=km.identify.Prior(B=[[NAN, 0.5], [NAN, 0.0]]))
    assert np.array_equal(model.E, [[0.5], [0.0]])
    assert model.B.shape == (2, 1)


DOUBLE = km.Episodes([km.Episode(X=np.column_stack([e.X, 2 * e.X[:, 0]]), U=e.U) for e in random_episodes(0, [60], 2, 1)], 0.1)  # fmt: skip


@pytest.mark.parametrize(
    ("prior", "ridge", "doubted"),
    [
        (km.identify.Prior(), 0.0, True),
        (km.identify.Prior(), 1e-3, False),  # who asks for a ridge knows of dependent observables
        (km.identify.Prior(mask_A=[[1, 0, 1], [1, 1, 0], [1, 1, 0]]), 0.0, True),  # free in one row is enough
        (km.identify.Prior(mask_A=[[1, 1, 0], [1, 1, 0], [1, 1, 0]]), 0.0, False),
    ],
)
def test_dependent_columns_are_doubted_where_one_row_may_use_them(
    prior: km.identify.Prior, ridge: float, doubted: bool
) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = km.identify.constrained_edmd(DOUBLE, km.State(), prior=prior, ridge=ridge)
    assert ["linear functions of others" in str(w.message) for w in caught] == [True] * doubted
    assert len(model.report.warnings) == doubted


def test_a_symmetric_model_meets_its_prior_and_nothing_is_doubted() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = km.identify.constrained_edmd(
            random_episodes(0, [60], 2, 1), km.State(), prior=km.identify.Prior(symmetric=True)
        )
    assert np.allclose(model.A, model.A.T, atol=1e-9)


REFUSED = [
    ({"A": np.eye(2)}, km.errors.ShapeError, r"Prior.A has shape \(2, 2\), expected \(3, 3\)"),
    ({"mask_B": [[1, 1]]}, km.errors.ShapeError, "mask_B has shape"),
    ({"lower_A": [[0.0]]}, km.errors.ShapeError, "lower_A has shape"),
    ({"rows": {"speed": {}}}, km.errors.DataError, "rows names 'speed'; it can name x0, x1, 1"),
    ({"rows": {"x0": {"x0": 1.0}}, "A": [[2, NAN, NAN], [NAN] * 3, [NAN] * 3]}, km.errors.DataError, "another prior says 2"),
    ({"A": np.full((3, 3), 2.0), "upper_A": 1.0}, km.errors.DataError, "contradict each other at 'x0'"),
    ({"lower_B": 1.0, "upper_B": 0.0}, km.errors.DataError, "contradict each other"),
    ({"combinations": [km.identify.Combination(0, 1, A=np.eye(2))]}, km.errors.ShapeError, "Combination.A has shape"),
    ({"dissipation": km.identify.Dissipation([1, 1])}, km.errors.ShapeError, "Dissipation.P has shape"),
    (
        {"combinations": [km.identify.Combination(5, 6, A=np.eye(3))], "upper_A": 1.0},
        km.errors.DataError,
        "no A and B meet all priors: Clarabel says 'infeasible",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("parts", "kind", "text"), REFUSED)
def test_what_cannot_be_is_refused(parts: dict, kind: type[Exception], text: str) -> None:
    data = random_episodes(0, [40], 2, 1)
    with pytest.raises(kind, match=text):
        km.identify.constrained_edmd(data, LIFTING, prior=km.identify.Prior(**parts))


def test_parts_of_a_prior_are_checked_where_they_are_made() -> None:
    with pytest.raises(km.errors.DataError, match="no weights"):
        km.identify.Combination(0, 1)
    with pytest.raises(km.errors.DataError, match="limits cross"):
        km.identify.Combination(1, 0, A=np.eye(2))
    with pytest.raises(km.errors.DataError, match="has D but no C"):
        km.identify.Dissipation([1.0], D=[[1.0]])
    with pytest.raises(km.errors.DataError, match="decay is 0"):
        km.identify.Dissipation([1.0], decay=0)
    with pytest.raises(km.errors.DataError, match="ridge is -1"):
        km.identify.constrained_edmd(random_episodes(0, [40], 2, 1), LIFTING, prior=km.identify.Prior(), ridge=-1)


def test_a_symmetry_that_the_plain_fit_has_needs_no_program() -> None:
    data = linear(np.array([[0.9, 0.2], [0.2, -0.7]]), np.ones((2, 1)))
    model = km.identify.constrained_edmd(data, km.State(), prior=km.identify.Prior(symmetric=True))
    assert "linear algebra under priors" in model.report.route
    skewed = linear(np.array([[0.9, 0.2], [0.201, -0.7]]), np.ones((2, 1)))
    model = km.identify.constrained_edmd(skewed, km.State(), prior=km.identify.Prior(symmetric=True))
    assert "Clarabel under priors" in model.report.route
    assert np.array_equal(model.A, model.A.T)


def test_bounds_that_the_plain_fit_meets_change_nothing() -> None:
    data = random_episodes(2, [80], 2, 1)
    plain = km.edmd(data, km.State())
    ends = {f"{end}_{name}": getattr(plain, name) for end in ("lower", "upper") for name in ("A", "B")}
    for some in (ends, {"lower_A": plain.A}, {"upper_A": plain.A, "upper_B": 9.0}):
        model = km.identify.constrained_edmd(data, km.State(), prior=km.identify.Prior(**some))
        assert np.array_equal(found(model), found(plain))
        assert "linear algebra under priors" in model.report.route


def test_the_report_counts_what_is_known_and_what_stands_at_a_bound_and_names_what_couples() -> None:
    data = random_episodes(3, [40, 30], 2, 1)
    prior = km.identify.Prior(mask_A=[[1, 1], [0, 1]], upper_B=[[-5.0], [np.inf]], lower_A=-9.0)
    changes = km.identify.constrained_edmd(data, km.State(), prior=prior).report.changes
    assert changes[:2] == ("1 of 6 entries of [A B] are known", "1 entries stand at a bound")
    assert len(changes) == 3
    prior = km.identify.Prior(lower_B=[[5.0], [0.0]], upper_A=9.0, lower_A=[[-9.0, 2.0], [-9.0, -9.0]])
    changes = km.identify.constrained_edmd(data, km.State(), prior=prior).report.changes
    assert changes[0] == f"{2 + int(km.edmd(data, km.State()).B[1, 0] < 0)} entries stand at a bound"
    for some, words in (
        ({"symmetric": True}, "A is symmetric"),
        ({"combinations": [km.identify.Combination(-9, 9, A=np.eye(2))]}, "combinations of entries are limited"),
        ({"dissipation": km.identify.Dissipation([9, 9])}, "energy that is stored is dissipated as the prior says"),
    ):
        changes = km.identify.constrained_edmd(data, km.State(), prior=km.identify.Prior(**some)).report.changes
        assert changes[0] == words
        assert len(changes) == 2
