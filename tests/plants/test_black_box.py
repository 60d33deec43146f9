"""Plants from a function: km.black_box."""

import numpy as np
import pytest

import koopmpc as km
from tests.bare import shown
from tests.example_plants import CartPole

MAP = km.discretize(CartPole(), 0.05)
NAMES = {"states": MAP.states, "inputs": MAP.inputs}


def test_a_function_is_a_plant_whose_data_and_runs_are_those_of_the_step_map_in_it():
    box = km.black_box(lambda x, u: MAP(x, u), dt=0.05, **NAMES)
    assert isinstance(box, km.plants.Plant)
    asked = {"episodes": 3, "steps": 12, "rng": 4}
    pushes, begin = km.Noise(-5, 5), km.Uniform([-1] * 4, [1] * 4)
    assert km.collect(box, begin, pushes, **asked) == km.collect(km.plants.SimulatedPlant(MAP), begin, pushes, **asked)
    cost = km.Cost(Q=[5, 10, 50, 5], R=0.01)
    mpc = km.LinearMPC(MAP, np.zeros(4), [0.0], cost, km.Limits(u_min=-40, u_max=40), 20)
    loop = {"x0": [0, 0, 0.2, 0], "reference": [0.1, 0, 0, 0], "steps": 30}
    loop["options"] = km.loop.LoopOptions(disturbance=[0, 0.01, 0, 0])
    one, other = km.simulate(box, mpc, **loop), km.simulate(MAP, mpc, **loop)
    assert one.X.tobytes() == other.X.tobytes()
    assert one.U.tobytes() == other.U.tobytes()


def test_what_is_measured_may_be_less_than_the_state():
    box = km.black_box(
        lambda x, u: x + 0.1 * u[0],
        dt=0.1,
        states=("a", "b"),
        inputs=("u",),
        measure=lambda x: x[0] + x[1],
        outputs=("sum",),
    )
    assert box.reset([1.0, 2.0]).tolist() == [3.0]
    assert box.step(1.0) == pytest.approx([3.2])
    assert box.state == pytest.approx([1.1, 2.1])


def test_a_function_that_writes_into_its_arguments_changes_nothing_outside():
    def step(x, u):
        x += u[0]
        u[:] = 7.0
        return x

    box = km.black_box(step, dt=0.1, states=("a",), inputs=("u",))
    x0, u = np.array([1.0]), np.array([2.0])
    box.reset(x0)
    assert box.step(u).tolist() == [3.0]
    assert (x0[0], u[0]) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (None, r"step\(x, u\) returned None; return 2 values: a, b"),
        ([1.0, 2.0, 3.0], r"step\(x, u\) returned shape \(3,\), expected \(2,\): a, b"),
        ("no", "step"),
    ],
)
def test_what_a_function_returns_wrongly_is_named(returned, message):
    box = km.black_box(lambda x, u: returned, dt=0.1, states=("a", "b"), inputs=("u",))
    box.reset([0.0, 0.0])
    with pytest.raises(km.KoopmpcError, match=message):
        box.step([0.0])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"measure": lambda x: x}, "measure and outputs belong together"),
        ({"outputs": ("y",)}, "measure and outputs belong together"),
        ({"states": ()}, "states is empty"),
        ({"dt": 0}, "dt is 0 s; it must be above zero"),
    ],
)
def test_what_cannot_be_a_plant_is_refused(changed, message):
    given = {"dt": 0.1, "states": ("a",), "inputs": ("u",)} | changed
    with pytest.raises(km.KoopmpcError, match=message):
        km.black_box(lambda x, u: x, **given)


def test_a_step_that_is_no_function_is_refused():
    (line,) = shown('show(lambda: km.black_box(3, dt=0.1, states=("a",), inputs=("u",)))')
    assert "step is an int; pass a function" in line


def test_a_map_that_has_no_state_of_its_own_asks_for_x0():
    with pytest.raises(km.KoopmpcError, match="pass x0"):
        km.collect(MAP, None, km.Noise(-1, 1), episodes=1, steps=2)
    with pytest.raises(km.KoopmpcError, match="pass x0"):
        km.collect(km.plants.SimulatedPlant(MAP), None, km.Noise(-1, 1), episodes=1, steps=2)
