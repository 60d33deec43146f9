"""refine: exact derivatives, never worse than its start on held-out rows, and the true model where data are exact."""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from koopmpc.models.fits.refinement import MultiStepError, coefficients_of_states, cut_into_segments, rows_of_states


def bilinear_plant(rng, nx=2, nu=1):
    """Return a stable bilinear model on State() + Constant()."""
    A = np.eye(nx + 1)
    A[:nx, :nx] = 0.8 * np.linalg.qr(rng.standard_normal((nx, nx)))[0]
    A[:nx, nx] = 0.1 * rng.standard_normal(nx)
    B = np.vstack([rng.standard_normal((nx, nu)), np.zeros((1, nu))])
    N = np.zeros((nu, nx + 1, nx + 1))
    N[:, :nx, :nx] = 0.15 * rng.standard_normal((nu, nx, nx))
    names = [f"x{i}" for i in range(nx)], [f"u{i}" for i in range(nu)]
    return km.BilinearPredictor(A, B, N, np.eye(nx, nx + 1), km.State() + km.Constant(), 0.1, *names)


def episodes_of(model, rng, count=6, steps=60, noise=0.0):
    plant = model.step_map()
    parts = []
    for _ in range(count):
        U = rng.uniform(-1, 1, (steps, model.nu))
        X = plant.rollout(rng.uniform(-1, 1, model.nx), U)
        parts.append(km.Episode(X=X + noise * rng.standard_normal(X.shape), U=U))
    return km.Episodes(parts, model.dt, model.states, model.inputs)


def disturbed(model, rng, share=0.1):
    def off(matrix):
        return matrix * rng.uniform(1 - share, 1 + share, matrix.shape)

    nx = model.nx
    A, B, N = model.A.copy(), model.B.copy(), model.N.copy()
    A[:nx], B[:nx], N[:, :nx] = off(A[:nx]), off(B[:nx]), off(N[:, :nx])
    return km.BilinearPredictor(A, B, N, model.C, km.State() + km.Constant(), model.dt, model.states, model.inputs)


@pytest.mark.parametrize("delays", [0, 2])
@pytest.mark.parametrize("kind", ["linear", "bilinear"])
def test_the_derivatives_are_those_of_casadi_and_of_finite_differences(kind, delays):
    rng = np.random.default_rng(3)
    data = episodes_of(bilinear_plant(rng), rng, noise=0.05)
    embedding, lifting = km.Delay(delays) if delays else None, km.State() + km.Monomials(2) + km.Constant()
    if delays:
        lifting = km.State() + km.Constant() + km.State([0]) * km.State([2])
    fit = km.edmd if kind == "linear" else km.bilinear_edmd
    model = fit(data, lifting, embedding=embedding, ridge=1e-3)
    error = MultiStepError(model, np.array([0.7, 1.3]))
    segments = cut_into_segments(model, data[:2], 4, "here")
    theta = coefficients_of_states(model, rows_of_states(model))
    gradient, matrix = error.derivatives(theta, segments)
    for j in rng.choice(theta.size, 12, replace=False):
        moved = theta.ravel().copy()
        step = 1e-6
        moved[j] += step
        up = error.evaluate(moved.reshape(theta.shape), segments)
        moved[j] -= 2 * step
        down = error.evaluate(moved.reshape(theta.shape), segments)
        assert gradient[j] == pytest.approx((up - down) / (4 * step), rel=1e-5, abs=1e-8)
    # CasADi differentiates the whole rollout, and J of all residuals gives the Gauss-Newton matrix
    symbol = ca.SX.sym("theta", *theta.shape)
    residuals = []
    for i, start in enumerate(segments.points):
        zeta = ca.SX(start)
        for u, truth in zip(segments.inputs[:, i], segments.states[:, i], strict=True):
            z = model.lifting.symbolic(zeta)
            phi = ca.vertcat(z, u, *([ca.kron(ca.SX(u), z)] if kind == "bilinear" else []))
            x = symbol @ phi
            residuals.append((x - truth) / np.array([0.7, 1.3]))
            zeta = x if embedding is None else model.embedding.symbolic(zeta, ca.SX(u), x)
    r = ca.vertcat(*residuals)
    order = ca.vec(symbol.T)
    J = np.asarray(ca.Function("J", [symbol], [ca.jacobian(r, order)])(theta))
    value = np.asarray(ca.Function("r", [symbol], [r])(theta)).ravel()
    assert error.evaluate(theta, segments) == pytest.approx(np.mean(value**2), rel=1e-9)
    assert np.allclose(gradient, J.T @ value / len(value), rtol=1e-8, atol=1e-12)
    assert np.allclose(matrix, J.T @ J / len(value), rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_exact_data_give_the_true_model_back_from_coefficients_ten_percent_off(seed):
    rng = np.random.default_rng(seed)
    true = bilinear_plant(rng)
    found = km.identify.refine(disturbed(true, rng), episodes_of(true, rng), horizon=8, iterations=60)
    U = rng.uniform(-1, 1, (50, 1))
    x0 = rng.uniform(-1, 1, 2)
    assert np.abs(found.step_map().rollout(x0, U) - true.step_map().rollout(x0, U)).max() < 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_refining_is_never_worse_than_its_start_on_the_held_out_rows(seed):
    rng = np.random.default_rng(seed)
    data, unseen = (episodes_of(bilinear_plant(np.random.default_rng(9)), rng, noise=0.3) for _ in range(2))
    start = km.bilinear_edmd(data, km.State() + km.Constant())
    found = km.identify.refine(start, data, horizon=10, held_out=unseen)
    segments = cut_into_segments(start, unseen, 10, "here")
    error = MultiStepError(start, np.concatenate([e.X for e in data]).std(axis=0))
    rows = rows_of_states(start)
    before, after = (error.evaluate(coefficients_of_states(model, rows), segments) for model in (start, found))
    assert after <= before
    assert found is start or (after < before and "refined" in found.report.changes[-1])


def test_a_noisy_fast_record_of_a_linear_plant_gains_fourfold():
    """One-step least squares on noisy y underestimates its poles; the error over many steps does not."""
    rng = np.random.default_rng(0)
    a, b = np.array([1.94, -0.945]), np.array([0.004, 0.004])
    u = np.repeat(rng.uniform(-1, 1, 200), 10)
    y = np.zeros(2000)
    for k in range(2, 2000):
        y[k] = a @ y[k - 2 : k][::-1] + b @ u[k - 2 : k][::-1]
    noisy = y + 0.05 * y.std() * rng.standard_normal(2000)
    data = km.Episodes([km.Episode(X=noisy[:, None], U=u[:-1, None])], 0.01, ["y"], ["u"])
    start = km.edmd(data, km.State(), embedding=km.Delay(1))
    found = km.identify.refine(start, data, horizon=100)
    fresh = np.repeat(rng.uniform(-1, 1, 30), 10)
    truth = np.zeros(300)
    for k in range(2, 300):
        truth[k] = a @ truth[k - 2 : k][::-1] + b @ fresh[k - 2 : k][::-1]
    history = km.Episode(X=truth[:2, None], U=fresh[:1, None])
    errors = [
        np.sqrt(np.mean((model.rollout(truth[1:2], fresh[1:-1, None], history=history)[:, 0] - truth[1:]) ** 2))
        for model in (start, found)
    ]
    assert errors[1] < 0.25 * errors[0]


def test_units_do_not_count():
    rng = np.random.default_rng(5)
    data = episodes_of(bilinear_plant(rng), rng, noise=0.1)
    factor = np.array([1e3, 1e-2])
    scaled = km.Episodes([km.Episode(X=e.X * factor, U=e.U) for e in data], data.dt, data.states, data.inputs)
    one, other = (
        km.identify.refine(km.bilinear_edmd(d, km.State() + km.Constant()), d, horizon=6, iterations=3)
        for d in (data, scaled)
    )
    x0, U = np.array([0.3, -0.2]), rng.uniform(-1, 1, (20, 1))
    X, Y = one.step_map().rollout(x0, U) * factor, other.step_map().rollout(x0 * factor, U)
    assert np.allclose(X, Y, rtol=1e-5, atol=1e-6 * factor)


def test_what_cannot_be_refined_is_refused_in_a_sentence():
    rng = np.random.default_rng(0)
    data = episodes_of(bilinear_plant(rng), rng)
    model = km.edmd(data, km.State() + km.Constant())
    with pytest.raises(km.errors.DataError, match="has the 50 steps of a segment"):
        km.identify.refine(model, data, horizon=50)
    with pytest.raises(km.errors.DataError, match="C does not pick the states"):
        km.identify.refine(km.edmd(data, km.Monomials(2) + km.Constant()), data, horizon=5)
    watched = km.Episodes(
        [km.Episode(X=e.X, U=e.U, W=np.zeros((len(e), 1)) + rng.standard_normal((len(e), 1))) for e in data],
        data.dt, data.states, data.inputs, ["w"],
    )  # fmt: skip
    with pytest.raises(km.errors.KoopmpcError, match=r"the episodes have disturbances \(\), the predictor has \(w\)"):
        km.identify.refine(km.edmd(watched, km.State()), data, horizon=5)
    driven, (X, U) = km.edmd(data, km.State()), (data[0].X, data[0].U)
    for other, said in (
        (km.Episodes([km.Episode(X=X, U=U)], 2 * data.dt, data.states, data.inputs), "have dt"),
        (km.Episodes([km.Episode(X=X, U=U)], data.dt, data.states, ["other"]), "have inputs"),
    ):
        for learned, held_out in ((other, None), (data, other)):
            with pytest.raises(km.errors.KoopmpcError, match=said):
                km.identify.refine(driven, learned, horizon=5, held_out=held_out)
    with pytest.raises(km.errors.KoopmpcError, match="horizon"):
        km.identify.refine(model, data, horizon=0)


def test_coefficients_that_are_zero_stay_zero():
    rng = np.random.default_rng(5)
    truth = bilinear_plant(rng)
    data = episodes_of(truth, rng, noise=0.02)
    start = disturbed(truth, rng)
    A, N = start.A.copy(), start.N.copy()
    A[0, 1] = N[0, 1, 0] = 0.0
    about = start.C, start.lifting, start.dt, start.states, start.inputs
    refined = km.identify.refine(km.BilinearPredictor(A, start.B, N, *about), data, horizon=8, iterations=5)
    assert refined.A[0, 1] == refined.N[0, 1, 0] == 0.0
    assert (refined.A[0, [0, 2]] != A[0, [0, 2]]).all()


def weathered(rng, *, scheduled, delays=0):
    """Episodes of a plant that w pushes, and where `scheduled` multiplies in state and input; its model, and it 10 % off."""
    A, B, E = np.diag([0.9, 0.8, 0.0]), np.array([[0.3], [0.2], [0.0]]), np.array([[0.2], [-0.1], [0.0]])
    A[0, 1], A[1, 2], A[2, 2] = 0.1, 0.05, 1.0
    N, S, M = np.zeros((1, 3, 3)), np.zeros((1, 3, 3)), np.zeros((1, 3, 1))
    N[0, 0, 1], S[0, 1, 0], M[0, 0, 0] = 0.1, 0.15 * scheduled, 0.2 * scheduled
    about = np.eye(2, 3), km.State() + km.Constant(), 0.1, ["a", "b"], ["u"]
    true = km.BilinearPredictor(A, B, N, *about, E=E, S=S, M=M)
    off = [each * rng.uniform(0.9, 1.1, each.shape) for each in (A, B, N, E, S, M)]
    off[0][2], off[1][2], off[3][2] = A[2], 0.0, 0.0
    start = km.BilinearPredictor(*off[:3], *about, E=off[3], S=off[4], M=off[5])
    parts = []
    for _ in range(5):
        U, W = rng.uniform(-1, 1, (40, 1)), rng.uniform(-1, 1, (40, 1))
        X = true.step_map().rollout(rng.uniform(-1, 1, 2), U, W)
        parts.append(km.Episode(X=X, U=U, W=W))
    return km.Episodes(parts, 0.1, ["a", "b"], ["u"]), true, start


@pytest.mark.parametrize("scheduled", [False, True])
def test_models_with_measured_disturbances_are_found_again(scheduled):
    rng = np.random.default_rng(3)
    data, true, start = weathered(rng, scheduled=scheduled)
    found = km.identify.refine(start, data, horizon=6, iterations=60)
    for name in ("A", "B", "N", "E", "S", "M"):
        np.testing.assert_allclose(getattr(found, name), getattr(true, name), atol=1e-6)
    assert found.disturbances == start.disturbances


def test_linear_models_with_delays_and_measured_disturbances_are_refined():
    rng = np.random.default_rng(4)
    data = weathered(rng, scheduled=False)[0]
    noisy = data.with_episodes([km.Episode(X=e.X + 0.1 * rng.standard_normal(e.X.shape), U=e.U, W=e.W) for e in data])
    start = km.edmd(noisy, km.State() + km.Constant(), embedding=km.Delay(1))
    found = km.identify.refine(start, noisy, horizon=8)
    errors = [km.score(model, data, 8).rmse[-1].mean() for model in (start, found)]
    assert found.nw == 1
    assert errors[1] < errors[0]
