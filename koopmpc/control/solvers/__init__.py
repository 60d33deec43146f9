"""The QP solvers by name. A new one is a subclass of `QPSolver` in its own file here, imported and listed below."""

from typing import Literal

from koopmpc.control.solvers.base import QPSolver
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.solvers.osqp import OSQP

SolverName = Literal["osqp", "daqp"]
SOLVERS: dict[str, type[QPSolver]] = {"osqp": OSQP, "daqp": DAQP}
