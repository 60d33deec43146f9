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


class Pipeline:
    """What km.predict.from_peer reads of a fitted KoopmanPipeline of pykoop: [A B] and a function of rows, no formula."""

    min_samples_ = n_inputs_in_ = n_inputs_out_ = 1

    def __init__(self, lift, A, B, n_states=2):
        self.lift, self.n_states_in_, self.n_states_out_ = lift, n_states, len(A)
        self.regressor_ = type("Regressor", (), {"coef_": np.hstack([A, B]).T})

    def lift_state(self, X, episode_feature):
        assert not episode_feature
        return self.lift(X)


def test_a_lifting_of_numbers_is_enough_for_koopman_mpc_and_says_where_it_is_not(tmp_path):
    fitted = km.edmd(_data(), km.State() + km.Monomials(2))
    squares = lambda X: np.column_stack([X, X[:, 0] ** 2, X[:, 0] * X[:, 1], X[:, 1] ** 2])  # noqa: E731
    names = {"dt": 0.1, "states": ["a [m]", "b [m/s]"], "inputs": ["u [N]"]}
    model = km.predict.from_peer(Pipeline(squares, fitted.A, fitted.B), **names)
    np.testing.assert_allclose(_controlled(model).U[0], _controlled(fitted).U[0], rtol=0.05)
    assert np.abs(_controlled(model).X[-1]).max() < 1e-3
    with pytest.raises(km.errors.ObservableError, match=r"write it with km\.Expressions"):
        model.step_map()
    with pytest.raises(km.errors.DataError, match="which no file holds"):
        model.save(tmp_path / "model.npz")
    wrong = km.predict.from_peer(Pipeline(lambda X: X, fitted.A[:3, :3], fitted.B[:3]), **names)
    with pytest.raises(km.errors.DataError, match=r"returns shape \(1, 2\) for 1 states, expected \(1, 3\)"):
        wrong.lift([0.0, 0.0])


def test_a_pipeline_of_pykoop_is_a_model_in_one_line():
    pykoop = pytest.importorskip("pykoop")
    data = _data()
    split = pykoop.SplitPipeline([("p", pykoop.PolynomialLiftingFn(order=2))], None)
    pipeline = pykoop.KoopmanPipeline([("s", split)], regressor=pykoop.Edmd()).fit(
        _rows(data), n_inputs=1, episode_feature=True
    )
    model = km.predict.from_peer(pipeline, dt=0.1, states=data.states, inputs=data.inputs)
    ours = km.edmd(data, km.State() + km.Monomials(2))
    np.testing.assert_allclose(np.sort(np.abs(model.eigenvalues)), np.sort(np.abs(ours.eigenvalues)), atol=1e-7)
    U = np.random.default_rng(0).uniform(-1, 1, (20, 1))
    rows = np.column_stack([np.zeros(21), np.tile([0.5, -0.3], (21, 1)), np.vstack([U, [[0]]])])
    theirs = pipeline.predict_trajectory(rows, relift_state=False, return_lifted=False, return_input=False)[:, 1:]
    np.testing.assert_allclose(model.rollout([0.5, -0.3], U), theirs, atol=1e-8)
    assert np.abs(_controlled(model).X[-1]).max() < 1e-3
    symbolic = km.predict.from_peer(pipeline, dt=0.1, lifting=km.State() + km.Monomials(2))
    assert symbolic.step_map().rollout([0.5, -0.3], U).shape == (21, 2)
    with pytest.raises(km.errors.DataError, match="other observables than the pipeline"):
        km.predict.from_peer(pipeline, dt=0.1, lifting=km.State() + km.Monomials(3))
    lifted = pykoop.KoopmanPipeline([("p", pykoop.PolynomialLiftingFn(order=2))], regressor=pykoop.Edmd())
    with pytest.raises(km.errors.DataError, match="makes 4 inputs of 1: it lifts them"):
        km.predict.from_peer(lifted.fit(_rows(data), n_inputs=1, episode_feature=True), dt=0.1)
    delayed = pykoop.SplitPipeline([("d", pykoop.DelayLiftingFn(n_delays_state=1, n_delays_input=0))], None)
    late = pykoop.KoopmanPipeline([("s", delayed)], regressor=pykoop.Edmd()).fit(
        _rows(data), n_inputs=1, episode_feature=True
    )
    with pytest.raises(km.errors.DataError, match="has delays"):
        km.predict.from_peer(late, dt=0.1)


def test_dmd_and_dmdc_of_pydmd_are_models_in_one_line():
    pydmd = pytest.importorskip("pydmd")
    U = np.random.default_rng(1).uniform(-1, 1, (40, 1))
    X = [np.array([1.0, 0.0])]
    for u in U:
        X.append(A0 @ X[-1] + B0 @ u)
    controlled = pydmd.DMDc(svd_rank=-1)
    controlled.fit(np.array(X).T, U.T)
    model = km.predict.from_peer(controlled, dt=0.1, states=["a [m]", "b [m/s]"], inputs=["u [N]"])
    np.testing.assert_allclose(model.A, A0, atol=1e-9)
    np.testing.assert_allclose(model.B, B0, atol=1e-9)
    assert np.abs(_controlled(model).X[-1]).max() < 0.01
    free = np.array([np.linalg.matrix_power(A0, k) @ [1.0, 0.5] for k in range(20)])
    autonomous = km.predict.from_peer(pydmd.DMD(svd_rank=2).fit(free.T), dt=0.1)
    np.testing.assert_allclose(autonomous.rollout(free[0], np.zeros((19, 0))), free, atol=1e-8)


def test_what_is_no_model_is_told():
    with pytest.raises(km.errors.DataError, match="a dict is no fitted DMD of PyDMD nor a fitted KoopmanPipeline"):
        km.predict.from_peer({}, dt=0.1)


class Fitted:
    """What `from_peer` reads of a fitted object of another package."""

    def __init__(self, **fields: object) -> None:
        self.__dict__.update(fields)


def pipeline(**changes: object) -> Fitted:
    """A pipeline with z = [b, a, a b] of two states and two inputs, as pykoop names its parts."""
    rng = np.random.default_rng(0)
    fields = {
        "n_states_in_": 2, "n_inputs_in_": 2, "n_states_out_": 3, "n_inputs_out_": 2, "min_samples_": 1,
        "regressor_": Fitted(coef_=rng.normal(size=(5, 3))),
        "lift_state": lambda X, episode_feature: np.column_stack([X[:, 1], X[:, 0], X[:, 0] * X[:, 1]]),
    }  # fmt: skip
    return Fitted(**fields | changes)


def test_of_a_pipeline_the_matrices_are_taken_and_the_states_are_found_among_its_observables():
    fitted = pipeline()
    model = km.predict.from_peer(fitted, dt=0.2)
    np.testing.assert_array_equal(np.hstack([model.A, model.B]), fitted.regressor_.coef_.T)
    np.testing.assert_array_equal(model.C, [[0, 1, 0], [1, 0, 0]])
    assert (model.dt, model.states, model.inputs, model.lifting.names) == (0.2, ("x0", "x1"), ("u0", "u1"), ("z0", "z1", "z2"))  # fmt: skip
    np.testing.assert_array_equal(model.lift([2.0, 3.0]), [3, 2, 6])
    named = km.predict.from_peer(fitted, dt=0.2, states=["a", "b"], inputs=["u", "v"])
    assert (named.states, named.inputs) == (("a", "b"), ("u", "v"))
    own = km.Expressions(lambda x: [x[1], x[0], x[0] * x[1]], ["b", "a", "ab"])
    assert km.predict.from_peer(fitted, dt=0.2, lifting=own).lifting.names == ("b", "a", "ab")
    near = km.Expressions(lambda x: [x[1], x[0], x[0] * x[1] + 1e-6], ["b", "a", "ab"])
    for wrong in (near, km.State()):
        with pytest.raises(
            km.errors.DataError, match="lifting has other observables than the pipeline, or another order"
        ):
            km.predict.from_peer(fitted, dt=0.2, lifting=wrong)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"min_samples_": 2}, "the pipeline has delays"),
        ({"n_inputs_out_": 4}, "the pipeline makes 4 inputs of 2: it lifts them"),
        ({"lift_state": lambda X, episode_feature: np.column_stack([X[:, 0], X[:, 1] + 1e-6, X[:, 1] ** 2])}, "does not hold x1"),
    ],
)  # fmt: skip
def test_a_pipeline_that_is_no_linear_model_of_the_states_is_refused(changes, text):
    with pytest.raises(km.errors.DataError, match=text):
        km.predict.from_peer(pipeline(**changes), dt=0.2)


def test_of_a_dynamic_mode_decomposition_modes_and_eigenvalues_make_the_matrix():
    A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.5]])
    eigenvalues, modes = np.linalg.eig(A)
    free = km.predict.from_peer(Fitted(modes=modes, eigs=eigenvalues), dt=0.1)
    np.testing.assert_allclose(free.A, A, atol=1e-12)
    assert (free.nu, free.states) == (0, ("x0", "x1", "x2"))
    np.testing.assert_array_equal(free.C, np.eye(3))
    B = np.arange(6.0).reshape(3, 2)
    driven = km.predict.from_peer(Fitted(modes=modes, eigs=eigenvalues, B=B), dt=0.1, inputs=["u", "v"])
    np.testing.assert_array_equal(driven.B, B)
    assert driven.inputs == ("u", "v")
    few = km.predict.from_peer(Fitted(modes=modes[:, :2], eigs=eigenvalues[:2]), dt=0.1)  # two of three: a projection
    exact = (modes[:, :2] * eigenvalues[:2]) @ np.linalg.pinv(modes[:, :2])
    np.testing.assert_allclose(few.A, exact.real, atol=1e-12)
    with pytest.raises(km.errors.DataError, match="its operator Φ Λ Φ⁺ is not real; fit it to real snapshots"):
        km.predict.from_peer(Fitted(modes=np.eye(2), eigs=np.array([1.0, 0.5 + 1e-6j])), dt=0.1)
    km.predict.from_peer(Fitted(modes=np.eye(2), eigs=np.array([1.0, 0.5 + 1e-12j])), dt=0.1)


def test_what_is_not_fitted_is_told():
    class Unfitted:
        eigs = property(lambda self: (_ for _ in ()).throw(ValueError("not fitted")))
        modes = None

    with pytest.raises((km.errors.DataError, ValueError), match="not fitted"):
        km.predict.from_peer(Unfitted(), dt=0.1)
    for other in (Fitted(modes=1), Fitted(eigs=1), Fitted(regressor_=1), Fitted(lift_state=1)):
        with pytest.raises(
            km.errors.DataError, match="a Fitted is no fitted DMD of PyDMD nor a fitted KoopmanPipeline"
        ):
            km.predict.from_peer(other, dt=0.1)


def test_one_measured_state_is_lifted_by_the_function_and_is_nan_where_it_is_far_off():
    product = Pipeline(lambda X: np.column_stack([X, X[:, 0] * X[:, 1]]), 0.9 * np.eye(3), np.ones((3, 1)))
    measured = km.predict.from_peer(product, dt=0.1).lifting.measured()
    np.testing.assert_array_equal(np.array(measured([2.0, 3.0])).ravel(), [2, 3, 6])
    for bad in ([np.nan, 1.0], [1.0, 2e30], [-2e30, 1.0]):
        assert np.isnan(np.array(measured(bad))).all()
    assert np.isfinite(np.array(measured([1.0, 0.5e30]))).all()
