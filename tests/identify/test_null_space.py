"""The regressions behind km.identify.eigenfunctions against brute force on the samples themselves."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import eigh

import koopmpc as km
from koopmpc.identify.fits import eigenfunctions as null_space
from koopmpc.identify.fits.eigenfunctions import EigenfunctionRows, _find_sparsest, _rotate_to_real, hold_weights

DT = 0.1
LIBRARY = km.State() + km.Monomials(2)
ALL = LIBRARY + km.Constant()


def psi(X, constant=False):
    x, y = X.T
    return np.column_stack([x, y, x**2, x * y, y**2, *([np.ones(len(X))] if constant else [])])


def slopes(X, constant=False):
    """Return ∂ψ/∂x, (M, nz, 2)."""
    (x, y), one, zero = X.T, np.ones(len(X)), np.zeros(len(X))
    rows = [(one, zero), (zero, one), (2 * x, zero), (y, x), (zero, 2 * y), *([(zero, zero)] if constant else [])]
    return np.moveaxis(np.array(rows), 2, 0)


def noisy(seed, lengths, nu):
    """Episodes whose states are polynomials of degree four in time: central differences of fourth order are exact."""
    rng, parts, velocities = np.random.default_rng(seed), [], []
    for T in lengths:
        t, c = np.arange(T + 1) * DT, rng.normal(size=(5, 2))
        X = np.polynomial.polynomial.polyval(t, c).T
        velocities.append(np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyder(c)).T)
        parts.append(km.Episode(X=X, U=rng.normal(size=(T, nu))))
    return km.Episodes(parts, DT), velocities


def samples(data, velocities, by):
    """Return x, x⁺, ẋ and u of all samples."""
    if by == "steps":
        some = [(e.X[:-1], e.X[1:], np.diff(e.X, axis=0) / DT, e.U) for e in data]
    else:
        some = [(e.X[2:-2], e.X[3:-1], v[2:-2], e.U[2:-1]) for e, v in zip(data, velocities, strict=True)]
    return [np.concatenate(each) for each in zip(*some, strict=True)]


def rms(values):
    """Return the root of the mean over samples of the sum of squares."""
    return np.sqrt(np.sum(np.abs(values) ** 2) / len(values))


def shares(value):
    """Return the weights of β at both ends of a step by quadrature."""

    def integral(f):
        return quad(f, 0, DT, complex_func=True)[0] / DT

    def at(s):
        return np.exp(value * (DT - s))

    return integral(lambda s: at(s) * (1 - s / DT)), integral(lambda s: at(s) * s / DT)


def matrices(value, data, velocities, by, constant=False):
    """Return the rows of c and those of β on the samples: φ̇ − λ φ − β u."""
    X, X_next, V, U = samples(data, velocities, by)
    Z, later = psi(X, constant), psi(X_next, constant)
    if by == "derivatives":
        M = np.einsum("mji,mi->mj", slopes(X, constant), V) - value * Z
        return M, -np.hstack([u[:, None] * Z for u in U.T] or [np.zeros((len(X), 0))])
    before, after = shares(value)
    effect = [-u[:, None] * (before * Z + after * later) for u in U.T] or [np.zeros((len(X), 0))]
    return (later - np.exp(value * DT) * Z) / DT, np.hstack(effect)


@pytest.mark.parametrize("a", [0.0, 1e-5, 9.99e-4, 1.001e-3, 0.3, -0.7, 3e-4 + 5e-4j, 0.2 + 3j])
def test_the_weights_of_an_effect_are_those_of_quadrature(a):
    np.testing.assert_allclose(hold_weights(a / DT, DT), shares(a / DT), rtol=2e-9)


@pytest.mark.parametrize("by", ["steps", "derivatives"])
@pytest.mark.parametrize("nu", [0, 2])
@pytest.mark.parametrize("value", [0.0, -0.6, 0.4 + 2j])
def test_the_factors_hold_what_the_samples_hold(by, nu, value, monkeypatch):
    data, velocities = noisy(0, [9, 12, 7], nu)
    X, _, V, _ = samples(data, velocities, by)
    spread = np.concatenate([e.X for e in data]).std(axis=0)
    rng = np.random.default_rng(1)
    c, beta = rng.normal(size=(2, 6)), rng.normal(size=(2, 6 * nu))
    M, F = matrices(complex(value), data, velocities, by, constant=True)
    for together in (4096, 10):
        monkeypatch.setattr(null_space, "_ROWS", together)
        rows = EigenfunctionRows.read(data, ALL.bind(data.states), by)
        own_M, own_F = rows.parts(complex(value))
        assert np.iscomplexobj(own_M) == bool(np.imag(value))
        for one, b in zip(c, beta, strict=True):
            assert np.linalg.norm(own_M @ one + own_F @ b) == pytest.approx(rms(M @ one + F @ b), rel=1e-9)
            steepness = rms(np.einsum("j,mji->mi", one, slopes(X, constant=True)) * spread)
            assert np.linalg.norm(rows.G @ one) == pytest.approx(steepness, rel=1e-9)
        assert rows.speed == pytest.approx(rms(V / spread), rel=1e-9)
        np.testing.assert_allclose(rows.spread, spread)


def test_a_state_that_rests_counts_in_its_own_unit_and_a_plant_at_rest_has_the_speed_one():
    X = np.column_stack([np.linspace(-1, 1, 9), np.full(9, 3.0)])
    rows = EigenfunctionRows.read(km.Episodes([km.Episode(X=X)], DT), LIBRARY.bind(("x0", "x1")), "steps")
    np.testing.assert_allclose(rows.spread, [X[:, 0].std(), 1.0])
    still = [km.Episode(X=np.full((3, 2), value)) for value in (1.0, 2.0, 4.0)]
    assert EigenfunctionRows.read(km.Episodes(still, DT), LIBRARY.bind(("x0", "x1")), "steps").speed == 1.0


@pytest.mark.parametrize("by", ["steps", "derivatives"])
@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize(("value", "nu"), [(0.0, 0), (-0.5, 1), (0.3 + 1.5j, 2)])
def test_the_null_space_is_that_of_the_generalised_eigenvalue_problem(by, constant, value, nu):
    """min ‖M c + F β‖² / ‖G c‖² over c and β: a constant costs nothing, and is free like β."""
    data, velocities = noisy(3, [40, 30, 50], nu)
    X, _, _, _ = samples(data, velocities, by)
    M, F = (part / np.sqrt(len(X)) for part in matrices(complex(value), data, velocities, by, constant))
    if constant:
        M, F = M[:, :5], np.hstack([M[:, 5:], F])
    spread = np.concatenate([e.X for e in data]).std(axis=0)
    G = (slopes(X) * spread).transpose(0, 2, 1).reshape(-1, 5) / np.sqrt(len(X))
    M = M - F @ np.linalg.lstsq(F, M, rcond=None)[0]
    ratios, best = eigh(M.conj().T @ M, (G.T @ G).astype(M.dtype))
    least = np.sqrt(ratios)
    rows = EigenfunctionRows.read(data, (ALL if constant else LIBRARY).bind(data.states), by)
    every = np.arange(rows.lifting.nz)
    for below, count, expected in (
        (0.0, 9, 1), (0.5 * (least[1] + least[2]), 9, 2), (np.inf, 3, 3), (np.inf, 9, 5), (least[3] * 1.001, 9, 4)
    ):  # fmt: skip
        null = rows._null(complex(value), every, below, count)
        assert null.shape == (len(every), expected)
        found = [rows._solve_effect(complex(value), c) for c in null.T]
        np.testing.assert_allclose([each.residual for each in found], least[:expected], rtol=1e-6)
        for each, exact in zip(found, best.T, strict=False):
            assert np.linalg.norm(rows.G @ each.c) == pytest.approx(1.0)
            cosine = np.vdot(exact, G.T @ G @ each.c[:5]) / np.linalg.norm(G @ exact)
            assert abs(cosine) == pytest.approx(1.0, rel=1e-6)
            own_M, own_F = rows.parts(complex(value))
            told = np.linalg.norm(own_M @ each.c + own_F @ each.beta.ravel())
            assert told == pytest.approx(each.residual, rel=1e-6)
    few = np.array([0, 2, 4])
    null = rows._null(complex(value), few, 0.0, 1)[:, 0]
    assert not null[[1, 3]].any()
    own = eigh((M.conj().T @ M)[np.ix_(few, few)], (G.T @ G).astype(M.dtype)[np.ix_(few, few)])[0]
    if not constant:
        assert rows._solve_effect(complex(value), null).residual == pytest.approx(np.sqrt(own[0]), rel=1e-6)


@pytest.mark.parametrize("by", ["steps", "derivatives"])
@pytest.mark.parametrize("nu", [0, 1])
def test_the_explicit_pairs_are_those_of_the_least_squares_on_the_samples(by, nu):
    data, velocities = noisy(4, [40, 30, 50], nu)
    X, X_next, V, U = samples(data, velocities, by)
    Z = psi(X)
    target = psi(X_next) if by == "steps" else np.einsum("mji,mi->mj", slopes(X), V)
    K = np.linalg.lstsq(np.hstack([Z, *(u[:, None] * Z for u in U.T)]), target, rcond=None)[0][:5]
    values, vectors = np.linalg.eig(K)
    rates = np.log(values.astype(complex)) / DT if by == "steps" else values.astype(complex)
    spread = np.concatenate([e.X for e in data]).std(axis=0)
    expected = []
    for rate, xi in zip(rates, vectors.T, strict=True):
        if rate.imag >= 0:
            M, F = matrices(rate, data, velocities, by)
            missed = M @ xi
            missed = missed - F @ np.linalg.lstsq(F, missed, rcond=None)[0]
            steepness = rms(np.einsum("j,mji->mi", xi, slopes(X)) * spread)
            expected.append((rms(missed) / steepness, rate, xi))
    expected.sort(key=lambda each: each[0])
    rows = EigenfunctionRows.read(data, LIBRARY.bind(data.states), by)
    found = rows.explicit(9)
    assert len(found) == len(expected)
    assert rows.explicit(2)[1][0] == found[1][0]
    assert len(rows.explicit(2)) == 2
    for (rate, xi), (_, exact, vector) in zip(found, expected, strict=True):
        assert rate == pytest.approx(exact, rel=1e-6)
        assert np.iscomplexobj(xi) == bool(rate.imag)
        assert abs(np.vdot(xi, vector)) == pytest.approx(np.linalg.norm(xi) * np.linalg.norm(vector), rel=1e-6)
    constant = EigenfunctionRows.read(data, ALL.bind(data.states), by).explicit(9)
    assert all(np.abs(xi[:5]).max() > 1e-6 * np.abs(xi).max() for _, xi in constant)  # 1⁺ = 1 is no function


def turning(by, rate=-0.3 + 2j, nu=2):
    """Samples of φ = x + i y with φ̇ = λ φ + b u, u held over each sample, or of another one that is smooth in time."""
    rng, b = np.random.default_rng(0), np.array([1.0 + 0.5j, -0.4j])[:nu]
    parts = []
    for _ in range(6):
        if by == "steps":
            U = rng.normal(size=(30, nu))
            phi = [complex(*rng.normal(size=2))]
            for u in U:
                phi.append(np.exp(rate * DT) * phi[-1] + (np.exp(rate * DT) - 1) / rate * (b @ u))
        else:  # u = e^{st} gives b / (s − λ) e^{st}, and the real part of u the mean of that of s and of its conjugate
            t, s, c = 0.02 * np.arange(61), 1j * rng.uniform(1, 3, nu), complex(*rng.normal(size=2))
            waves = np.exp(t[:, None] * s)
            U, phi = waves.real[:-1], c * np.exp(rate * t)
            phi = phi + (waves @ (b / (s - rate)) + waves.conj() @ (b / (s.conj() - rate))) / 2
        parts.append(km.Episode(X=np.column_stack([np.real(phi), np.imag(phi)]), U=U))
    return km.Episodes(parts, DT if by == "steps" else 0.02), b


@pytest.mark.parametrize(("by", "exact"), [("steps", 1e-9), ("derivatives", 1e-5)])
def test_a_complex_eigenfunction_has_the_effect_of_its_inputs(by, exact):
    data, b = turning(by)
    found = km.identify.eigenfunctions(data, ALL, eigenvalue=None, by=by, tolerance=10.0)
    phi = min(found, key=lambda each: abs(each.eigenvalue - (-0.3 + 2j)))  # the others are its products
    assert phi.eigenvalue == pytest.approx(-0.3 + 2j, abs=exact)
    c = phi.coefficients[0] + 1j * phi.coefficients[1]
    factor = c[0]  # φ = factor · (x + i y)
    np.testing.assert_allclose(c, factor * np.array([1, 1j, 0, 0, 0, 0]), atol=exact)
    drive = phi.drive[0] + 1j * phi.drive[1]
    np.testing.assert_allclose(drive, factor * np.outer(b, [0, 0, 0, 0, 0, 1]), atol=100 * exact)
    assert abs(c[1]) == pytest.approx(1.0)  # of two that are as large the last one is 1
    assert c[1] == pytest.approx(1.0)
    assert phi.residual < exact
    assert phi.error < (100 * exact if by == "steps" else 0.1)  # inputs that are not held are told worse


@pytest.mark.parametrize("by", ["steps", "derivatives"])
@pytest.mark.parametrize("rate", [-0.3 + 2j, -0.8 + 0.5j])
def test_a_free_eigenvalue_is_refined_to_that_of_the_data(by, rate):
    data, _ = turning(by, rate)
    rows = EigenfunctionRows.read(data, ALL.bind(data.states), by)
    xi = np.array([1, 1j, 0, 0, 0, 0]) / np.linalg.norm(rows.G[:, :2] @ [1, 1j])
    support = np.array([0, 1, 5])
    start = rate * (1 + 0.02j) + 0.01
    kept, solved = rows._refine(start, support, xi, 1e-9, free=False)
    assert kept == start
    value, refined = rows._refine(start, support, xi, 1e-9, free=True)
    far = 1e-2 if by == "steps" else 0.8  # smooth inputs tell λ less, and five rounds do not end there
    assert abs(value - rate) < far * abs(start - rate)
    assert refined.residual < far * solved.residual


def test_a_real_eigenvalue_stays_real_and_its_effect_takes_the_fewest_terms():
    rng, parts = np.random.default_rng(0), []
    for _ in range(6):
        U, x = rng.normal(size=(30, 2)), [rng.normal()]
        for u in U:
            x.append(np.exp(-0.5 * DT) * x[-1] + (np.exp(-0.5 * DT) - 1) / -0.5 * (0.7 * u[0] - 2 * u[1]))
        parts.append(km.Episode(X=np.column_stack([x, rng.normal(size=31)]), U=U))
    data = km.Episodes(parts, DT)
    (phi,) = km.identify.eigenfunctions(data, ALL, eigenvalue=None, count=1)
    assert phi.rates == (pytest.approx(-0.5, abs=1e-9),)
    np.testing.assert_allclose(phi.coefficients, [[1, 0, 0, 0, 0, 0]], atol=1e-9)
    assert np.count_nonzero(phi.drive) == 2
    np.testing.assert_allclose(phi.drive[0][:, 5], [0.7, -2.0], atol=1e-8)


@pytest.mark.parametrize("eigenvalue", [-1.0, None])
def test_an_eigenfunction_is_zero_at_an_equilibrium_that_is_not(eigenvalue):
    """x₀ → 3 with the rate −1 has the eigenfunction x₀ − 3, which needs the Constant."""
    rng, t = np.random.default_rng(0), 0.1 * np.arange(40)
    some = [np.column_stack([3 + a * np.exp(-t), b * np.exp(-2.5 * t)]) for a, b in rng.normal(size=(8, 2))]
    found = km.identify.eigenfunctions(km.Episodes([km.Episode(X=X) for X in some], 0.1), ALL, eigenvalue=eigenvalue)
    phi = next(each for each in found if abs(each.eigenvalue + 1) < 1e-9)
    np.testing.assert_allclose(phi.coefficients, [[-1 / 3, 0, 0, 0, 0, 1]], atol=1e-8)
    assert phi.error < 1e-8


def test_a_growth_of_one_keeps_all_observables_and_all_terms_of_the_effect():
    (phi,) = km.identify.eigenfunctions(wandering(6), ALL, eigenvalue=-1.0, count=1, growth=1)
    assert np.all(phi.coefficients != 0)
    assert np.all(phi.drive != 0)
    (few,) = km.identify.eigenfunctions(wandering(6), ALL, eigenvalue=-1.0, count=1)
    assert np.count_nonzero(few.coefficients) < 6
    assert np.count_nonzero(few.drive) < 6


def test_a_vector_is_turned_until_its_largest_entry_is_real():
    c = np.array([1.0 + 1j, -3j, 0.5])
    turned = _rotate_to_real(c)
    assert turned[1] == pytest.approx(3.0)
    assert abs(np.vdot(turned, c)) == pytest.approx(np.linalg.norm(c) ** 2)


def test_sparse_vectors_are_found_in_the_span_of_their_mixtures():
    rng = np.random.default_rng(0)
    for kind in (float, complex):
        planted = np.zeros((30, 3), dtype=kind)
        for j, some in enumerate(np.split(rng.permutation(29)[:10], [2, 5])):
            planted[some, j] = rng.normal(size=len(some)) + (1j * rng.normal(size=len(some)) if kind is complex else 0)
        size = np.logspace(-2, 2, 30)[:, None]
        size[29] = 0.0  # an observable without a gradient
        mixed = planted @ rng.normal(size=(3, 3))
        found = _find_sparsest(mixed, size)
        assert len(found) == 3
        for own, v in zip(planted.T, found, strict=True):  # the sparsest first
            expected = own / np.where(size > 0, size, 1.0)[:, 0]
            assert abs(np.vdot(expected, v)) == pytest.approx(np.linalg.norm(expected) * np.linalg.norm(v), rel=1e-6)
        (one,) = _find_sparsest(mixed[:, :1], size)
        np.testing.assert_allclose(one * np.where(size > 0, size, 1.0)[:, 0], mixed[:, 0])


def wandering(count, steps=24, noise=1e-3):
    """Noisy measurements of ẋ = [−x, −2 y] + u in the first state."""
    rng, parts, F = np.random.default_rng(5), [], np.exp([-DT, -2 * DT])
    for _ in range(count):
        U, X = rng.normal(size=(steps, 1)), [rng.normal(size=2)]
        for (u,) in U:
            X.append(F * X[-1] + [(1 - F[0]) * u, 0.0])
        parts.append(km.Episode(X=np.array(X) + noise * rng.normal(size=(steps + 1, 2)), U=U))
    return km.Episodes(parts, DT)


def test_the_residual_and_the_error_are_those_of_the_docstring():
    data, held = wandering(6), wandering(3, noise=1e-2)
    for eigenvalue in (-1.0, -3.0):
        found = km.identify.eigenfunctions(data, ALL, eigenvalue=eigenvalue, held_out=held, tolerance=10.0)
        assert len(found)
        assert [phi.error for phi in found] == sorted(phi.error for phi in found)
        for phi in found:
            before, after = shares(eigenvalue)
            missed = steepness = 0.0
            for e in held:
                told, effect = psi(e.X, True) @ phi.coefficients[0], psi(e.X, True) @ phi.drive[0, 0]
                ahead = [told[0]]
                for k, (u,) in enumerate(e.U):
                    push = DT * u * (before * effect[k] + after * effect[k + 1])
                    ahead.append((np.exp(eigenvalue * DT) * ahead[-1] + push).real)
                missed += np.sum((np.array(ahead) - told) ** 2)
                spread = np.concatenate([each.X for each in data]).std(axis=0)
                steepness += np.sum((np.einsum("j,mji->mi", phi.coefficients[0], slopes(e.X, True)) * spread) ** 2)
            assert phi.error == pytest.approx(np.sqrt(missed / steepness), rel=1e-6)
            X, _, V, _ = samples(data, None, "steps")
            M, F = matrices(complex(eigenvalue), data, None, "steps", constant=True)
            size = rms(np.einsum("j,mji->mi", phi.coefficients[0], slopes(X, True)) * spread) * rms(V / spread)
            left = rms(M @ phi.coefficients[0] + F @ phi.drive[0, 0])
            assert phi.residual == pytest.approx(left / size, rel=1e-6)
            assert np.abs(phi.coefficients).max() == pytest.approx(1.0)


def test_by_default_every_fourth_episode_is_held_out_or_the_last_quarter_of_each():
    def told(found):
        return [(phi.error, phi.residual) for phi in (*found, *found.rejected)]

    data = wandering(9)
    whole = list(data)
    train = data.with_episodes([e for i, e in enumerate(whole) if i not in (3, 7)])
    own = km.identify.eigenfunctions(data, ALL, eigenvalue=-1.0)
    asked = km.identify.eigenfunctions(train, ALL, eigenvalue=-1.0, held_out=data.with_episodes([whole[3], whole[7]]))
    assert told(own) == told(asked)
    three = data.with_episodes(whole[:3])
    train = data.with_episodes([km.Episode(X=e.X[:19], U=e.U[:18]) for e in three])
    test = data.with_episodes([km.Episode(X=e.X[18:], U=e.U[18:]) for e in three])
    asked = km.identify.eigenfunctions(train, ALL, eigenvalue=-1.0, held_out=test)
    assert told(km.identify.eigenfunctions(three, ALL, eigenvalue=-1.0)) == told(asked)


@pytest.mark.parametrize("by", ["steps", "derivatives"])
def test_the_pairs_of_the_explicit_regression_come_in_the_order_of_their_residuals(by):
    data = wandering(9)
    rows = EigenfunctionRows.read(data, (km.State() + km.Monomials(3)).bind(data.states), by)
    left = []
    for value, xi in rows.explicit(20):
        M, F = rows.parts(value)
        beta = np.linalg.lstsq(F, M @ xi, rcond=None)[0]
        left.append(np.linalg.norm(M @ xi - F @ beta) / np.linalg.norm(rows.G @ xi))
    assert len(left) > 3
    np.testing.assert_allclose(left, np.sort(left), rtol=1e-6)
