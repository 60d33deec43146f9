"""KoopmanRegressor: scikit-learn's own checks, and what it means for dynamics."""

import re
import subprocess
import sys
import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import SkipTestWarning
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_estimator

import koopmpc as km
from tests.models.plants import one_step_pairs


def step(x, u):
    return np.array([0.9 * x[0] + 0.1 * np.sin(x[1]), 0.8 * x[1] + 0.2 * x[0] ** 2 + 0.3 * u[0]])


def rows_of(data: km.Episodes):
    parts = data.snapshots()
    return np.hstack([parts.X, parts.U]), parts.X_next


@pytest.mark.parametrize(
    "estimator", [km.identify.KoopmanRegressor(), km.identify.KoopmanRegressor(degree=1, harmonics=1, alpha=1e-6)]
)
def test_all_checks_of_scikit_learn_pass(estimator):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SkipTestWarning)  # of pandas and of array API, which are not here
        done = check_estimator(estimator, on_fail=None)
    assert [one["check_name"] for one in done if one["status"] not in ("passed", "skipped")] == []
    assert sum(one["status"] == "passed" for one in done) > 40


@pytest.mark.parametrize("alpha", [0.0, 1e-4])
def test_the_predictor_is_that_of_edmd_and_predicts_what_predict_does(alpha):
    data = one_step_pairs(step, 2, 1, 200)
    X, y = rows_of(data)
    found = km.identify.KoopmanRegressor(degree=3, alpha=alpha, n_inputs=1, dt=data.dt).fit(X, y)
    other = km.edmd(data, km.State() + km.Constant() + km.Monomials(3), ridge=alpha)
    model = found.predictor_
    assert pytest.approx(other.A, abs=1e-8) == model.A
    assert pytest.approx(other.B, abs=1e-8) == model.B
    assert np.array_equal(model.C, other.C)
    once = np.array([model.rollout(row[:2], row[2:][None])[1] for row in X])
    assert found.predict(X) == pytest.approx(once, abs=1e-9)
    assert model.dt == data.dt


def test_a_target_that_is_no_next_state_gives_no_predictor():
    X, y = rows_of(one_step_pairs(step, 2, 1, 60))
    found = km.identify.KoopmanRegressor(n_inputs=1).fit(X, y)
    assert found.predict(X[:3]).shape == (3, 2)
    found.fit(X, y[:, 0])
    assert found.predict(X[:3]).shape == (3,)
    assert not hasattr(found, "predictor_")


def test_a_lifting_without_the_state_gets_a_fitted_C():
    X, y = rows_of(one_step_pairs(step, 2, 1, 200))
    found = km.identify.KoopmanRegressor(lifting=km.Constant() + km.Fourier(3), n_inputs=1).fit(X, y)
    Z = found.lifting_(X[:, :2])
    expected = np.linalg.lstsq(Z, X[:, :2], rcond=None)[0].T
    assert pytest.approx(expected, abs=1e-8) == found.predictor_.C


def test_a_grid_search_over_episodes_finds_the_dictionary_that_is_true():
    rng = np.random.default_rng(0)
    X, y, groups = [], [], []
    for episode in range(12):
        x = rng.uniform(-1, 1, 2)
        for _ in range(20):
            u = rng.uniform(-1, 1, 1)
            x_next = np.array([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + 0.3 * x[0] ** 2 + 0.2 * u[0]])
            X.append([*x, *u])
            y.append(x_next + 1e-3 * rng.standard_normal(2))
            groups.append(episode)
            x = x_next
    search = GridSearchCV(
        km.identify.KoopmanRegressor(n_inputs=1),
        {"degree": [1, 2], "harmonics": [0, 2], "alpha": [0.0, 1e-6, 1e-1]},
        cv=GroupKFold(4),
        error_score="raise",
    )
    search.fit(np.array(X), np.array(y), groups=groups)
    assert search.best_params_["degree"] == 2
    assert search.best_params_["alpha"] < 1e-1
    assert search.best_score_ > 0.99


def test_it_stands_at_the_end_of_a_pipeline_and_clones():
    X, y = rows_of(one_step_pairs(step, 2, 1, 100))
    pipeline = make_pipeline(StandardScaler(), km.identify.KoopmanRegressor(degree=3, n_inputs=1))
    assert clone(pipeline).fit(X, y).score(X, y) > 0.999
    own = km.identify.KoopmanRegressor(lifting=km.State() + km.Constant())
    assert clone(own).get_params()["lifting"] == own.lifting


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"alpha": -1.0}, "alpha is -1"),
        ({"n_inputs": 3}, "at least one must be a state"),
        ({"degree": 0}, "degree is 0"),
        ({"harmonics": -1}, "harmonics is -1"),
        ({"lifting": "state"}, "is not a lifting"),
    ],
)
def test_a_mistake_is_told_at_fit(parameters, words):
    with pytest.raises(km.errors.DataError, match=words):
        km.identify.KoopmanRegressor(**parameters).fit(np.eye(3), np.eye(3))


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_importing_koopmpc_does_not_import_scikit_learn_but_the_name_is_there():
    done = run("import sys, koopmpc as km; print('sklearn' in sys.modules, km.identify.KoopmanRegressor().alpha)")
    assert done.stdout.split() == ["False", "0.0"], done.stderr


def test_without_scikit_learn_the_name_says_what_to_install():
    done = run("import sys; sys.modules['sklearn'] = None\nimport koopmpc as km\nkm.identify.KoopmanRegressor")
    assert re.search(r"pip install '.+\[sklearn\]'", done.stderr)
