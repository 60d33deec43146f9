"""Faults that time stamps show: uneven steps, a clock that is set back, missing rows."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.validate.logs.log import LogFault, Place, listed
from koopmpc.validate.text import percent

_JITTER = 0.02  # share of dt by which a step may differ, as in load_episodes
_GAP = 1.5  # a step longer than 1.5 dt is a gap
_OTHER = 0.1  # share of dt by which the median step of an episode must differ to be another rate


def clock_faults(data: Episodes, times: Sequence[ArrayLike]) -> Iterator[LogFault]:
    """Find the faults that the time stamps of the rows show.

    Raises
    ------
    DataError
        There are not as many time stamps as rows.
    """
    if len(times) != len(data):
        raise DataError(f"times are given for {len(times)} episodes, the data have {len(data)}; pass one array each")
    stamps = [
        checks.vector(own, f"times of episode {e}", len(episode) + 1)
        for e, (own, episode) in enumerate(zip(times, data, strict=True))
    ]
    steps = np.concatenate([np.diff(t) for t in stamps])
    forward = steps[steps > 0]
    if not len(forward):
        raise DataError("the times never advance; pass the time of each row in seconds")
    dt = float(np.median(forward))
    resets = _places(stamps, lambda d: d <= 0)
    if resets:
        yield LogFault(
            "clock reset",
            f"the clock goes back or stands still {len(resets)} times: {listed(resets)}",
            "cut the episodes there: load_episodes does where it goes back",
            places=resets,
        )
    gaps = _places(stamps, lambda d: d > _GAP * dt)
    other = [e for e, t in enumerate(stamps) if abs(np.median(np.diff(t)) - dt) > _OTHER * dt]
    if other:
        shown = ", ".join(f"episode {e} {np.median(np.diff(stamps[e])):.4g} s" for e in other[:3])
        yield LogFault(
            "mixed sampling",
            f"{len(other)} of {len(data)} episodes have another step than {dt:.4g} s: {shown}",
            f"bring them to one step: load_episodes(…, resample={dt:.4g})",
            places=tuple(Place(e, 0, len(stamps[e])) for e in other),
        )
    gaps = tuple(p for p in gaps if p.episode not in other)
    if gaps:
        yield LogFault(
            "jump",
            f"rows are missing {len(gaps)} times, by the clock: {listed(gaps)}",
            "cut the episodes there: load_episodes does",
            places=gaps,
        )
    usual = [np.diff(t) for e, t in enumerate(stamps) if e not in other]
    usual = np.concatenate(usual) if usual else np.zeros(0)
    usual = usual[(usual > 0) & (usual <= _GAP * dt)]
    uneven = np.abs(usual - dt) > _JITTER * dt
    if uneven.any():
        yield LogFault(
            "jitter",
            f"{percent(float(uneven.mean()))} of the steps differ from {dt:.4g} s by more than 2 %, from "
            f"{usual.min():.4g} to {usual.max():.4g} s",
            f"interpolate to equal steps: load_episodes(…, resample={dt:.4g})",
        )


def _places(stamps: list[Float[np.ndarray, " T1"]], found: Callable[[np.ndarray], np.ndarray]) -> tuple[Place, ...]:
    return tuple(
        Place(e, int(k), int(k) + 2, jump=True) for e, t in enumerate(stamps) for k in np.flatnonzero(found(np.diff(t)))
    )
