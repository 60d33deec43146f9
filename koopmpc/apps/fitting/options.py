"""FitOptions: how logs are read, which models are tried, and what a controller is asked for, field by field."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from koopmpc.base.errors import DataError

READING = ("states", "inputs", "columns", "dt", "resample")
"""Fields that are keywords of `load_episodes`."""


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Options of ``koopmpc fit``: of `fit_data`, `design_data` and `write_template`.

    Attributes
    ----------
    states
        Columns of a table that are states or outputs: a,b,… or 3,4.
    inputs
        Columns that are inputs: u,v,… or 2; "" where there are none.
    columns
        Names to use: old=new,old=new,…; or of all columns: a,b,…
    dt
        Sample time in s, where no column tells it.
    resample
        Sample time in s to bring unequal steps to.
    horizon
        Steps ahead that the model is chosen and judged by.
    linear
        Try linear models only.
    feedthrough
        Inputs act on the outputs of their own row: y = h(x, u).
    workers
        Local processes, or those of --scheduler local.
    scheduler
        tcp://host:port of a Dask cluster, or "local".
    margin
        With a goal: share of loops that are to keep their limits.
    certify
        With a goal: seek a certificate of stability, and write its page.
    set_point
        With a goal: columns with set points of the loop that made the logs, r,s,…
    """

    states: Sequence[str] | None = None
    inputs: Sequence[str] | None = None
    columns: Mapping[str, str] | Sequence[str] | None = None
    dt: float | None = None
    resample: float | None = None
    horizon: int | None = None
    linear: bool = False
    feedthrough: bool = False
    workers: int | None = None
    scheduler: str | None = None
    margin: float | None = None
    certify: bool = False
    set_point: Sequence[str] = ()

    def __post_init__(self) -> None:
        from koopmpc.base import checks  # the shell reads the fields of this class before it imports anything slow
        from koopmpc.base.parallel import check_scheduler

        for name in ("horizon", "workers"):
            if getattr(self, name) is not None:
                checks.count(getattr(self, name), name)
        if self.margin is not None and not 0 < self.margin < 1:
            raise DataError(f"margin is {self.margin:g}; pass a share of loops between 0 and 1, such as 0.95")
        if self.scheduler is not None:
            check_scheduler(self.scheduler, self.workers)

    def list_reading(self) -> dict[str, Any]:
        """Return the keywords of `load_episodes` that are given."""
        return {name: value for name in READING if (value := getattr(self, name)) is not None}

    def refuse_design(self) -> None:
        """Raise where an option is for a controller, and no goal is given."""
        if self.margin is not None or self.certify:
            raise DataError("--margin and --certify are for a controller; pass --goal, too")
