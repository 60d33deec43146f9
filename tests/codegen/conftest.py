import numpy as np
import pytest

import koopmpc as km

DT = 0.05


@pytest.fixture(autouse=True)
def _sizes_are_not_measured(monkeypatch):
    """Leave out the compiler's run for the README's table of sizes; folders of module fixtures are made before this."""
    monkeypatch.setattr("koopmpc.codegen.export._measure_objects", lambda *_: None)


@pytest.fixture(scope="session")
def pendulum():
    """The pendulum driven upright: its map, and a model of twelve observables that was fitted in closed loop."""
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, dt=DT)
    data = km.collect(plant, problem.training.x0, problem.training.excitation, episodes=50, steps=40, rng=0)
    return plant, km.edmd(data, problem.lifting)


@pytest.fixture(scope="session")
def cart():
    """A mass that two inputs push, with a measured disturbance: a model of its past, for a state of two."""
    A, B, E = np.array([[1.0, DT], [0.0, 0.98]]), np.array([[0.0, 0.01], [DT, 0.02]]), np.array([[0.0], [0.03]])
    rng = np.random.default_rng(3)
    episodes = []
    for _ in range(20):
        U, W = rng.uniform(-2, 2, (30, 2)), rng.uniform(-1, 1, (30, 1))
        X = np.zeros((31, 2))
        X[0] = rng.uniform(-1, 1, 2)
        for k in range(30):
            X[k + 1] = A @ X[k] + B @ U[k] + E @ W[k] + 0.01 * np.sin(X[k])
        episodes.append(km.Episode(X=X, U=U, W=W))
    return km.edmd(km.Episodes(episodes, DT), km.State() + km.Constant(), embedding=km.Delay(2), ridge=1e-6)
