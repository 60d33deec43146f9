"""The tolerances of C code: as in Python, and in single precision, whose rounding is 5e8 times as coarse."""

from koopmpc.control.ask.levels import NEAR
from koopmpc.control.nonlinear.equilibrium import RANK
from koopmpc.control.nonlinear.equilibrium import SETTLED as HELD
from koopmpc.control.nonlinear.iteration import DIGITS, ENOUGH, PRECISE, STUCK
from koopmpc.control.nonlinear.real_time_solver import SETTLED
from koopmpc.control.plan.row_targets import PSEUDO
from koopmpc.control.riccati import SETTLED as RESTED
from koopmpc.control.solvers.sequences import EQUAL
from koopmpc.control.step import aim
from koopmpc.control.step.staged import NO_DIGITS
from koopmpc.control.target import ROUNDING
from koopmpc.estimate.gate import ROUNDING as AT_REST

# DAQP's tolerances in single precision: its own are below the rounding of a float.
SINGLE = {
    "primal_tol": 1e-5, "dual_tol": 1e-6, "zero_tol": 1e-6, "pivot_tol": 1e-4,
    "progress_tol": 1e-7, "sing_tol": 1e-6, "refactor_tol": 1e-5,
}  # fmt: skip
_OTHERS = ("cycle_tol", "iter_limit", "eps_prox", "eta_prox", "rho_soft", "rel_subopt", "abs_subopt", "w_soft")
SETTINGS = (*SINGLE, "fval_bound", *_OTHERS)

FLAT = 1e-6  # the least weight of a target's coordinates in single precision, whose rounding would hide Python's 1e-9

# The tolerances of C by their names there: in double precision, and in single.
IN_C = {
    "WIDER": (1e-8, 1e-5),
    "ACCURACY": (1e-6, 5e-3),
    "ROUNDING": (ROUNDING, 1e-6),
    "AT_REST": (AT_REST, 1e-6),
    "NEAR_LEVEL": (NEAR, 1e-4),
    "BETTER": (1 - EQUAL, 1 - 1e-6),
    "PRECISE": (PRECISE, 1e-6),
    "ENOUGH": (ENOUGH, 1e-4),
    "DIGITS": (DIGITS, 1e-6),
    "STUCK": (STUCK, 1e-6),
    "SETTLED": (SETTLED, 1e-4),
    "REACH": (1e-9, 1e-5),
    "NO_DIGITS": (NO_DIGITS, 1e6),
    "RANK": (RANK, 1e-6),
    "HELD": (HELD, 1e-4),
    "TURN": (1e-15, 1e-7),
    "SMALL": (1e-7, 1e-4),
    "RESTED": (RESTED, 1e-5),
    "PSEUDO": (PSEUDO, 1e-5),
    "FITS": (aim.FITS, 1e-4),
    "GROWS": (aim.GROWS, 1e-3),
    "DRIFTS": (aim.DRIFTS, 1e-4),
    "FOLLOWS": (aim.FOLLOWS, 1e-2),
    "STILL": (aim.STILL, 1e-5),
    "TERMS": (aim.TERMS, 1e-5),
    "FLAT": (aim.ROUNDING, 1e-6),
    "LEFT": (aim.LEFT, 0.1),
    "SEEN": (aim.SEEN, 1e-3),
}
