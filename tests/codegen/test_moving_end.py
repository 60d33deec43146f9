"""A reference that goes on as it moved, in C and in Python: the same end of the plan, step by step."""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km

N = 10
BOX = {"u_min": -8.0, "u_max": 8.0}
CASES = {
    "held": ({}, {}),
    "zero": ({"u_target": "zero"}, {}),
    "rates": ({"R_delta": 0.2}, {"moves": (1, 1, 2, 3, 3)}),
    "disturbed": ({}, {"estimator": km.LiftedDisturbance()}),
    "late": ({}, {"estimator": km.LiftedDisturbance(), "latency": 2}),
}


@pytest.fixture(scope="module")
def plant():
    """A pendulum, θ = 0 upright, with its angle in thousandths: sizes differ."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    angle = x[0] / 1000
    ahead = ca.vertcat(x[0] + 50 * x[1], x[1] + 0.05 * (4.9 * ca.sin(angle) + 0.5 * u - 0.1 * x[1]))
    return km.StepMap(ca.Function("F", [x, u], [ahead]), 0.05, states=("theta", "omega"), inputs=("torque",))


def rows_at(kind, k, rng):
    t = k + np.arange(N + 3)
    angle = {
        "sine": 300 * np.sin(2 * np.pi * t / 60),
        "two sines": 200 * np.sin(2 * np.pi * t / 55) + 100 * np.sin(2 * np.pi * t / 17),
        "ramp": 4.0 * t - 200,
        "rest": np.full(len(t), 250.0),
        "speed": np.zeros(len(t)),  # no equilibrium holds it
        "noise": rng.normal(size=len(t)),
    }[kind]
    return np.column_stack([angle, np.zeros(len(t)) if kind != "speed" else 0.01 * t])


@pytest.mark.parametrize(
    "name", ["held", *(pytest.param(name, marks=pytest.mark.slow) for name in CASES if name != "held")]
)
def test_c_moves_the_end_as_python_does(name, plant):
    more, options = CASES[name]
    cost = km.Cost(Q=[1e-5, 0.1], R=0.1, **more)
    mpc = km.BilinearMPC(plant, cost, km.Limits(**BOX), N, **options)
    twin = km.compiled(mpc)
    blind = km.BilinearMPC(plant, km.Cost(Q=[1e-5, 0.1], R=0.1, beyond="rest", **more), km.Limits(**BOX), N, **options)
    rng, off, moved = np.random.default_rng(0), [], []
    for kind in ("sine", "two sines", "rest", "ramp", "noise", "speed"):
        x = np.array([50.0, 0.1])
        for k in range(25):
            rows = rows_at(kind, k, rng)
            a, b, c = mpc(x, rows), twin(x, rows), blind(x, rows)
            assert a.status is b.status
            off.append(float(np.abs(a.u - b.u).max()))
            moved.append((kind, float(np.abs(a.u - c.u).max())))
            x = plant(x, a.u) + rng.normal(0.0, [2.0, 0.01])
    assert max(off) < 1e-6
    assert max(miss for kind, miss in moved if kind == "sine") > 0.05


@pytest.mark.parametrize("held", ["equilibrium", "zero"])
def test_a_set_point_met_for_the_first_time_is_held_as_in_python(held, plant):
    """Near ones, far ones, and such that no torque inside the limits holds."""
    cost = km.Cost(Q=[1e-5, 0.1], R=0.1, u_target=held)
    mpc = km.BilinearMPC(plant, cost, km.Limits(**BOX), N)
    twin = km.compiled(mpc)
    rng, off, x = np.random.default_rng(1), [], np.array([50.0, 0.1])
    for k in range(60):
        angle = 20.0 * k if k % 4 else rng.uniform(-3000, 3000)
        a, b = mpc(x, [angle, 0.0]), twin(x, [angle, 0.0])
        assert (a.status, a.fallback) == (b.status, b.fallback)
        off.append(float(np.abs(a.u - b.u).max()))
        x = x + [0.05, 0.01] * rng.normal(size=2)
    assert max(off) < 1e-6
