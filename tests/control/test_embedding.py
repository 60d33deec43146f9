"""Controllers on models with an embedding: from y alone they do what is done from the whole point ζ."""

import copy
import pickle

import numpy as np
import pytest

from koopmpc.control.bilinear_mpc import BilinearMPC
from koopmpc.control.cost import Cost
from koopmpc.control.koopman_mpc import KoopmanMPC
from koopmpc.control.limits import Limits
from koopmpc.control.move import Status
from koopmpc.control.nonlinear_mpc import NonlinearMPC
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError, ShapeError
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.identify.bilinear import bilinear_edmd
from koopmpc.identify.edmd import edmd
from koopmpc.lifting.constant import Constant
from koopmpc.lifting.monomials import Monomials
from koopmpc.lifting.state import State
from koopmpc.predict.bilinear import BilinearPredictor
from koopmpc.predict.linear import LinearPredictor

PRECISE = {"eps_abs": 1e-10, "eps_rel": 1e-10, "max_iter": 200_000}
# Two states, of which one is measured: y_{k+1} is a function of y_k, u_k, y_{k−1}, u_{k−1}, exactly.
A, B = np.array([[0.9, 0.3], [-0.2, 0.95]]), np.array([[0.1], [0.4]])


def plant(x: np.ndarray, u: np.ndarray, bilinear: bool) -> np.ndarray:
    """Return the next state; what u does may grow with the state that is measured."""
    return A @ x + B @ u * (1 + 0.3 * x[0] if bilinear else 1.0)


def episodes(bilinear: bool) -> Episodes:
    rng, found = np.random.default_rng(0), []
    for _ in range(12):
        x, U = rng.standard_normal(2), rng.uniform(-1, 1, (25, 1))
        Y = [x[:1]]
        for u in U:
            x = plant(x, u, bilinear)
            Y.append(x[:1])
        found.append(Episode(X=Y, U=U))
    return Episodes(found, 0.1, ("y [m]",), ("u [N]",))


@pytest.fixture(scope="module")
def linear() -> LinearPredictor:
    return edmd(episodes(False), State(), embedding=Delay(1))


@pytest.fixture(scope="module")
def bilinear() -> BilinearPredictor:
    """The exact model: y⁺ holds u (1 + 0.3 y), and u⁻ y⁻ of the step before."""
    return bilinear_edmd(episodes(True), State() + Constant() + Monomials(2), embedding=Delay(1))


FREE, SMOOTH = Cost(Q=[2.0], R=0.1), Cost(Q=[2.0], R=0.1, R_delta=0.3)


@pytest.mark.parametrize(
    ("limits", "latency", "cost"),
    [
        (Limits(), 0, FREE),
        (Limits(u_min=-0.6, u_max=0.3), 2, SMOOTH),
        (Limits(u_min=-1, u_max=1, x_max=0.5, slack=(50.0, 10.0)), 0, FREE),
        (Limits(u_min=-1, u_max=1, du_max=0.2), 1, FREE),
    ],
)
def test_on_a_linear_plant_its_inputs_are_those_of_koopman_mpc(
    linear: LinearPredictor, limits: Limits, latency: int, cost: Cost
) -> None:
    options = {"estimator": LiftedDisturbance(0.5), "latency": latency}
    ours = BilinearMPC(linear, cost, limits, 12, **options)
    theirs = KoopmanMPC(linear, cost, limits, 12, settings=PRECISE, **options)
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


def test_it_knows_the_point_from_y_and_what_was_applied(bilinear: BilinearPredictor) -> None:
    """The same as on the fit of the embedded data, whose state is ζ."""
    known = bilinear_edmd(Delay(1)(episodes(True)), State() + Constant() + Monomials(2))
    limits = Limits(u_min=-0.6, u_max=0.6)
    kept = BilinearMPC(bilinear, Cost(Q=[2.0], R=0.1), limits, 15)
    other = BilinearMPC(known, Cost(Q=[2.0], R=0.1, of=State("y")), limits, 15)
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
    bilinear: BilinearPredictor, reference: float
) -> None:
    blind = bilinear_edmd(episodes(True), State() + Constant() + Monomials(2))
    errors = {}
    for name, model, load, estimator in (
        ("exact", bilinear, 0.0, None),
        ("loaded", bilinear, 0.2, LiftedDisturbance(0.5)),
        ("without", bilinear, 0.2, None),
        ("blind", blind, 0.0, None),
    ):
        mpc = BilinearMPC(model, Cost(Q=[2.0], R=0.1), Limits(u_min=-1, u_max=1), 15, estimator=estimator)
        x = np.array([1.0, -0.5])
        for k in range(150):
            y = np.array([np.nan]) if k == 7 else x[:1]
            move = mpc(y, [reference])
            assert (move.status is Status.BAD_MEASUREMENT) == (k == 7)
            x = plant(x, move.u + load, True)
        errors[name] = abs(x[0] - reference)
    assert errors["exact"] < 1e-6
    assert errors["loaded"] < 1e-6
    assert errors["without"] > 1e-2
    assert errors["blind"] > 1e-3


@pytest.mark.parametrize("limits", [Limits(-1, 1), Limits(-0.3, 0.5, x_max=0.6)])
def test_nonlinear_mpc_takes_the_predictor_and_converged_passes_agree(
    bilinear: BilinearPredictor, limits: Limits
) -> None:
    cost = Cost(Q=[2.0], R=0.1, Q_N=[[3.0]])
    oracle = NonlinearMPC(bilinear, cost, limits, 10, settings={"ipopt.tol": 1e-10})
    ours = BilinearMPC(bilinear, cost, limits, 10, passes=60)
    on_points = NonlinearMPC(
        bilinear.step_map(), Cost(Q=[2.0], R=0.1, of=State("y")), Limits(limits.u_min, limits.u_max), 10
    )
    assert on_points([0.5, 0.0, 0.5], [0.2]).status is Status.OPTIMAL
    x = np.array([0.8, -0.3])
    for _ in range(8):
        a, b = ours(x[:1], [0.2]), oracle(x[:1], [0.2])
        assert np.allclose(a.u, b.u, atol=2e-5)
        assert oracle.plan().X.shape == (11, 1)
        assert np.allclose(oracle.plan().X, ours.plan().X, atol=1e-4)
        x = plant(x, a.u, True)


def test_a_run_repeats_to_the_bit_after_reset_in_a_copy_and_after_update(bilinear: BilinearPredictor) -> None:
    mpc = BilinearMPC(bilinear, Cost(Q=[2.0], R=0.1), Limits(-0.5, 0.5), 10, estimator=LiftedDisturbance(0.5))

    def run(controller: BilinearMPC) -> list[np.ndarray]:
        controller.reset()
        return [controller([1.0 - 0.1 * k], [0.2]).u for k in range(6)]

    first = run(mpc)
    for other in (mpc, copy.deepcopy(mpc), pickle.loads(pickle.dumps(mpc))):
        assert np.array_equal(first, run(other))
    mpc.update(bilinear)
    assert np.allclose(first, run(mpc), atol=1e-9)


def test_refusals(linear: LinearPredictor) -> None:
    mpc = BilinearMPC(linear, Cost(1, 0.1), None, 5)
    with pytest.raises(ShapeError, match=r"y has shape \(3,\), expected \(1,\), one value a state"):
        mpc([0.0, 0.0, 0.0], [0.0])
    other = LinearPredictor(
        0.9 * np.eye(2),
        np.ones((2, 1)),
        np.eye(1, 2),
        State(),
        0.1,
        linear.states,
        linear.inputs,
        embedding=Delay(1, inputs=False),
    )
    with pytest.raises(DataError, match="the predictor has another lifting than the controller's"):
        mpc.update(other)
