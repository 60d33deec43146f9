"""Options of `select` and `design`, field by field."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.parallel import StageProgress
from koopmpc.lifting.base import Lifting
from koopmpc.synthesis.search.candidates import Candidate

Options = TypeVar("Options")


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchOptions:
    """What a search tries, what it does to the data first, and where it computes.

    Attributes
    ----------
    candidates
        Liftings, each of which is tried with all `delays` and both kinds; or `Candidate`, each as it stands. By default
        linear, polynomial, trigonometric, radial and random ones, for plants of 2 to 12 states.
    delays
        Past steps to try in an embedding; by default 0, 1 and 2, also 4 where the data show a hidden state and two past
        steps forecast better than one, and of records up to 12.
    bilinear
        Try z⁺ = A z + B u + E w + Σ uᵢ Nᵢ z + Σ wⱼ Sⱼ z too, where there are inputs. The surrogates of a design are
        then bilinear.
    feedthrough
        The plant has y = h(x, u): row k of the log holds the outputs under u_k. One log cannot tell this from a late
        input column, which is looked for otherwise. The inputs are moved one row up in any case; an estimator with
        ``feedthrough=True`` then reads h(x_k, u_{k−1}), for the model's next output is h(x_k, u_k). Every controller of
        a design has such a filter, a `LiftedKalman` or `ExtendedKalman`, and estimates a disturbance for each output.
    smooth
        Replace glitches with a `Mender`, and where the states hold noise, free them of it with a `Smoother`. Least
        squares on noisy states makes an unstable plant look tame, and so do forecasts that begin at them. On records
        fits to the measured rows are tried too, and kept unless smoothing gains on unseen rows; hidden states learn
        from the measured rows. The notes tell what was found.
    instruments
        For each episode (T, nr) or (T + 1, nr) rows of the set point of the loop that made the logs, or of a signal
        added to its inputs. Where the logs hold feedback, least squares is found biased and unseen rows gain, models
        are fitted to what these rows explain of states and inputs (two-stage method); the notes say whether.
    sample
        Snapshot pairs to choose on, about.
    workers, scheduler
        As in `koopmpc.base.parallel.map_tasks`: a task is a candidate, a controller with its runs, a part of
        the source.
    progress
        Called with the name of a stage, how many of its tasks are done, and how many there are, None where that is not
        known.
    rng
        Generator or seed: deals out the episodes, draws centres, features and fresh loops.
    """

    candidates: Sequence[Candidate | Lifting] | None = None
    delays: Sequence[int] | None = None
    bilinear: bool = True
    feedthrough: bool = False
    smooth: bool = True
    instruments: Sequence[ArrayLike] | None = None
    sample: int = 30_000
    workers: int | None = None
    scheduler: str | None = None
    progress: StageProgress | None = None
    rng: np.random.Generator | int = 0

    def __post_init__(self) -> None:
        for name in ("bilinear", "feedthrough", "smooth"):
            checks.kind(getattr(self, name), name, (bool, np.bool_), "pass True or False")
        checks.count(self.sample, "sample")


@dataclass(frozen=True, eq=False, kw_only=True)
class DesignOptions(SearchOptions):
    """Options of a design: those of `SearchOptions`, and how loops are judged.

    Attributes
    ----------
    angles
        Indices of states whose errors wrap at ±π. These states may leave the range of the data, and so may angles that
        made whole turns in the data, and positions on which nothing depends.
    margin
        How far inside its limits a controller plans. "errors": by its model's errors on the fold that it does not know
        (`Limits.tightened`), by at most half of the distance from the reference to the limit. A share such as 0.95: by
        the least margin with which this share of loops on surrogates keeps the limits, chosen on `loops` loops (None:
        60) and verified on as many others; `Design.promise` says what is promised, and the advice says so where no
        margin gives it. None: not at all.
    loops
        Number of fresh loops after the choice; 59 without a failure bound a probability by 5 %, 299 by 1 %. None: 600
        where the controller runs as machine code, 60 where there is no compiler. 0: none, and no finalists.
    """

    angles: Sequence[int] = ()
    margin: float | Literal["errors"] | None = "errors"
    loops: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.loops is not None:
            checks.count(self.loops, "loops", 0)
        if isinstance(self.margin, str) and self.margin != "errors":
            raise DataError(f'margin is {self.margin!r}; pass "errors", a share of loops such as 0.95, or None')
        if self.margin is not None and not isinstance(self.margin, str) and not 0 < self.margin < 1:
            raise DataError(f"margin is {self.margin:g}; pass a share of loops between 0 and 1, such as 0.95")

    @property
    def promised(self) -> float | None:
        """The share of loops that are to keep their limits; None where none is asked for."""
        return None if self.margin is None or isinstance(self.margin, str) else float(self.margin)


def check_options(options: Options | None, kind: type[Options]) -> Options:
    """Return the options, the default ones for None; raise where they are of another kind."""
    if options is None:
        return kind()
    checks.kind(options, "options", kind, f"pass km.{kind.__name__}(…)")
    return options
