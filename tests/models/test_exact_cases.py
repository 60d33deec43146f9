"""Systems that a finite lifting holds exactly, to the digits that their papers and arithmetic give."""

import numpy as np
import pytest
from scipy.linalg import expm, logm, solve_continuous_are

import koopmpc as km
from tests.models.plants import one_step_pairs

SQUARE = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x0^2"])


def held_input(Ac: np.ndarray, Bc: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (A, B) of ż = Ac z + Bc u with u held over dt: the exponential of [[Ac Bc], [0 0]] dt."""
    n, m = Bc.shape
    E = expm(np.block([[Ac, Bc], [np.zeros((m, n + m))]]) * dt)
    return E[:n, :n], E[:n, n:]


def slow_manifold(mu: float, lam: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """ẋ = [μx₁; λ(x₂ − x₁²) + u] on [x₁, x₂, x₁²], discretised exactly (Brunton et al. 2016)."""
    Ac = np.array([[mu, 0, 0], [0, lam, -lam], [0, 0, 2 * mu]])
    return held_input(Ac, np.array([[0.0], [1], [0]]), dt)


def data_of(A: np.ndarray, B: np.ndarray, count: int = 300) -> km.Episodes:
    """One-step data of x⁺ = the first two rows of A [x; x₁²] + B u."""
    return one_step_pairs(lambda x, u: A[:2] @ [*x, x[0] ** 2] + B[:2] @ u, 2, 1, count)


def test_edmd_is_exact_on_the_slow_manifold_of_brunton_2016() -> None:
    A, B = slow_manifold(-0.1, 1.0, 0.01)
    model = km.edmd(data_of(A, B), SQUARE)
    assert np.allclose(model.A, A, rtol=0, atol=1e-12)
    assert np.allclose(model.B, B, rtol=0, atol=1e-12)
    # back in continuous time, its Riccati gain is the printed one
    generator = logm(np.block([[model.A, model.B], [np.zeros((1, 3)), np.eye(1)]])).real / 0.01
    Ac, Bc = generator[:3, :3], generator[:3, 3:]
    K = Bc.T @ solve_continuous_are(Ac, Bc, np.diag([1.0, 1.0, 0.0]), np.eye(1))
    assert K[0] == pytest.approx([0, 2.414214, -1.495597], abs=1e-6)


def test_brunton_2016_long_predictions_stay_exact() -> None:
    A, B = slow_manifold(-0.1, 1.0, 0.01)
    model = km.edmd(data_of(A, B), SQUARE)
    U = np.random.default_rng(0).uniform(-1, 1, (200, 1))
    z = np.array([-2.0, 1.5, 4.0])
    expected = [z]
    for u in U:
        z = A @ z + B @ u
        expected.append(z)
    assert np.allclose(model.rollout([-2, 1.5], U), np.array(expected)[:, :2], rtol=1e-9)


PROCTOR = km.Episodes(
    [
        km.Episode(
            X=np.array([[4, 2, 1, 0.5, 0.25], [7, 0.7, 0.07, 0.007, 0.0007]]).T,
            U=np.array([[-4, -2, -1, -0.5]]).T,
        )
    ],
    1.0,
)


def test_proctor_2016_without_inputs_the_plant_looks_stable() -> None:
    assert np.allclose(km.dmd(PROCTOR).A, np.diag([0.5, 0.1]), rtol=0, atol=1e-14)


def test_proctor_2016_with_B_known_it_is_not() -> None:
    model = km.dmdc(PROCTOR, B=[[1], [0]])
    assert np.allclose(model.A, np.diag([1.5, 0.1]), rtol=0, atol=1e-14)
    assert np.array_equal(model.B, [[1], [0]])


def test_proctor_2016_with_B_unknown_feedback_makes_them_inseparable() -> None:
    with pytest.warns(km.FitWarning, match="feedback made A and B inseparable") as caught:
        model = km.dmdc(PROCTOR)
    assert len(caught) == 1
    assert np.allclose(model.A, np.diag([0.25, 0.1]), rtol=0, atol=1e-14)
    assert np.allclose(model.B, [[-0.25], [0]], rtol=0, atol=1e-14)
    assert model.report.rank == 2
    assert model.report.condition == np.inf


def test_williams_2015_eigenvalues_are_the_products() -> None:
    A = np.array([[0.9, -0.04], [0, 0.8]])
    data = one_step_pairs(lambda x, u: A @ x, 2, 0, 200)
    model = km.edmd(data, km.Constant() + km.State() + km.Monomials(4))
    products = sorted((0.9**i * 0.8**j for i in range(5) for j in range(5 - i)), reverse=True)
    assert len(products) == model.nz == 15
    assert np.abs(model.eigenvalues - products).max() < 1e-10


def test_edmd_is_exact_on_the_system_of_safedmd() -> None:
    A, B = slow_manifold(-2.0, 1.0, 0.01)
    data = data_of(A, B)
    lifting = km.State() + km.Expressions(lambda x: [x[1] - 0.2 * x[0] ** 2], ["x1 - 0.2 x0^2"])
    model = km.edmd(data, lifting)
    assert np.sort(model.eigenvalues.real) == pytest.approx([0.960789, 0.980199, 1.010050], abs=5e-7)
    assert np.abs(model.eigenvalues.imag).max() < 1e-12
    assert model.B[:, 0] == pytest.approx([0, 0.01005017, 0.01005017], abs=5e-9)
    s = data.snapshots()
    Z, Z_next = model.lift(s.X), model.lift(s.X_next)
    assert np.abs(Z_next - Z @ model.A.T - s.U @ model.B.T).max() < 1e-13
