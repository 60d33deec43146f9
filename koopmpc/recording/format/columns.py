"""The columns of a log: one table for the writer and the reader."""

from enum import StrEnum


class Entity(StrEnum):
    """Where the columns of a log stand.

    An entity holds rows of numbers in its component "scalars", row k at step k; other components are named beside it.
    What only the viewer draws is in views/: `world`, `model`, `plots`, `title`, and components `koopmpc.View:…`:
    one state alone in single precision, the power of ten of a time.
    """

    DESCRIPTION = "description"  # static: the page that people read, and "json", the same data to the bit
    STATE = "state"  # x_k, NaN where the plant hides it; written last, so a row that has its state is whole
    MEASUREMENT = "measurement"  # y_k, in the rows where it is not x_k to the bit
    REFERENCE = "reference"  # r_k
    INPUT = "control/u"  # u_k as applied
    INPUT_REFERENCE = "control/u_reference"  # the input that holds r_k, in the rows where it is not 0
    INPUT_LIMITS = "control/limits"  # the finite limits of u, at the first and last step of a run or live block
    SLACK = "solver/slack"  # how far the plan breaks a soft limit, in the rows where it does
    KNOWN = "solver/known"  # 1 where the model knows and 0 where it does not, in the rows where a monitor looked
    SOLVER = "solver/time_ms"  # solve time [ms]; "seconds" where it is not ms / 1000 to the bit; "iterations" above 0
    QP = "solver/qp"  # "state": which solver made the move, or "none", in the rows where it changes; "none" before all
    DEADLINE = "solver/deadline_ms"  # dt [ms], at the same steps
    STATUS = "solver/status"  # "state": STATUS or STATUS → FALLBACK, in the rows where it changes
    PLAN_STATES = "prediction/x"  # the planned states of a step, flat; "last_width" is nx
    PLAN_INPUTS = "prediction/u"  # the planned inputs of a step, flat; "last_width" is nu
    FALLBACKS = "log"  # text: a line where a fallback sets in
    METRICS = "metrics"  # static, at the end: a page, "steps", "cost", "effort", "violation", checksums of all columns


DRAWN = (Entity.INPUT_LIMITS, Entity.DEADLINE, Entity.FALLBACKS)  # for people who look; `load_run` needs all others
NO_SOLVER = "none"  # the solver of a step that asked none
