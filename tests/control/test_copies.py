"""A copy of a controller in mid-run goes on where the original is, and shares nothing with it."""

import copy
import pickle
from collections.abc import Callable

import numpy as np
import pytest

import koopmpc as km
from tests.control.test_slack import COST, MODEL, A, B, N

LIMITS = km.Limits(-1, 1, du_min=-0.2, du_max=0.2)
SOFT = km.Limits(-1, 1, x_min=[-np.inf, -0.3], x_max=[np.inf, 0.3])
MAKERS: dict[str, Callable[[], km.BilinearMPC | km.KoopmanMPC | km.NonlinearMPC]] = {
    "koopman": lambda: km.KoopmanMPC(MODEL, COST, LIMITS, N, estimator=km.LiftedDisturbance(0.2)),
    "koopman, active set": lambda: km.KoopmanMPC(MODEL, COST, LIMITS, N, solver="daqp"),
    "koopman, handed over": lambda: km.KoopmanMPC(MODEL, COST, SOFT, N, settings={"max_iter": 5}),
    "bilinear": lambda: km.BilinearMPC(MODEL, COST, LIMITS, N),
    "bilinear, estimated": lambda: km.BilinearMPC(MODEL, COST, LIMITS, N, estimator=km.LiftedDisturbance(0.2)),
    "bilinear, late": lambda: km.BilinearMPC(MODEL, COST, LIMITS, N, latency=1),
    "nonlinear": lambda: km.NonlinearMPC(MODEL.step_map(), COST, LIMITS, N),
}


def moves(
    mpc: km.BilinearMPC | km.KoopmanMPC | km.NonlinearMPC, x: np.ndarray, steps: int
) -> tuple[list[float], np.ndarray]:
    """Return the inputs under a load that no model has, and the state at the end."""
    found: list[float] = []
    for _ in range(steps):
        u = mpc(x, [0.0, 0.0]).u
        found.append(float(u[0]))
        x = A @ x + B @ u + 0.01
    return found, x


@pytest.mark.parametrize("name", MAKERS)
def test_a_copy_in_mid_run_goes_on(name: str) -> None:
    original = MAKERS[name]()
    _, x = moves(original, np.array([2.0, 0.0]), 4)  # the rate is active here
    copies = [pickle.loads(pickle.dumps(original)), copy.deepcopy(original), copy.copy(original)]
    expected, _ = moves(original, x, 6)
    for other in copies:
        found, _ = moves(other, x, 6)
        assert np.allclose(found, expected, atol=1e-6)
        assert found == expected or not isinstance(original, km.KoopmanMPC)


@pytest.mark.parametrize("kind", [km.KoopmanMPC, km.BilinearMPC, km.NonlinearMPC])
def test_a_copy_with_an_estimator_of_a_local_class_goes_on_and_shares_no_disturbance(kind: type) -> None:
    class Own:
        def start(self, model: object, horizon: int) -> object:
            return km.LiftedDisturbance(0.5).start(model, horizon)

    original = kind(MODEL, km.Cost(Q=1.0, R=0.1), km.Limits(u_min=-5, u_max=5), 8, estimator=Own())
    _, x = moves(original, np.array([2.0, 0.0]), 4)
    copies = [copy.copy(original), copy.deepcopy(original)]
    known = original.observer.d.copy()
    assert known.any()
    expected, _ = moves(original, x, 6)
    assert (original.observer.d != known).any()
    for other in copies:
        np.testing.assert_array_equal(other.observer.d, known)
        assert np.allclose(moves(other, x, 6)[0], expected, atol=1e-6)


def test_a_new_model_after_a_hand_over_is_controlled_as_by_a_new_controller() -> None:
    make = MAKERS["koopman, handed over"]
    mpc, fresh = make(), make()
    assert mpc([2.0, 0.0], [0.0, 0.0]).solver == "daqp"
    other = km.LinearPredictor(1.02 * A, B, np.eye(2), MODEL.lifting, 0.1, MODEL.states, MODEL.inputs)
    mpc.update(other)
    fresh.update(other)
    assert np.allclose(mpc([1.9, -0.1], [0.0, 0.0]).u, fresh([1.9, -0.1], [0.0, 0.0]).u, atol=1e-9)
