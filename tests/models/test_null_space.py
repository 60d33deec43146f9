"""The regressions behind km.identify.eigenfunctions against brute force on the samples themselves."""

import numpy as np
import pytest
from scipy.integrate import quad

import koopmpc as km

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
