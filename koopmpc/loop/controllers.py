"""What a loop asks of a controller: its members, the states and disturbances of its model, an input that is finite."""

from collections.abc import Sequence
from dataclasses import MISSING, fields
from math import isfinite
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.control.move import Controller, Move
from koopmpc.models.base import Predictor
from koopmpc.plants.plant import Plant, require_plant
from koopmpc.plants.step_map import StepMap

CONTROLLER = ("dt", "nu", "horizon", "reset", "__call__")


HOW = (
    "a Controller has dt [s], nu, horizon (0 if it reads no preview), reset(x0, u_prev), and is called as "
    "controller(y, reference, applied) -> Move; make it a class, see km.control.Controller, or pass its law "
    "as a function u = f(y, r)"
)


_MOVE = tuple(f.name for f in fields(Move) if f.default is MISSING)  # what a user's own move needs


def checked_input(move: Move, nu: int, k: int) -> Float[np.ndarray, " nu"]:
    """Return the input of what a controller returned at step k; raise if the result is not a Move, or u not finite."""
    if type(move) is not Move:
        checks.members(move, "what the controller returned", _MOVE, "return a km.Move")
    u = np.asarray(move.u, dtype=np.float64)
    if u.shape != (nu,):
        raise ShapeError(f"the controller returned u of shape {u.shape} at step {k}, expected ({nu},)")
    for value in u.tolist():  # for a few inputs four times as fast as numpy
        if not isfinite(value):
            raise DataError(f"the controller returned u = {u} at step {k}; every input must be finite")
    return u


def require_match(plant: StepMap | Plant, controller: Any, angles: Sequence[int]) -> Controller:
    """Return the controller; raise where plant and controller lack a member, or do not fit each other."""
    checks.members(controller, "the controller", CONTROLLER, HOW)
    if not isinstance(plant, StepMap):
        require_plant(plant)
    if abs(plant.dt - controller.dt) > 1e-12 * plant.dt:
        raise DataError(f"the controller has dt = {controller.dt:g} s, the plant {plant.dt:g} s; use one dt for both")
    inputs, nx = tuple(plant.inputs), len(plant.states)
    if controller.nu != len(inputs):
        raise ShapeError(f"the controller returns {controller.nu} inputs, the plant takes {len(inputs)} ({inputs})")
    outside = [i for i in angles if not 0 <= i < nx]
    if outside:
        raise DataError(f"angles holds {outside[0]}; pass indices of states, 0 to {nx - 1}")
    return controller


def count_disturbances(controller: object) -> int | None:
    """Return how many measured disturbances the model of a controller has; None where it has no model."""
    count: int | None = getattr(controller, "nw", None)  # a station knows those of its parts
    if count is not None:
        return count
    model = predictor_of(controller) or getattr(controller, "step_map", None)
    return None if model is None else getattr(model, "nw", 0)


def predictor_of(controller: object) -> Predictor | None:
    """Return the predictor that a controller holds, None where it has none."""
    held = (getattr(controller, name, None) for name in ("predictor", "model"))
    return next((each for each in held if isinstance(each, Predictor)), None)


def start_sizes(controller: object) -> frozenset[int]:
    """Return the numbers of states of the models that a controller holds; none where it has no model."""
    sizes: frozenset[int] | None = getattr(controller, "start_sizes", None)  # of several controllers in one
    if sizes is not None:
        return sizes
    states = getattr(predictor_of(controller) or getattr(controller, "step_map", None), "states", None)
    return frozenset() if states is None else frozenset({len(states)})


def start_for(controller: object, x0: Float[np.ndarray, " nx"] | None) -> Float[np.ndarray, " nx"] | None:
    """Return the start that a controller can know: None where x0 has other states than its model."""
    sizes = start_sizes(controller)
    return x0 if x0 is None or not sizes or len(x0) in sizes else None
