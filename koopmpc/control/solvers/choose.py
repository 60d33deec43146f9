"""QP solvers by name."""

from koopmpc.control.solvers.base import Setup
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.solvers.osqp import OSQP
from koopmpc.errors import DataError

SOLVERS: dict[str, Setup] = {"osqp": OSQP, "daqp": DAQP}


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
