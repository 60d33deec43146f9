"""Models from elsewhere: by hand, of pykoop and of PyDMD, each in one line; the packages are the extra `peers`."""

import numpy as np
import pytest

import koopmpc as km

A0, B0 = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[0.0], [0.1]])
PLANT = km.black_box(
    lambda x, u: A0 @ x + B0 @ u + [0, 0.05 * x[0] ** 2], dt=0.1, states=["a [m]", "b [m/s]"], inputs=["u [N]"]
)
COST, LIMITS = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-2, u_max=2)


def _data() -> km.Episodes:
    return km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-1, 1), episodes=20, steps=20)


def _rows(data: km.Episodes) -> np.ndarray:
    """Return the episodes as pykoop has them: number of the episode, states, input; the last input is not used."""
    return np.vstack(
        [np.column_stack([np.full(len(e.X), i), e.X, np.vstack([e.U, [[0]]])]) for i, e in enumerate(data)]
    )


def _controlled(model: km.LinearPredictor) -> km.Run:
    mpc = km.KoopmanMPC(model, COST, LIMITS, horizon=15)
    return km.simulate(PLANT, mpc, x0=[1, 0], reference=[0, 0], steps=60, cost=COST, limits=LIMITS)


def test_matrices_and_a_lifting_by_hand_are_a_model_in_one_line():
    fitted = km.edmd(_data(), km.State() + km.Monomials(2))
    squares = km.Expressions(lambda x: [x[0], x[1], x[0] ** 2, x[0] * x[1], x[1] ** 2], ["a", "b", "a²", "a b", "b²"])
    model = km.LinearPredictor(fitted.A, fitted.B, fitted.C, squares, 0.1, ["a [m]", "b [m/s]"], ["u [N]"])
    np.testing.assert_allclose(_controlled(model).U[0], _controlled(fitted).U[0], rtol=0.05)
    assert np.abs(_controlled(model).X[-1]).max() < 1e-3


def test_a_function_of_numbers_is_enough_for_koopman_mpc_and_says_where_it_is_not(tmp_path):
    from koopmpc.predict.peers import Numeric

    fitted = km.edmd(_data(), km.State() + km.Monomials(2))
    psi = Numeric(
        lambda X: np.column_stack([X, X[:, 0] ** 2, X[:, 0] * X[:, 1], X[:, 1] ** 2]), ("a", "b", "aa", "ab", "bb")
    )
    model = km.LinearPredictor(fitted.A, fitted.B, fitted.C, psi, 0.1, ["a [m]", "b [m/s]"], ["u [N]"])
    assert np.abs(_controlled(model).X[-1]).max() < 1e-3
    with pytest.raises(km.errors.ObservableError, match=r"write it with km\.Expressions"):
        model.step_map()
    with pytest.raises(km.errors.DataError, match="which no file holds"):
        model.save(tmp_path / "model.npz")
    wrong = Numeric(lambda X: X, ("a", "b", "c")).bind(["a", "b"])
    with pytest.raises(km.errors.DataError, match=r"returns shape \(1, 2\) for 1 states, expected \(1, 3\)"):
        wrong([0.0, 0.0])


def test_a_pipeline_of_pykoop_is_a_model_in_one_line():
    pykoop = pytest.importorskip("pykoop")
    data = _data()
    split = pykoop.SplitPipeline([("p", pykoop.PolynomialLiftingFn(order=2))], None)
    pipeline = pykoop.KoopmanPipeline([("s", split)], regressor=pykoop.Edmd()).fit(
        _rows(data), n_inputs=1, episode_feature=True
    )
    model = km.from_peer(pipeline, dt=0.1, states=data.states, inputs=data.inputs)
    ours = km.edmd(data, km.State() + km.Monomials(2))
    np.testing.assert_allclose(np.sort(np.abs(model.eigenvalues)), np.sort(np.abs(ours.eigenvalues)), atol=1e-7)
    U = np.random.default_rng(0).uniform(-1, 1, (20, 1))
    rows = np.column_stack([np.zeros(21), np.tile([0.5, -0.3], (21, 1)), np.vstack([U, [[0]]])])
    theirs = pipeline.predict_trajectory(rows, relift_state=False, return_lifted=False, return_input=False)[:, 1:]
    np.testing.assert_allclose(model.rollout([0.5, -0.3], U), theirs, atol=1e-8)
    assert np.abs(_controlled(model).X[-1]).max() < 1e-3
    symbolic = km.from_peer(pipeline, dt=0.1, lifting=km.State() + km.Monomials(2))
    assert symbolic.step_map().rollout([0.5, -0.3], U).shape == (21, 2)
    with pytest.raises(km.errors.DataError, match="other observables than the pipeline"):
        km.from_peer(pipeline, dt=0.1, lifting=km.State() + km.Monomials(3))
    lifted = pykoop.KoopmanPipeline([("p", pykoop.PolynomialLiftingFn(order=2))], regressor=pykoop.Edmd())
    with pytest.raises(km.errors.DataError, match="makes 4 inputs of 1: it lifts them"):
        km.from_peer(lifted.fit(_rows(data), n_inputs=1, episode_feature=True), dt=0.1)
    delayed = pykoop.SplitPipeline([("d", pykoop.DelayLiftingFn(n_delays_state=1, n_delays_input=0))], None)
    late = pykoop.KoopmanPipeline([("s", delayed)], regressor=pykoop.Edmd()).fit(
        _rows(data), n_inputs=1, episode_feature=True
    )
    with pytest.raises(km.errors.DataError, match="has delays"):
        km.from_peer(late, dt=0.1)


def test_dmd_and_dmdc_of_pydmd_are_models_in_one_line():
    pydmd = pytest.importorskip("pydmd")
    U = np.random.default_rng(1).uniform(-1, 1, (40, 1))
    X = [np.array([1.0, 0.0])]
    for u in U:
        X.append(A0 @ X[-1] + B0 @ u)
    controlled = pydmd.DMDc(svd_rank=-1)
    controlled.fit(np.array(X).T, U.T)
    model = km.from_peer(controlled, dt=0.1, states=["a [m]", "b [m/s]"], inputs=["u [N]"])
    np.testing.assert_allclose(model.A, A0, atol=1e-9)
    np.testing.assert_allclose(model.B, B0, atol=1e-9)
    assert np.abs(_controlled(model).X[-1]).max() < 0.01
    free = np.array([np.linalg.matrix_power(A0, k) @ [1.0, 0.5] for k in range(20)])
    autonomous = km.from_peer(pydmd.DMD(svd_rank=2).fit(free.T), dt=0.1)
    np.testing.assert_allclose(autonomous.rollout(free[0], np.zeros((19, 0))), free, atol=1e-8)


def test_what_is_no_model_is_told():
    with pytest.raises(km.errors.DataError, match="a dict is no fitted DMD of PyDMD nor a fitted KoopmanPipeline"):
        km.from_peer({}, dt=0.1)
