"""QP solvers by name."""

from collections.abc import Mapping
from typing import Any

from koopmpc.control.solvers.base import Setup
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.solvers.osqp import OSQP
from koopmpc.errors import DataError

SOLVERS: dict[str, Setup] = {"osqp": OSQP, "daqp": DAQP}
# Slacks and their large weights are slow work for OSQP: how far a limit gives way need not be known to 1e-5.
SOFT_SETTINGS: Mapping[str, Mapping[str, Any]] = {"osqp": {"eps_abs": 1e-4, "eps_rel": 1e-4}, "daqp": {}}


def solver(name: str) -> Setup:
    """Return the solver's class: it takes a QP and the solver's own settings.

    Raises
    ------
    DataError
        There is none of that name.
    """
    if name not in SOLVERS:
        raise DataError(f"solver is {name!r}; there are {', '.join(map(repr, SOLVERS))}")
    return SOLVERS[name]
