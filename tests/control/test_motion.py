"""The end of a plan where the reference moves at its last row: it goes on, or that row is weighed, or there is no tail."""

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.tiers import few

WAYS = (None, "motion", "rest")
A, B = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[0.005], [0.1]])


def line(x, u):
    return ca.mtimes(ca.DM(A), x) + ca.mtimes(ca.DM(B), u)


def plant():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    F, h = ca.Function("F", [x, u], [line(x, u)]), ca.Function("h", [x], [x])
    return km.StepMap(F, 0.1, h, ("p", "v"), ("u",), ("p", "v"))


@pytest.mark.parametrize("u_target", ["equilibrium", "zero"])
def test_without_limits_a_short_plan_moves_as_one_that_sees_everything(u_target):
    """The end is exact on a linear plant: eight steps with the recurrence are as good as 160 with the true rows."""
    k = np.arange(400)
    rows = 0.7 * np.sin(2 * np.pi * k / 50) + 0.2
    cost = {"Q": [5.0, 0.3], "R": 0.2, "u_target": u_target}
    rows = np.column_stack([rows, 0 * rows])
    short, blind = (km.BilinearMPC(plant(), km.Cost(**cost, beyond=way), None, 8) for way in ("motion", "rest"))
    whole = km.BilinearMPC(plant(), km.Cost(**cost), None, 160)
    for first in (0, 13, 31):
        seen = rows[first : first + 9]
        true = whole([0.1, -0.2], rows[first : first + 161]).u
        assert short([0.1, -0.2], seen).u == pytest.approx(true, rel=2e-5)
        assert abs(blind([0.1, -0.2], seen).u - true) > 1e-3


def test_a_reference_that_rests_is_followed_as_before():
    both = [km.BilinearMPC(plant(), km.Cost(Q=[5, 1], R=0.2, beyond=way), None, 8) for way in ("motion", "rest")]
    for rows in ([0.3, 0.0], np.column_stack([np.repeat([0.0, 1.0], [4, 5]), np.zeros(9)])):
        moved, rested = (one([0.1, -0.2], rows).u for one in both)
        assert (moved == rested).all()


@pytest.mark.unhooked
def test_it_is_refused_where_it_cannot_be():
    with pytest.raises(km.errors.DataError, match="leave Q_N and tail out"):
        km.Cost(Q=[1, 1], R=1, tail=0, beyond="motion")
    with pytest.raises(km.errors.DataError, match='pass "rest" or "motion"'):
        km.Cost(Q=[1, 1], R=1, beyond="hold")
    cost = km.Cost(Q=[1, 1], R=1, beyond="motion")
    with pytest.raises(km.errors.DataError, match="needs a BilinearMPC"):
        km.LinearMPC(plant(), [0, 0], [0], cost, None, 5)


def test_it_is_the_default_of_plans_over_stages_without_an_end_of_their_own():
    rows = np.column_stack([np.sin(0.2 * np.arange(9)), np.zeros(9)])
    for kind in (km.BilinearMPC, km.NonlinearMPC):
        inputs = [kind(plant(), km.Cost(Q=[5, 1], R=0.2, beyond=way), None, 8)([0.1, 0], rows).u for way in WAYS]
        assert (inputs[0] == inputs[1]).all()
        assert abs(inputs[0] - inputs[2]) > 1e-3
    assert not km.Cost(Q=1, R=1, tail=4).moves_on
    assert (
        km.LinearMPC(plant(), [0, 0], [0], km.Cost(Q=[5, 1], R=0.2), None, 8)([0.1, 0], rows).status.name
        == "UNCONSTRAINED"
    )


@dataclass(frozen=True)
class Vehicle(km.Dynamics):
    """At rest it cannot move sideways: no linear tail follows a curve."""

    states: ClassVar = ("x [m]", "y [m]", "heading [rad]")
    inputs: ClassVar = ("speed [m/s]", "turn [rad/s]")
    unit: float = 1.0  # of x and y in one metre

    def rhs(self, x, u):
        speed = self.unit * u[0]
        return ca.vertcat(speed * ca.cos(x[2]), speed * ca.sin(x[2]), u[1])


@dataclass(frozen=True)
class Mass(km.Dynamics):
    """p̈ = −stiffness p − 0.2 stiffness ṗ + u: an oscillator, or a double integrator."""

    states: ClassVar = ("p [m]", "v [m/s]")
    inputs: ClassVar = ("u [N]",)
    stiffness: float = 1.0

    def rhs(self, x, u):
        return ca.vertcat(x[1], u[0] - self.stiffness * (x[0] + 0.2 * x[1]))


def circle(radius):
    angle = TIME / radius
    return np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), angle])


def columns(position, speed):
    return np.column_stack([position, np.broadcast_to(speed, TIME.shape)])


STEPS, N = 110, 10
TIME = 0.1 * np.arange(STEPS + 2 * N + 1)
DRIVEN = {"Q": [10, 10, 1], "R": 0.1}
SINE, SPEED = np.sin(TIME), np.cos(TIME)
# plant, cost, reference, start
COURSES = {
    "figure of eight": (
        Vehicle(), {"Q": [10, 10], "R": 0.1, "of": km.State(["x", "y"])},
        columns(3 * np.sin(0.3 * TIME), 1.5 * np.sin(0.6 * TIME)), [0.1, -0.1, 0.8],
    ),
    "curve": (Vehicle(), DRIVEN, circle(50.0), [0.1, -0.1, 0.2]),
    "straight": (Vehicle(), DRIVEN, circle(1e6), [0.1, -0.1, 0.2]),
    "sine": (Mass(), {"Q": [5, 0.1], "R": 0.1}, columns(SINE, 0.0), [0.5, 0]),
    "sine and its speed": (Mass(), {"Q": [5, 1], "R": 0.1}, columns(SINE, SPEED), [0.5, 0]),
    "rounded sine and its speed": (Mass(), {"Q": [5, 1], "R": 0.1}, columns(SINE, SPEED).round(3), [0, 1]),
    "ramp": (Mass(0.0), {"Q": [5, 0.1], "R": 0.1}, columns(0.5 * TIME, 0.0), [0.5, 0]),
    "ramp and its speed": (Mass(0.0), {"Q": [5, 1], "R": 0.1}, columns(0.5 * TIME, 0.5), [0.1, 0.4]),
    "ramp of a spring": (Mass(), {"Q": [5, 0.1], "R": 0.1}, columns(0.2 * TIME, 0.0), [0.5, 0]),
    "ramp of the speed": (Mass(0.0), {"Q": 1, "R": 0.1, "of": km.State(["v"])}, 0.1 * TIME[:, None], [0, 0.1]),
    "parabola and its speed": (Mass(0.0), {"Q": [5, 1], "R": 0.1}, columns(0.05 * TIME**2, 0.1 * TIME), [0.1, 0]),
    "step": (Mass(0.0), {"Q": [5, 0.1], "R": 0.1}, columns(1.0 * (TIME > 5), 0.0), [0.5, 0]),
}  # fmt: skip


def linearised(plant, *rest):
    return km.LinearMPC(plant, np.zeros(2), np.zeros(1), *rest)


def learned(plant, *rest):
    data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-1, 1), episodes=10, steps=20, rng=0)
    return km.KoopmanMPC(km.dmdc(data), *rest)


def drive(kind, plant, cost, rows, start, horizon=N, steps=STEPS, limits=None):
    return km.simulate(
        plant,
        kind(plant, cost, limits, horizon),
        x0=start,
        reference=rows[: steps + horizon + 1],
        steps=steps,
        cost=cost,
        limits=limits,
    )


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
@pytest.mark.parametrize(("radius", "most", "unit"), [(2.0, 0.006, 1.0), (5.0, 0.003, 1.0), (2.0, 0.006, 1000.0)])
def test_a_vehicle_keeps_the_circle_that_it_can_drive_in_any_unit(kind, radius, most, unit):
    vehicle, size = km.discretize(Vehicle(unit=unit), dt=0.1), np.array([unit, unit, 1.0])
    rows, cost = circle(radius) * size, km.Cost(Q=[10, 10, 1] / size**2, R=0.1)
    limits = km.Limits(u_min=-2, u_max=2)
    run = drive(kind, vehicle, cost, rows, [0.5, -0.5, 1.0] * size, 2 * N, limits=limits)
    assert np.hypot(*(run.X[60:, :2] - rows[60 : STEPS + 1, :2]).T).max() <= most * unit


def test_a_slow_loop_behind_the_plan_keeps_its_tail():
    """It comes to rest in thousands of steps: without its tail this mass was three times as far off."""
    time = 0.01 * np.arange(521)
    rows, mass = np.column_stack([np.sin(time), 0 * time]), km.discretize(Mass(0.0), dt=0.01)
    costs = [
        km.metrics(drive(km.BilinearMPC, mass, km.Cost(Q=[5, 0.1], R=50, **end), rows, [0, 1], 2 * N, 500)).cost
        for end in ({}, {"beyond": "rest"}, {"tail": 0})
    ]
    assert costs[0] <= 1.02 * min(costs)


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
@pytest.mark.parametrize("course", few(COURSES, "figure of eight", "ramp of the speed", "parabola and its speed"))
def test_a_moving_reference_costs_no_more_than_without_a_tail(kind, course):
    dynamics, cost, rows, start = COURSES[course]
    model = km.discretize(dynamics, dt=0.1)
    costs = [km.metrics(drive(kind, model, km.Cost(**cost, **end), rows, start)).cost for end in ({}, {"tail": 0})]
    assert costs[0] <= 1.02 * costs[1]


@pytest.mark.parametrize("kind", [linearised, learned])
@pytest.mark.parametrize("course", ["sine", "ramp", "ramp of a spring", "ramp of the speed", "step"])
def test_linear_controllers_hold_the_last_row(kind, course):
    dynamics, cost, rows, start = COURSES[course]
    model = km.discretize(dynamics, dt=0.1)
    costs = [km.metrics(drive(kind, model, km.Cost(**cost, **end), rows, start)).cost for end in ({}, {"tail": 0})]
    assert costs[0] <= 1.02 * costs[1]


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
def test_rest_is_where_the_last_rows_are_equal(kind):
    """A preview that comes to rest before its end is followed as one that rests, to the bit."""
    vehicle, rows = km.discretize(Vehicle(), dt=0.1), circle(2.0)[: N + 1].copy()
    rows[-3:] = rows[-3]
    inputs = [
        kind(vehicle, km.Cost(**DRIVEN, beyond=way), None, N)([0.1, 0.0, 0.2], rows).u for way in ("motion", "rest")
    ]
    assert (inputs[0] == inputs[1]).all()
