"""A mass on a rail: its exact equations, logs of it, and a goal for its controller, which many tests here design."""

import numpy as np

import koopmpc as km
from koopmpc.apps.fitting.designing import DesignedData, design_data
from koopmpc.apps.fitting.options import FitOptions

A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.005], [0.1]])
NAMES = ("position [m]", "speed [m/s]"), ("force [N/kg]",)


def logs(count=12, steps=40):
    rng, made = np.random.default_rng(0), []
    for _ in range(count):
        X, U = [rng.uniform(-1, 1, 2)], np.repeat(rng.uniform(-2, 2, (steps // 4, 1)), 4, axis=0)
        for u in U:
            X.append(A @ X[-1] + B @ u)
        made.append(km.Episode(X=np.array(X), U=U))
    return km.Episodes(made, 0.1, *NAMES)


GOAL = """
horizon = 15

[states."position [m]"]
reference = 0.5
weight = 1.0

[states."speed [m/s]"]
reference = 0.0
weight = 0.1
limits = [-0.8, 0.8]

[inputs."force [N/kg]"]
weight = 0.01
limits = [-2.0, 2.0]
"""


def design(folder, goal=GOAL, data=None, **options) -> DesignedData:
    """Return the design that `koopmpc fit` makes of these logs and this goal, of linear models by default."""
    if data is None:
        logs().save(data := folder / "logs.npz")
    (folder / "goal.toml").write_text(goal)
    (folder / "out").mkdir(exist_ok=True)
    asked = FitOptions(**{"linear": True} | options)
    return design_data(data, folder / "goal.toml", folder / "out", asked, print, None)
