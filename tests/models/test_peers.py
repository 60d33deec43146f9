"""Models from elsewhere: by hand, and of pykoop and PyDMD as a page shows; the packages are the extra `peers`."""

import numpy as np
import pytest

import koopmpc as km
from tests.docs.page import run

A0, B0 = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[0.0], [0.1]])
PLANT = km.black_box(
    lambda x, u: A0 @ x + B0 @ u + [0, 0.05 * x[0] ** 2], dt=0.1, states=["a [m]", "b [m/s]"], inputs=["u [N]"]
)
COST, LIMITS = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-2, u_max=2)


def _controlled(model: km.LinearPredictor) -> km.Run:
    mpc = km.KoopmanMPC(model, COST, LIMITS, horizon=15)
    return km.simulate(PLANT, mpc, x0=[1, 0], reference=[0, 0], steps=60, cost=COST, limits=LIMITS)


def test_matrices_and_a_lifting_by_hand_are_a_model_in_one_line():
    fitted = km.edmd(
        km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-1, 1), episodes=20, steps=20),
        km.State() + km.Monomials(2),
    )
    squares = km.Expressions(lambda x: [x[0], x[1], x[0] ** 2, x[0] * x[1], x[1] ** 2], ["a", "b", "a²", "a b", "b²"])
    model = km.LinearPredictor(fitted.A, fitted.B, fitted.C, squares, 0.1, ["a [m]", "b [m/s]"], ["u [N]"])
    np.testing.assert_allclose(_controlled(model).U[0], _controlled(fitted).U[0], rtol=0.05)
    assert np.abs(_controlled(model).X[-1]).max() < 1e-3


def test_models_of_pydmd_and_pykoop_predict_the_plant_of_their_data(tmp_path):
    pytest.importorskip("pykoop", reason="the extra peers is not installed")
    pytest.importorskip("pydmd", reason="the extra peers is not installed")
    names = run("how/peers.md", tmp_path)[0]
    U = np.random.default_rng(0).uniform(-1, 1, (20, 1))
    X = [np.array([0.5, -0.3])]
    for u in U:
        X.append(names["A"] @ X[-1] + names["B"] @ u)
    for model in (names["model"], names["lifted"]):
        np.testing.assert_allclose(model.rollout([0.5, -0.3], U), X, atol=1e-6)
