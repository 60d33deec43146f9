"""Units change nothing: a model transformed exactly, with its weights and limits, is given the same inputs."""

import numpy as np
import pytest

import koopmpc as km
from tests.tiers import slow

LIFTING = km.State() + km.Constant() + km.Monomials(2)
N, STEPS = 8, 5


def model_of(rng, nx, nu):
    """Return A, B and the bilinear N of a random model z⁺ = A z + B u + Σ uᵢ Nᵢ z that keeps its Constant."""
    nz = LIFTING.bind([f"x{i}" for i in range(nx)]).nz
    A = np.diag(rng.uniform(0.3, 1.0, nz)) + 0.1 * rng.standard_normal((nz, nz)) / np.sqrt(nz)
    B, products = rng.standard_normal((nz, nu)), 0.05 * rng.standard_normal((nu, nz, nz))
    A[nx], B[nx], products[:, nx] = np.eye(nz)[nx], 0.0, 0.0
    return A, B, products


def case_of(seed):
    """Return what a controller is told, in units of order 1."""
    rng = np.random.default_rng(seed)
    nx, nu = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    limited = rng.random() < 0.7
    soft = [None, "auto", (rng.uniform(10, 100, nx), rng.uniform(1, 10, nx))][int(rng.integers(3))]
    return {
        "model": model_of(rng, nx, nu),
        "Q": rng.uniform(0.5, 2, nx),
        "R": rng.uniform(0.05, 0.5, nu),
        "R_delta": rng.uniform(0.1, 1, nu) if rng.random() < 0.5 else None,
        "u": rng.uniform(0.3, 1, nu),
        "du": rng.uniform(0.2, 0.5, nu) if rng.random() < 0.3 else None,
        "x": rng.uniform(0.4, 1, nx) if limited else None,
        "soft": soft if limited else "auto",
        "target": [*("equilibrium", "zero"), rng.uniform(-0.3, 0.3, nu)][int(rng.integers(3))],
        "reference": rng.uniform(-0.6, 0.6, nx),
        "start": rng.uniform(-0.8, 0.8, nx),
    }


def told(case, sx, su, unit):
    """Return predictors, cost, limits, start and reference in the units x' = sx x, u' = su u, cost' = unit cost."""
    A, B, products = case["model"]
    nx, nu = len(sx), len(su)
    states, inputs = [f"x{i}" for i in range(nx)], [f"u{i}" for i in range(nu)]
    D = LIFTING.bind(states)(sx[None])[0]  # monomials of s x are monomials of s times those of x
    A, B = D[:, None] * A / D, D[:, None] * B / su
    C = np.eye(nx, len(D))
    common = (C, LIFTING, 0.1, states, inputs)
    R_delta, x, du = case["R_delta"], case["x"], case["du"]
    slack, target = case["soft"], case["target"]
    if isinstance(slack, tuple):
        slack = (unit * slack[0] / sx, unit * slack[1] / sx**2)
    return {
        "linear": km.LinearPredictor(A, B, *common),
        "bilinear": km.BilinearPredictor(A, B, D[:, None] * products / D / su[:, None, None], *common),
        "cost": km.Cost(
            Q=unit * case["Q"] / sx**2,
            R=unit * case["R"] / su**2,
            R_delta=None if R_delta is None else unit * R_delta / su**2,
            u_target=target if isinstance(target, str) else target * su,
        ),
        "limits": km.Limits(
            u_min=-case["u"] * su,
            u_max=case["u"] * su,
            du_max=None if du is None else du * su,
            x_min=None if x is None else -x * sx,
            x_max=None if x is None else x * sx,
            slack=slack,
        ),
    }


CONTROLLERS = {
    "lqr": lambda p: km.LQR(p["linear"], p["cost"], p["limits"]),
    "koopman": lambda p: km.KoopmanMPC(p["linear"], p["cost"], p["limits"], N, solver="daqp"),
    "koopman with an estimator": lambda p: km.KoopmanMPC(
        p["linear"], p["cost"], p["limits"], N, solver="daqp", estimator=km.LiftedDisturbance()
    ),
    "linear": lambda p: km.LinearMPC(
        p["linear"].step_map(),
        np.zeros(p["linear"].nx),
        np.zeros(p["linear"].nu),
        p["cost"],
        p["limits"],
        N,
        solver="daqp",
    ),
    "bilinear": lambda p: km.BilinearMPC(p["bilinear"], p["cost"], p["limits"], N),
    "bilinear with an estimator": lambda p: km.BilinearMPC(
        p["bilinear"], p["cost"], p["limits"], N, estimator=km.LiftedDisturbance()
    ),
    "nonlinear": lambda p: km.NonlinearMPC(p["bilinear"].step_map(), p["cost"], p["limits"], N),
}


REACH = {}


def gap_of(name, seed, size=1e6):
    """Return the largest difference of the inputs, as shares of their range, over a few steps, and the statuses."""
    case, rng = case_of(seed), np.random.default_rng(seed + 10**6)
    nx, nu = len(case["reference"]), len(case["R"])
    reach = np.log10(size)
    sx, su, unit = 10.0 ** rng.uniform(-reach, reach, nx), 10.0 ** rng.uniform(-reach, reach, nu), 1e6
    ones = np.ones(nx), np.ones(nu), 1.0
    plain, scaled = told(case, *ones), told(case, sx, su, unit)
    one, other = CONTROLLERS[name](plain), CONTROLLERS[name](scaled)
    step, x, gap, statuses = plain["bilinear"].step_map(), case["start"], 0.0, []
    for _ in range(STEPS):
        first, second = one(x, case["reference"]), other(sx * x, sx * case["reference"])
        gap = max(gap, float(np.abs(second.u / su - first.u).max() / case["u"].min() / 2))
        statuses.append((first.status, second.status))
        x = step(x, first.u)
    return gap, statuses


def fitted_gap(kind, make, sx, su):
    """Return the gap of the inputs that models of the same data in other units lead to, as a share of their range."""
    rng = np.random.default_rng(3)
    A, B = np.array([[0.98, 0.1], [-0.15, 0.97]]), np.array([[0.0], [0.1]])
    U = rng.uniform(-1, 1, (20, 30, 1))
    X = np.zeros((20, 31, 2))
    X[:, 0] = rng.uniform(-1, 1, (20, 2))
    for k in range(30):
        X[:, k + 1] = X[:, k] @ A.T + U[:, k] @ B.T - 0.02 * X[:, k] ** 3 + 0.003 * rng.standard_normal((20, 2))
    inputs = []
    for s, t, unit in ((np.ones(2), 1.0, 1.0), (sx, su, 1e6)):
        data = km.Episodes([km.Episode(X=s * x, U=t * u) for x, u in zip(X, U, strict=True)], 0.1, ["p", "v"], ["u"])
        model = kind(data, km.State() + km.Constant() + km.Monomials(3), ridge=1e-9)
        cost = km.Cost(Q=unit * np.array([1, 0.1]) / s**2, R=unit * 0.1 / t**2)
        limits = km.Limits(-0.3 * t, 0.3 * t, x_max=[np.inf, 0.2 * s[1]])  # as large as the data's range
        mpc = make(model, cost, limits)
        inputs.append([mpc(s * x, s * np.array([0.2, 0.0])).u / t for x in ([0.9, 0.4], [0.5, 0.1], [0.2, -0.3])])
    return np.abs(np.subtract(*inputs)).max() / 0.6


FITTED = {
    "lqr": (km.edmd, lambda model, cost, limits: km.LQR(model, cost, limits)),
    "koopman": (km.edmd, lambda model, cost, limits: km.KoopmanMPC(model, cost, limits, 12, solver="daqp")),
    "offset-free": (
        km.edmd,
        lambda model, cost, limits: km.KoopmanMPC(
            model, cost, limits, 12, solver="daqp", estimator=km.LiftedDisturbance()
        ),
    ),
    "kalman": (
        km.edmd,
        lambda model, cost, limits: km.KoopmanMPC(
            model, cost, limits, 12, solver="daqp", estimator=km.LiftedKalman(("p", "v"))
        ),
    ),
    "bilinear": (km.bilinear_edmd, lambda model, cost, limits: km.BilinearMPC(model, cost, limits, 12)),
}


@pytest.mark.parametrize("name", FITTED)
@pytest.mark.parametrize("units", [(1e4, 1e-3, 1e-2), (1e-6, 1e6, 1e3)])
def test_a_model_fitted_in_other_units_gives_the_same_inputs(name, units):
    assert fitted_gap(*FITTED[name], np.array(units[:2]), units[2]) < 1e-6


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize(
    "seed", [*slow([0, 1, 2, 3]), 4, 5, *slow([6, 7]), 99, 259]
)  # 99 has R_delta and soft limits, 259 a choice of inputs at a limit
def test_units_of_states_inputs_and_cost_change_no_input_and_no_status(name, seed):
    """Factors of 1e-6 to 1e6 on states and inputs, the cost a million times as large."""
    gap, statuses = gap_of(name, seed)
    assert gap < REACH.get(name, 1e-6)
    assert all(one is other for one, other in statuses)


def mixed(case, S, su, unit):
    """Return predictors and cost in the coordinates x' = S x, u' = su u, and the observables' matrix D, ψ(S x) = D ψ(x)."""
    A, B, products = case["model"]
    nx, nu = len(S), len(su)
    states, inputs = [f"x{i}" for i in range(nx)], [f"u{i}" for i in range(nu)]
    size = np.abs(S).sum(axis=1)
    lift, points = LIFTING.bind(states), np.random.default_rng(0).uniform(-1, 1, (60, nx))
    D = np.linalg.lstsq(lift(points), lift(points @ (S / size[:, None]).T), rcond=None)[0].T
    D[np.abs(D) < 1e-13] = 0.0
    D = lift(size[None])[0][:, None] * D
    back, inverse = np.linalg.inv(D), np.linalg.inv(S)
    common = (np.eye(nx, len(D)), LIFTING, 0.1, states, inputs)
    B, R_delta, target = D @ B / su, case["R_delta"], case["target"]
    return {
        "linear": km.LinearPredictor(D @ A @ back, B, *common),
        "bilinear": km.BilinearPredictor(D @ A @ back, B, D @ products @ back / su[:, None, None], *common),
        "cost": km.Cost(
            Q=unit * inverse.T @ np.diag(case["Q"]) @ inverse,
            R=unit * case["R"] / su**2,
            R_delta=None if R_delta is None else unit * R_delta / su**2,
            u_target=target if isinstance(target, str) else target * su,
        ),
        "limits": km.Limits(-case["u"] * su, case["u"] * su),
        "D": np.delete(np.delete(D, nx, axis=0), nx, axis=1),
        "S": S,
    }


def filtered(p):
    """Return a KoopmanMPC whose filter has the covariances of z and y in its own coordinates."""
    nx, D = len(p["S"]), p["D"]
    rule = km.LiftedKalman(
        np.eye(nx, len(D) + 1), "output", process=D @ D.T, drift=p["S"] @ p["S"].T, noise=p["S"] @ p["S"].T
    )
    return km.KoopmanMPC(p["linear"], p["cost"], p["limits"], N, solver="daqp", estimator=rule)


MIXED = {name: CONTROLLERS[name] for name in ("lqr", "koopman", "linear", "bilinear", "nonlinear")} | {
    "koopman with a filter": filtered
}


@pytest.mark.parametrize("name", MIXED)
@pytest.mark.parametrize("seed", [*slow([0, 1]), 2, *slow([3]), 4, *slow([5])])
def test_other_coordinates_of_the_state_change_no_input(name, seed):
    """x' = S x with a full S, whose rows are 1e-4 to 1e4 times as large, and weights and covariances to match."""
    case, rng = case_of(seed), np.random.default_rng(seed + 10**6)
    nx, nu = len(case["reference"]), len(case["R"])
    S = np.linalg.qr(rng.standard_normal((nx, nx)))[0] @ np.diag(rng.uniform(0.5, 2, nx))
    S, su = 10.0 ** rng.uniform(-4, 4, nx)[:, None] * S, 10.0 ** rng.uniform(-6, 6, nu)
    plain, other = mixed(case, np.eye(nx), np.ones(nu), 1.0), mixed(case, S, su, 1e6)
    first, second = MIXED[name](plain), MIXED[name](other)
    step, x, gap = plain["bilinear"].step_map(), case["start"], 0.0
    for _ in range(STEPS):
        u, v = first(x, case["reference"]).u, second(S @ x, S @ case["reference"]).u / su
        gap = max(gap, float(np.abs(u - v).max() / case["u"].min() / 2))
        x = step(x, u)
    assert gap < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_units_change_nothing_for_many_models(name):
    gaps = [gap_of(name, seed)[0] for seed in range(8, 300)]
    assert max(gaps) < REACH.get(name, 1e-6)
