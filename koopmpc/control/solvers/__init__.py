"""The QP solvers by name: a new one is a file of its own here, a subclass of `QPSolver`, and a line below."""

from typing import Literal

from koopmpc.control.solvers.base import QPSolver
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.solvers.osqp import OSQP

SolverName = Literal["osqp", "daqp"]
SOLVERS: dict[str, type[QPSolver]] = {"osqp": OSQP, "daqp": DAQP}
