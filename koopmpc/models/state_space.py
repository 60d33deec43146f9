"""State-space systems of scipy.signal and python-control as predictors."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import DataError

_MATRICES = ("A", "B", "C", "D")


def is_state_space(given: object) -> bool:
    """Return whether an object has the four matrices of a state-space system."""
    return all(hasattr(given, name) for name in _MATRICES) and not hasattr(given, "lifting")


def read_state_space(
    system: Any,
    dt: float | None = None,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
) -> tuple[np.ndarray, np.ndarray, float, tuple[str, ...], tuple[str, ...]]:
    """Return A, B, the sample time and the names of a system of scipy.signal or python-control (``ss``).

    A continuous system is discretised by a zero-order hold of `dt` seconds.
    """
    if not is_state_space(system) and hasattr(system, "to_ss"):
        system = system.to_ss()
    if not is_state_space(system):
        raise DataError(f"system is {checks.article(system)}; pass scipy.signal.StateSpace or control.ss")
    A, B, C, D = (checks.array(getattr(system, name), name, (None, None)) for name in _MATRICES)
    if D.any():
        raise DataError("D is not zero: the input acts on the output of its own step, and a predictor has none of that")
    step, continuous = _find_step(system, dt)
    if continuous:
        from scipy.signal import cont2discrete  # slow to import

        A, B, *_ = cont2discrete((A, B, C, D), step)
    state_names = getattr(system, "state_labels", None) if states is None else states
    input_names = getattr(system, "input_labels", None) if inputs is None else inputs
    return (
        np.asarray(A, dtype=np.float64),
        np.asarray(B, dtype=np.float64),
        step,
        checks.names(state_names, "states", "x", len(A)),
        checks.names(input_names, "inputs", "u", B.shape[1]),
    )


def _find_step(system: Any, dt: float | None) -> tuple[float, bool]:
    """Return the sample time [s], and whether the system is continuous."""
    own = getattr(system, "dt", None)
    if own is None and not hasattr(system, "to_discrete"):
        raise DataError("the system does not say whether it is continuous; give it dt=0, or its sample time")
    if own is None or own == 0:
        if dt is None:
            raise DataError("the system is continuous; pass dt=, the sample time in seconds")
        return checks.positive(dt, "dt", "s"), True
    if own is True:
        return checks.positive(1.0 if dt is None else dt, "dt", "s"), False
    if dt is not None and not np.isclose(dt, float(own)):
        raise DataError(f"the system has dt = {float(own):g} s, but dt= is {dt:g} s; leave dt out")
    return float(own), False
