"""Controllers on models with an embedding: from y alone they do what is done from the whole point ζ."""

import copy
import pickle

import numpy as np
import pytest

import koopmpc as km

PRECISE = {"eps_abs": 1e-10, "eps_rel": 1e-10, "max_iter": 200_000}
# Two states, of which one is measured: y_{k+1} is a function of y_k, u_k, y_{k−1}, u_{k−1}, exactly.
A, B = np.array([[0.9, 0.3], [-0.2, 0.95]]), np.array([[0.1], [0.4]])


def plant(x: np.ndarray, u: np.ndarray, bilinear: bool) -> np.ndarray:
    """Return the next state; what u does may grow with the state that is measured."""
    return A @ x + B @ u * (1 + 0.3 * x[0] if bilinear else 1.0)


def episodes(bilinear: bool) -> km.Episodes:
    rng, found = np.random.default_rng(0), []
    for _ in range(12):
        x, U = rng.standard_normal(2), rng.uniform(-1, 1, (25, 1))
        Y = [x[:1]]
        for u in U:
            x = plant(x, u, bilinear)
            Y.append(x[:1])
        found.append(km.Episode(X=Y, U=U))
    return km.Episodes(found, 0.1, ("y [m]",), ("u [N]",))


@pytest.fixture(scope="module")
def linear() -> km.LinearPredictor:
    return km.edmd(episodes(False), km.State(), embedding=km.Delay(1))


@pytest.fixture(scope="module")
def bilinear() -> km.BilinearPredictor:
    """The exact model: y⁺ holds u (1 + 0.3 y), and u⁻ y⁻ of the step before."""
    return km.bilinear_edmd(episodes(True), km.State() + km.Constant() + km.Monomials(2), embedding=km.Delay(1))


FREE, SMOOTH = km.Cost(Q=[2.0], R=0.1), km.Cost(Q=[2.0], R=0.1, R_delta=0.3, Q_N=[[6.0]])


@pytest.mark.parametrize(
    ("limits", "latency", "cost"),
    [
        (km.Limits(), 0, FREE),
        (km.Limits(u_min=-0.6, u_max=0.3), 2, SMOOTH),
        (km.Limits(u_min=-1, u_max=1, x_max=0.5, slack=(50.0, 10.0)), 0, FREE),
        (km.Limits(u_min=-1, u_max=1, du_max=0.2), 1, FREE),
    ],
)
def test_on_a_linear_plant_its_inputs_are_those_of_koopman_mpc(
    linear: km.LinearPredictor, limits: km.Limits, latency: int, cost: km.Cost
) -> None:
    options = {"estimator": km.LiftedDisturbance(0.5), "latency": latency}
    ours = km.BilinearMPC(linear, cost, limits, 12, **options)
    theirs = km.KoopmanMPC(linear, cost, limits, 12, settings=PRECISE, **options)
    rng, x, got = np.random.default_rng(3), np.array([1.0, -0.5]), np.array([0.2])
    for controller in (ours, theirs):
        controller.reset(u_prev=got)
    for k in range(25):
        y, reference = x[:1], [0.3 if k > 5 else 0.0]
        a, b = ours(y, reference, applied=got), theirs(y, reference, applied=got)
        assert np.allclose(a.u, b.u, rtol=0, atol=1e-6)
        assert ours.plan().X.shape == theirs.plan().X.shape == (13, 1)
        assert np.allclose(ours.plan().X, theirs.plan().X, atol=1e-5)
        assert np.allclose(ours.observer.d[0], theirs.observer.d[0], atol=1e-7)
        assert not ours.observer.d[1:].any()
        got = np.clip(a.u + (0.1 * rng.standard_normal(1) if k % 5 == 0 else 0.0), -1, 1)
        x = plant(x, got + 0.1, False)
    assert np.abs(x[0] - 0.3) < 0.6


def test_it_knows_the_point_from_y_and_what_was_applied(bilinear: km.BilinearPredictor) -> None:
    """The same as on the fit of the embedded data, whose state is ζ."""
    known = km.bilinear_edmd(km.Delay(1)(episodes(True)), km.State() + km.Constant() + km.Monomials(2))
    limits = km.Limits(u_min=-0.6, u_max=0.6)
    kept = km.BilinearMPC(bilinear, km.Cost(Q=[2.0], R=0.1), limits, 15)
    other = km.BilinearMPC(known, km.Cost(Q=[2.0], R=0.1, of=km.State("y")), limits, 15)
    x, before, got = np.array([0.8, -0.3]), None, np.array([0.1])
    for controller in (kept, other):
        controller.reset(u_prev=got)
    for _ in range(15):
        y = x[:1]
        zeta = np.concatenate([y, got, y if before is None else before])
        assert np.allclose(kept(y, [0.3], got).u, other(zeta, [0.3], got).u, atol=1e-8)
        got = np.clip(kept.plan().U[0] + 0.05, -0.6, 0.6)
        before, x = y, plant(x, got, True)


@pytest.mark.parametrize("reference", [0.3, -0.4])
def test_a_bilinear_plant_is_tracked_from_y_alone_and_a_load_leaves_no_offset(
    bilinear: km.BilinearPredictor, reference: float
) -> None:
    blind = km.bilinear_edmd(episodes(True), km.State() + km.Constant() + km.Monomials(2))
    errors = {}
    for name, model, load, estimator in (
        ("exact", bilinear, 0.0, None),
        ("loaded", bilinear, 0.2, km.LiftedDisturbance(0.5)),
        ("without", bilinear, 0.2, None),
        ("blind", blind, 0.0, None),
    ):
        mpc = km.BilinearMPC(model, km.Cost(Q=[2.0], R=0.1), km.Limits(u_min=-1, u_max=1), 15, estimator=estimator)
        x = np.array([1.0, -0.5])
        for k in range(150):
            y = np.array([np.nan]) if k == 7 else x[:1]
            move = mpc(y, [reference])
            assert (move.status is km.Status.BAD_MEASUREMENT) == (k == 7)
            x = plant(x, move.u + load, True)
        errors[name] = abs(x[0] - reference)
    assert errors["exact"] < 1e-6
    assert errors["loaded"] < 1e-6
    assert errors["without"] > 1e-2
    assert errors["blind"] > 1e-3


@pytest.mark.parametrize("limits", [km.Limits(-1, 1), km.Limits(-0.3, 0.5, x_max=0.6)])
def test_nonlinear_mpc_takes_the_predictor_and_converged_passes_agree(
    bilinear: km.BilinearPredictor, limits: km.Limits
) -> None:
    cost = km.Cost(Q=[2.0], R=0.1, Q_N=[[3.0]])
    oracle = km.NonlinearMPC(bilinear, cost, limits, 10, solver=km.control.NLP(settings={"ipopt.tol": 1e-10}))
    ours = km.BilinearMPC(bilinear, cost, limits, 10, sqp_iterations=60)
    on_points = km.NonlinearMPC(
        bilinear.step_map(), km.Cost(Q=[2.0], R=0.1, of=km.State("y")), km.Limits(limits.u_min, limits.u_max), 10
    )
    assert on_points([0.5, 0.0, 0.5], [0.2]).status is km.Status.OPTIMAL
    x = np.array([0.8, -0.3])
    for _ in range(8):
        a, b = ours(x[:1], [0.2]), oracle(x[:1], [0.2])
        assert np.allclose(a.u, b.u, atol=2e-5)
        assert oracle.plan().X.shape == (11, 1)
        assert np.allclose(oracle.plan().X, ours.plan().X, atol=1e-4)
        x = plant(x, a.u, True)


def test_a_run_repeats_to_the_bit_after_reset_in_a_copy_and_after_update(bilinear: km.BilinearPredictor) -> None:
    mpc = km.BilinearMPC(
        bilinear, km.Cost(Q=[2.0], R=0.1), km.Limits(-0.5, 0.5), 10, estimator=km.LiftedDisturbance(0.5)
    )

    def run(controller: km.BilinearMPC) -> list[np.ndarray]:
        controller.reset()
        return [controller([1.0 - 0.1 * k], [0.2]).u for k in range(6)]

    first = run(mpc)
    for other in (mpc, copy.deepcopy(mpc), pickle.loads(pickle.dumps(mpc))):
        assert np.array_equal(first, run(other))
    mpc.update(bilinear)
    assert np.allclose(first, run(mpc), atol=1e-9)


def test_refusals(linear: km.LinearPredictor) -> None:
    mpc = km.BilinearMPC(linear, km.Cost(1, 0.1), None, 5)
    with pytest.raises(km.errors.ShapeError, match=r"y has shape \(3,\), expected \(1,\), one value a state"):
        mpc([0.0, 0.0, 0.0], [0.0])
    other = km.LinearPredictor(
        0.9 * np.eye(2),
        np.ones((2, 1)),
        np.eye(1, 2),
        km.State(),
        0.1,
        linear.states,
        linear.inputs,
        embedding=km.Delay(1, inputs=False),
    )
    with pytest.raises(km.errors.DataError, match="the predictor has another lifting than the controller's"):
        mpc.update(other)
