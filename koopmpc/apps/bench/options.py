"""SweepOptions: which runs a sweep makes of each case, where, and what it shows."""

from collections.abc import Sequence
from dataclasses import dataclass

from koopmpc.base.errors import ProblemError


@dataclass(frozen=True)
class SweepOptions:
    """What `sweep` runs of each case, where, and what it shows.

    Attributes
    ----------
    starts
        Initial states of each case: its own, and starts − 1 drawn from the box in which training data begin.
    seeds
        Sets of training data, each of its own seed; a model is learned once for each.
    noise
        Standard deviations of the measurement noise, as shares of that of each output in the training data.
    wrong
        Largest shares by which the parameters of the driven plant, the number fields of its Dynamics, are off.
    faults
        Run each case again under each of `FAULTS`; their logs end in <controller>-<fault>.rrd.
    monitor
        Have MPC of learned models say at each step whether it is like the data; `metrics` counts those that are not,
        and the logs keep them.
    compiled
        Run those controllers in C that `km.compiled` can build; the others stay in Python. A run's metadata say which
        it was.
    log_starts
        How many starts of each case have logs; a run that failed has one too.
    workers
        Local processes, or those of the scheduler "local".
    scheduler
        tcp://host:port of a Dask cluster, or "local".
    live
        Stream each run to a Rerun viewer; one is opened where none is up. Without a viewer there is one UserWarning,
        and the runs are recorded all the same. Runs of this process only.
    paced
        Let each run take as long as its plant would, to be watched.
    """

    starts: int = 1
    seeds: int = 1
    noise: Sequence[float] = (0.0,)
    wrong: Sequence[float] = (0.0,)
    faults: bool = False
    monitor: bool = False
    compiled: bool = False
    log_starts: int = 1
    workers: int | None = None
    scheduler: str | None = None
    live: bool = False
    paced: bool = False

    def __post_init__(self) -> None:
        from koopmpc.base import checks  # the command line reads this class, and waits for no numpy

        checks.count(self.starts, "starts")
        checks.count(self.seeds, "seeds")
        for name in ("noise", "wrong"):
            shares = getattr(self, name)
            values = checks.array(shares, name, (None,))
            if not len(values) or (values < 0).any() or len(set(values.tolist())) != len(values):
                raise ProblemError(
                    f"{name} is {list(shares)}; pass shares of zero or more, each once, such as [0, 0.01]"
                )
            object.__setattr__(self, name, tuple(values.tolist()))
        if self.live and not self.is_here:
            raise ProblemError("live= shows runs of this process; leave out workers= and scheduler=")

    @property
    def is_here(self) -> bool:
        """Whether all runs are of this process."""
        return self.scheduler is None and self.workers in (None, 1)

    @property
    def is_single(self) -> bool:
        """Whether each controller meets each case once, apart from faults."""
        return self.starts == self.seeds == 1 and not any((*self.noise, *self.wrong))
