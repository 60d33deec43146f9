"""Step maps x⁺ = F(x, u, w): calls, batches, derivatives, logs, loops and controllers with measured disturbances."""

import pickle

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.gathered import of_loop

COST, LIMITS = km.Cost(Q=[1.0, 0.0], R=0.01), km.Limits(u_min=-2, u_max=2)


class Cooled(km.Dynamics):
    """A body whose cooling grows with the wind, and which a heater warms."""

    states, inputs, disturbances = ("core [K]", "shell [K]"), ("heat [kW]",), ("outside [K]", "wind [m/s]")

    def rhs(self, x, u):
        heat, outside, wind = u[0], u[1], u[2]
        return ca.vertcat(0.8 * (x[1] - x[0]), x[0] - x[1] + heat + (0.3 + 0.2 * wind) * (outside - x[1]))


@pytest.fixture(scope="module")
def plant():
    return km.discretize(Cooled(), dt=0.1)


def test_a_step_follows_w_and_is_that_of_the_equations(plant):
    assert (plant.nu, plant.nw, plant.disturbances) == (1, 2, Cooled.disturbances)
    x, u, w = np.array([1.0, -2.0]), np.array([0.5]), np.array([3.0, 1.5])
    dx = np.array([0.8 * (x[1] - x[0]), x[0] - x[1] + u[0] + (0.3 + 0.2 * w[1]) * (w[0] - x[1])])
    euler = km.discretize(Cooled(), 0.1, km.plants.Euler())
    np.testing.assert_allclose(euler(x, u, w), x + 0.1 * dx, rtol=1e-14)
    assert (plant(x, u) == plant(x, u, [0.0, 0.0])).all()
    assert (plant.at(w)(x, u) == plant(x, u, w)).all()
    assert plant.at(w).nw == 0
    implicit = km.discretize(Cooled(), 0.1, km.plants.Collocation(3))
    np.testing.assert_allclose(implicit(x, u, w), plant(x, u, w), atol=1e-4)
    np.testing.assert_allclose(implicit.at(w)(x, u), implicit(x, u, w), atol=1e-12)
    twin = pickle.loads(pickle.dumps(plant))
    assert (twin(x, u, w) == plant(x, u, w)).all()


def test_a_w_without_entries_is_no_w():
    x, u, w = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w", 0)
    plant = km.StepMap(ca.Function("F", [x, u, w], [0.9 * x + u]), 0.1)
    assert plant.nw == 0
    assert plant([1.0], [0.5]) == plant.at([])([1.0], [0.5]) == plant.rollout([1.0], [[0.5]])[1] == 1.4
    km.NonlinearMPC(plant, km.Cost(Q=1.0, R=0.1), None, 3)([1.0], [0.0])


def test_c_code_of_a_plant_with_w_is_refused_in_a_sentence(plant, tmp_path):
    calm = plant.at([0.0, 1.0])
    mpc = km.LinearMPC(calm, [0, 0], [0], COST, LIMITS, 5)
    km.export(mpc, tmp_path / "calm", plant=calm)
    with pytest.raises(
        km.errors.DataError, match=r"measured disturbances, and its C would take u alone; pass plant\.at\(w\)"
    ):
        km.export(mpc, tmp_path / "windy", plant=plant)


def test_batches_are_single_calls_to_the_bit(plant):
    rng = np.random.default_rng(0)
    X0, U, W = rng.normal(size=(80, 2)), rng.normal(size=(80, 12, 1)), rng.normal(size=(80, 12, 2))
    X = plant.rollouts(X0, U, W)
    assert (X[7] == plant.rollout(X0[7], U[7], W[7])).all()
    x = X0[7]
    for u, w, x_next in zip(U[7], W[7], X[7, 1:], strict=True):
        x = plant(x, u, w)
        np.testing.assert_allclose(x, x_next, rtol=1e-13, atol=1e-13)
    assert not np.allclose(plant.rollouts(X0, U), X)


def test_linearisations_hold_what_w_does(plant):
    x, u, w = np.array([0.3, 0.1]), np.array([0.4]), np.array([1.0, 2.0])
    at, step = plant.linearize(x, u, w), 1e-6
    for j in range(2):
        push = step * np.eye(2)[j]
        np.testing.assert_allclose(at.E[:, j], (plant(x, u, w + push) - plant(x, u, w - push)) / (2 * step), atol=1e-8)
    np.testing.assert_allclose(at.A @ x + at.B @ u + at.E @ w + at.c, plant(x, u, w), atol=1e-12)
    local = km.LinearPredictor.local(plant, x, u, w)
    assert local.disturbances == plant.disturbances
    np.testing.assert_allclose(local.rollout(x, [u], [w])[1], plant(x, u, w), atol=1e-12)


@pytest.fixture(scope="module")
def logs(plant):
    windy = km.Noise([-3.0, 0.0], [3.0, 2.0], hold=5)
    return km.collect(plant, km.Uniform([-2, -2], [2, 2]), km.Noise(-2, 2), episodes=20, steps=40, measured=windy)


def test_collect_keeps_w_and_its_models_forecast_with_it(plant, logs):
    assert logs.disturbances == plant.disturbances
    assert logs[0].W.shape == (40, 2)
    episode = logs[3]
    assert (plant.rollout(episode.X[0], episode.U, episode.W) == episode.X).all()
    rows = np.tile([1.0, 0.5], (40, 1))
    held = km.collect(plant, [0, 0], km.Noise(-2, 2), episodes=2, steps=40, measured=[1.0, 0.5])
    again = km.collect(plant, [0, 0], km.Noise(-2, 2), episodes=2, steps=40, measured=rows)
    assert held == again
    model = km.bilinear_edmd(logs, km.State() + km.Constant())
    relifted = model.step_map()
    assert relifted.disturbances == plant.disturbances
    lifted_once = model.rollout(episode.X[0], episode.U, episode.W)  # the same, for ψ is affine
    np.testing.assert_allclose(relifted.rollout(episode.X[0], episode.U, episode.W), lifted_once, atol=1e-9)


@pytest.mark.parametrize("kind", [km.NonlinearMPC, km.BilinearMPC])
def test_controllers_on_the_equations_use_the_preview_of_w(plant, kind):
    W = np.stack([2 * np.sign(np.sin(np.arange(50) / 5)), 1 + np.cos(np.arange(50) / 7)], axis=1)

    def spend(model, **options):
        mpc = kind(model, COST, LIMITS, 12)
        task = {"x0": [0.2, 0.2], "reference": [0.2, 0.0], "steps": 50, "cost": COST, "limits": LIMITS}
        run = km.simulate(plant, mpc, measured=W, **task, **of_loop(**options))
        assert {each.name for each in run.fallback} == {"NONE"}
        return km.metrics(run).cost

    told, now_only, never = spend(plant), spend(plant, preview=False), spend(plant.at([0.0, 1.0]))
    assert told < 0.9 * now_only
    assert now_only < 0.9 * never


def test_the_plan_under_w_is_the_optimum_of_the_equations(plant):
    """The optimum of the same horizon by SciPy, which knows F alone."""
    from scipy.optimize import minimize

    horizon, x0, W = 6, np.array([0.5, -0.5]), np.random.default_rng(1).uniform([-3, 0], [3, 2], (6, 2))
    cost = km.Cost(Q=[1.0, 0.0], R=0.05, tail=0, u_target="zero")

    def spend(U):
        X = plant.rollout(x0, U[:, None], W)
        return float(((X[1:, 0] - 0.3) ** 2).sum() + 0.05 * (U**2).sum())

    wanted = minimize(spend, np.zeros(horizon), method="L-BFGS-B", bounds=[(-2, 2)] * horizon, tol=1e-15).x
    for mpc in (
        km.NonlinearMPC(plant, cost, LIMITS, horizon),
        km.BilinearMPC(plant, cost, LIMITS, horizon, sqp_iterations=20),
    ):
        mpc(x0, [0.3, 0.0], w=W)
        np.testing.assert_allclose(mpc.plan().U[:, 0], wanted, atol=2e-4)


@pytest.mark.parametrize("kind", [km.NonlinearMPC, km.BilinearMPC])
def test_a_plan_of_one_step_knows_the_one_disturbance(kind):
    """x⁺ = 0.9 x + u (1 + w) and no limits: the cost (0.9 x + u (1 + w))² + 0.1 u² is least in closed form."""
    x, u, w = (ca.SX.sym(name) for name in "xuw")
    plant = km.StepMap(ca.Function("F", [x, u, w], [0.9 * x + u * (1 + w)]), 0.1)
    mpc = kind(plant, km.Cost(Q=1.0, R=0.1, tail=0, u_target="zero"), None, 1)
    for w_now in (0.0, 0.5, -0.4):
        gain = 1 + w_now
        assert mpc([0.7], [0.0], w=[w_now]).u == pytest.approx(-gain * 0.63 / (gain**2 + 0.1), rel=1e-6)


@pytest.mark.parametrize("estimator", [km.LiftedDisturbance(), km.ExtendedKalman()], ids=["d", "ekf"])
def test_estimators_of_the_equations_predict_with_w(plant, estimator):
    """On the plant itself nothing is left to estimate, so the run is that without an estimator."""
    W = np.stack([2 * np.sin(np.arange(30) / 5), np.ones(30)], axis=1)
    runs = [
        km.simulate(
            plant,
            km.BilinearMPC(plant, COST, LIMITS, 8, estimator=each),
            x0=[0.5, 0.5],
            reference=[0.2, 0.0],
            steps=30,
            measured=W,
        )
        for each in (None, estimator)
    ]
    np.testing.assert_allclose(runs[1].X, runs[0].X, atol=1e-6)


def test_what_does_not_fit_is_named(plant):
    mpc = km.NonlinearMPC(plant, COST, LIMITS, 5)
    task = {"x0": [0.0, 0.0], "reference": [0.0, 0.0], "steps": 10}
    with pytest.raises(km.errors.DataError, match=r"outside \[K\], wind \[m/s\]\); pass measured="):
        km.simulate(plant, mpc, **task)
    with pytest.raises(km.errors.ShapeError, match="measured has 1 columns, the plant 2 disturbances"):
        km.simulate(plant, mpc, measured=[1.0], **task)
    with pytest.raises(km.errors.ShapeError, match=r"measured has shape \(7, 2\)"):
        km.simulate(plant, mpc, measured=np.zeros((7, 2)), **task)
    W = np.zeros((10, 2))
    W[4, 1] = np.nan
    with pytest.raises(km.errors.DataError, match=r"measured holds 1 NaN or inf, the first at \(4, 1\)"):
        km.simulate(plant, mpc, measured=W, **task)
    with pytest.raises(km.errors.ShapeError, match="W has shape"):
        plant.rollout([0, 0], np.zeros((5, 1)), np.zeros((4, 2)))
    with pytest.raises(km.errors.ShapeError, match="w has shape"):
        plant([0, 0], [0], [1.0])
    with pytest.raises(km.errors.DataError, match="pass it to simulate or collect"):
        km.plants.SimulatedPlant(plant)
    excite = km.Noise(-1, 1)
    with pytest.raises(km.errors.DataError, match="pass measured="):
        km.collect(plant, [0, 0], excite, episodes=1, steps=3)
    with pytest.raises(km.errors.ShapeError, match=r"shape \(3,\), expected \(2,\), .* a column for outside"):
        km.collect(plant, [0, 0], excite, episodes=1, steps=3, measured=[1.0, 2.0, 3.0])
    with pytest.raises(km.errors.DataError, match="goes with a StepMap"):
        km.collect(plant.at([0, 0]), [0, 0], excite, episodes=1, steps=3, measured=[1.0])
