"""km.identify.eigenfunctions: conserved quantities and eigenpairs from data, the effect of inputs, validation, bad input."""

import re
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import koopmpc as km


@dataclass(frozen=True)
class DoubleWell(km.Dynamics):
    """ẋ = [x₂; x₁ − x₁³ + u], which conserves x₂²/2 − x₁²/2 + x₁⁴/4 without input."""

    states = ("x1 [m]", "x2 [m/s]")
    inputs = ("u [m/s²]",)

    def rhs(self, x, u):
        return ca.vertcat(x[1], x[0] - x[0] ** 3 + u[0])


QUARTIC = km.State() + km.Monomials(4) + km.Constant()
ENERGY = {"x1^2": -1.0, "x2^2": 1.0, "x1^4": 0.5}


def free(starts, dt, steps):
    """Return unforced trajectories by SciPy's integrator."""

    def path(x0):
        t = np.arange(steps + 1) * dt
        f = lambda t, x: [x[1], x[0] - x[0] ** 3]  # noqa: E731
        return solve_ivp(f, (0, t[-1]), x0, t_eval=t, method="DOP853", rtol=1e-12, atol=1e-13).y.T

    return km.Episodes([km.Episode(X=path(x0)) for x0 in starts], dt, DoubleWell.states)


@pytest.fixture(scope="module")
def one():
    return free([[0.0, -2.8]], 0.01, 1000)


@pytest.fixture(scope="module")
def forced():
    plant = km.discretize(DoubleWell(), 0.02, km.RK4(4))
    return km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-1, 1), episodes=20, steps=100)


def named(phi):
    names = phi.lifting.names
    return {name: phi.coefficients[0, i] for i, name in enumerate(names) if phi.coefficients[0, i] != 0}


@pytest.mark.parametrize(("by", "exact"), [("steps", 1e-9), ("derivatives", 1e-5)])
def test_one_trajectory_holds_its_energy_with_exact_ratios_and_no_other_observable(one, by, exact):
    (H,) = km.identify.eigenfunctions(one, QUARTIC, by=by)
    assert named(H) == pytest.approx(ENERGY, rel=exact)
    assert H.eigenvalue == 0
    assert H.error < exact
    assert H.nu == 0


def test_what_is_printed_are_the_coefficients_and_the_eigenvalue(one):
    (H,) = km.identify.eigenfunctions(one, QUARTIC)
    label, text = str(H).split(" = ", 1)
    formula, rate, error = text.split(", ")
    terms = [re.fullmatch(r"\((.+)\) (.+)", term) for term in formula.split(" + ")]
    assert label == H.label
    assert {term[2]: float(term[1]) for term in terms} == pytest.approx(named(H), rel=1e-3)
    assert (rate, float(error.removeprefix("error "))) == ("λ = 0 1/s", pytest.approx(H.error, rel=0.1))


def test_the_null_space_is_that_of_differences_of_the_library_by_numpy(one):
    (H,) = km.identify.eigenfunctions(one, QUARTIC, held_out=one)
    Z = QUARTIC.bind(one.states)(one[0].X)[:, :-1]  # without the constant
    null = np.linalg.svd(np.diff(Z, axis=0))[2][-1]
    np.testing.assert_allclose(H.coefficients[0, :-1], null / null[list(H.lifting.names).index("x2^2")], atol=2e-7)


def test_values_and_gradient_are_those_of_the_formula(one):
    (H,) = km.identify.eigenfunctions(one, QUARTIC)
    X = np.random.default_rng(0).uniform(-2, 2, (20, 2))
    x, v = X.T
    np.testing.assert_allclose(H.values(X), v**2 - x**2 + x**4 / 2, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(H.gradient(X), np.column_stack([2 * x**3 - 2 * x, 2 * v]), rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(H(X)[:, 0], H.values(X))
    half = H.scaled(0.5, "H")
    np.testing.assert_allclose(half.values(X), H.values(X) / 2)
    assert half.names == ("H",)
    assert "(0.25) x1^4, λ = 0 1/s" in str(half)


def test_a_larger_library_holds_the_square_of_the_energy_too_and_both_are_sparse():
    data = free(np.random.default_rng(0).uniform(-1.5, 1.5, (12, 2)), 0.05, 60)
    found = km.identify.eigenfunctions(data, km.State() + km.Monomials(8))
    assert len(named(found[0])) == 3
    assert len(named(found[1])) <= 8 < 44 == found[1].lifting.nz
    X = np.random.default_rng(1).uniform(-1, 1, (50, 2))
    H, second = (phi.values(X) for phi in found)
    fitted = np.column_stack([H, H**2])
    np.testing.assert_allclose(fitted @ np.linalg.lstsq(fitted, second, rcond=None)[0], second, atol=1e-6)


def test_states_that_rest_are_conserved_alone_and_in_products_whatever_their_units():
    """Of five functions each has one observable, though any mixture of them is as constant."""
    starts = np.random.default_rng(0).uniform(-1, 1, (30, 2)) * [1e3, 1e-2]
    data = km.Episodes([km.Episode(X=np.tile(x, (5, 1))) for x in starts], 0.1, ["a", "b"])
    found = km.identify.eigenfunctions(data, km.State() + km.Monomials(2))
    assert sorted(tuple(named(phi)) for phi in found) == sorted([("a",), ("b",), ("a^2",), ("a*b",), ("b^2",)])


def test_identities_of_the_library_are_no_eigenfunctions():
    data = free(np.random.default_rng(0).uniform(-1.5, 1.5, (12, 2)), 0.05, 60)
    extra = km.Expressions(lambda x: [ca.sin(x[0]) ** 2, ca.cos(x[0]) ** 2], ["s2", "c2"])
    (H,) = km.identify.eigenfunctions(data, QUARTIC + extra)
    assert named(H) == pytest.approx(ENERGY, rel=1e-6)


def test_forced_data_hold_the_energy_and_how_the_input_moves_it(forced):
    (H,) = km.identify.eigenfunctions(forced, QUARTIC)
    assert named(H) == pytest.approx(ENERGY, rel=1e-4)
    X = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    beta = H.lifting(X) @ H.drive[0].T
    np.testing.assert_allclose(beta, 2 * X[:, 1:], atol=2e-3)  # ∇H · [0; 1]
    assert H.error < 1e-3


def test_the_explicit_regression_finds_eigenvalues_and_functions_of_the_slow_manifold():
    problem = km.load_problem("slow_manifold")
    plant = km.discretize(problem.dynamics, 0.05, km.RK4(2))
    data = km.collect(plant, km.Uniform([-2, -2], [2, 2]), km.Noise(-1, 1), episodes=20, steps=30)
    library = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x1²"]) + km.Constant()
    found = km.identify.eigenfunctions(data, library, eigenvalue=None)
    by_rate = {round(phi.eigenvalue.real, 6): phi for phi in found}
    assert sorted(by_rate) == [-0.2, -0.1, 1.0]
    coefficients = by_rate[1.0].coefficients[0]
    np.testing.assert_allclose(coefficients / coefficients[1], [0, 1, -1 / 1.2, 0], atol=1e-8)  # x₂ − λ/(λ − 2μ) x₁²
    np.testing.assert_allclose(by_rate[1.0].drive[0, 0] / coefficients[1], [0, 0, 0, 1], atol=1e-8)
    np.testing.assert_allclose(by_rate[-0.1].coefficients, [[1, 0, 0, 0]], atol=1e-12)


def test_a_complex_eigenfunction_turns_and_shrinks_as_its_eigenvalue_says():
    A = np.array([[-0.1, 2.0], [-2.0, -0.1]])
    values, vectors = np.linalg.eig(A * 0.05)
    step = ((vectors * np.exp(values)) @ np.linalg.inv(vectors)).real
    starts = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    paths = [np.array([np.linalg.matrix_power(step, k) @ x for k in range(40)]) for x in starts]
    data = km.Episodes([km.Episode(X=X) for X in paths], 0.05)
    (phi,) = km.identify.eigenfunctions(data, km.State(), eigenvalue=None)
    assert phi.eigenvalue == pytest.approx(-0.1 + 2j, abs=1e-9)
    told = phi.values(paths[0])
    np.testing.assert_allclose(told, told[0] * np.exp(phi.eigenvalue * 0.05 * np.arange(40)), atol=1e-9)
    assert phi(paths[0]).shape == (40, 2)
    assert phi.gradient(paths[0]).shape == (40, 2)
    size = km.identify.eigenfunctions(data, km.State() + km.Monomials(2), eigenvalue=-0.2)
    assert named(size[0]) == pytest.approx({"x0^2": 1.0, "x1^2": 1.0})  # |φ|² has 2 Re λ


def test_a_function_that_vanishes_on_the_data_is_none_of_any_eigenvalue(one):
    with pytest.warns(km.FitWarning, match="no eigenfunction predicts held-out data within"):
        found = km.identify.eigenfunctions(one, QUARTIC, eigenvalue=-0.7, tolerance=1e-3)
    assert len(found) == 0


def test_what_held_out_data_do_not_confirm_is_rejected():
    data = free(np.random.default_rng(0).uniform(-2, 2, (12, 2)), 0.05, 60)
    with pytest.warns(km.FitWarning, match="the best has an error of .*; pass a larger library or more data"):
        found = km.identify.eigenfunctions(data, km.State() + km.Monomials(2))
    assert len(found) == 0
    assert found.rejected
    assert min(phi.error for phi in found.rejected) > 0.05
    assert str(found).startswith("rejected: φ = ")


def test_an_eigenfunction_is_an_observable_of_models_and_comes_back_from_their_files(forced, tmp_path):
    (H,) = km.identify.eigenfunctions(forced, QUARTIC)
    model = km.edmd(forced, km.State() + H)
    assert model.lifting.names == (*DoubleWell.states, "φ")
    model.save(tmp_path / "model.npz")
    again = km.load_model(tmp_path / "model.npz")
    x = np.array([0.3, -0.4])
    np.testing.assert_array_equal(again.lift(x), model.lift(x))


@pytest.mark.unhooked
def test_bad_input_is_refused_in_a_sentence(one):
    for options, text in (
        ({"by": "slopes"}, 'by is \'slopes\'; pass "steps" or "derivatives"'),
        ({"growth": 0.5}, "growth is 0.5; pass a factor of at least 1"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"count": 0}, "count"),
        ({"held_out": km.Episodes([km.Episode(X=np.zeros((9, 3)))], 0.01)}, "held_out has other states or inputs"),
    ):
        with pytest.raises(km.KoopmpcError, match=text):
            km.identify.eigenfunctions(one, QUARTIC, **options)
    with pytest.raises(km.KoopmpcError, match="the library is constant on the data"):
        km.identify.eigenfunctions(one, km.Constant())
    short = km.Episodes([km.Episode(X=one[0].X[:4])] * 4, 0.01)
    with pytest.raises(km.KoopmpcError, match='episode 0 has 4 samples; by="derivatives" needs five'):
        km.identify.eigenfunctions(short, QUARTIC, by="derivatives")
    with pytest.raises(km.KoopmpcError, match="too short to hold its last quarter out"):
        km.identify.eigenfunctions(km.Episodes([km.Episode(X=one[0].X[:2])], 0.01), QUARTIC)
    (H,) = km.identify.eigenfunctions(one, QUARTIC)
    with pytest.raises(km.KoopmpcError, match="φ is a function of 2 states, got 3"):
        H.bind(("a", "b", "c"))


def test_an_error_as_large_as_the_tolerance_is_within_it(one):
    found = km.identify.eigenfunctions(one, QUARTIC, tolerance=10.0)
    again = km.identify.eigenfunctions(one, QUARTIC, tolerance=found[0].error)
    assert again[0].error == found[0].error
    assert len(again) + len(again.rejected) == len(found) + len(found.rejected)
