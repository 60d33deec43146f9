import numpy as np
import pytest

import koopmpc as km
from tests.example_plants import CartPole

MAP = km.discretize(CartPole(), 0.05)


def test_a_simulated_plant_is_a_plant_with_the_maps_names():
    plant = km.plants.SimulatedPlant(MAP)
    assert isinstance(plant, km.plants.Plant)
    assert (plant.dt, plant.states, plant.inputs, plant.outputs) == (0.05, MAP.states, MAP.inputs, MAP.outputs)


def test_it_walks_the_rollout():
    plant, U = km.plants.SimulatedPlant(MAP), np.random.default_rng(0).normal(size=(30, 1))
    Y = [plant.reset([0, 0.3, 0, 0], 0)] + [plant.step(u) for u in U]
    assert np.array(Y).tobytes() == MAP.rollout([0, 0.3, 0, 0], U).tobytes()


def test_a_disturbance_is_added_to_the_next_state():
    plant, w = km.plants.SimulatedPlant(MAP), np.array([0.1, -0.2, 0.3, 0.4])
    plant.reset([0, 0.3, 0, 0], 0)
    assert plant.step([1.0], w).tolist() == (MAP([0, 0.3, 0, 0], [1.0]) + w).tolist()
    assert w.tolist() == [0.1, -0.2, 0.3, 0.4]


def test_nothing_is_shared_with_the_caller():
    plant, x0 = km.plants.SimulatedPlant(MAP), np.array([0.0, 0.3, 0.0, 0.0])
    y = plant.reset(x0, 0)
    x0[:], y[:] = 7, 8
    seen = plant.state
    assert seen is not None
    assert seen.tolist() == [0.0, 0.3, 0.0, 0.0]
    seen[:] = 9
    after = plant.step([0.0])
    assert after.tolist() == MAP([0.0, 0.3, 0.0, 0.0], [0.0]).tolist()
    after[:] = 9
    assert plant.step([0.0])[0] != 9


def test_mistakes_are_named():
    plant = km.plants.SimulatedPlant(MAP)
    assert plant.state is None
    with pytest.raises(km.errors.DataError, match=r"the plant has no state yet; call reset\(x0, rng\) before step"):
        plant.step([0.0])
    with pytest.raises(km.errors.ShapeError, match=r"x0 has shape \(2,\), expected \(4,\)"):
        plant.reset([0, 0], 0)
    plant.reset([0, 0, 0, 0], 0)
    with pytest.raises(km.errors.ShapeError, match=r"disturbance has shape \(1,\), expected \(4,\)"):
        plant.step([0.0], [1.0])
    with pytest.raises(km.errors.ShapeError, match=r"u has shape \(2,\), expected \(1,\)"):
        plant.step([0.0, 0.0])
    assert plant.state.tolist() == [0, 0, 0, 0]  # a refused step leaves the plant where it was
