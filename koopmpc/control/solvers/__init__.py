"""One QP in, one solution out: the solvers, and the order in which a step asks them (order.py)."""

from koopmpc.control.solvers.order import FINISHER as FINISHER
from koopmpc.control.solvers.order import SOLVERS as SOLVERS
from koopmpc.control.solvers.order import add_sparse as add_sparse
from koopmpc.control.solvers.order import exact_turn as exact_turn
from koopmpc.control.solvers.order import order_solvers as order_solvers
