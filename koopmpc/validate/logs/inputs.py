"""Faults of inputs alone: those that never move, and those that excite too little."""

from collections.abc import Iterator

import numpy as np

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.lifting.base import strip_unit
from koopmpc.validate.logs.log import Log, LogFault, Repair
from koopmpc.validate.sufficiency import persistency


def find_constant_inputs(log: Log) -> Iterator[LogFault]:
    """Find inputs that never move."""
    for j in np.flatnonzero(np.ptp(log.U, axis=0) == 0):
        name = strip_unit(log.data.inputs[j])
        yield LogFault(
            "constant input",
            f"{name} is {log.U[0, j]:.4g} throughout: its effect cannot be learned",
            f"excite {name}, with km.Noise or km.data.PRBS, or leave it out",
            (log.data.inputs[j],),
            repair=Repair.COLUMN,
        )


def find_low_excitation(log: Log) -> Iterator[LogFault]:
    """Find inputs that are exciting of a lower order than the plant has states."""
    order = log.data.nx + 1
    for j in np.flatnonzero(np.ptp(log.U, axis=0) > 0):
        long = [e for e in log.data if len(e) > order + 1]
        if not long:
            continue
        # use differences: a constant level would raise the order by one without exciting the plant
        differences = Episodes([Episode(X=e.X[1:], U=np.diff(e.U[:, [j]], axis=0)) for e in long], log.data.dt)
        good = int((persistency(differences, order).conditions < 1e7).sum())
        if good < min(order, 3):
            name = strip_unit(log.data.inputs[j])
            yield LogFault(
                "little excitation",
                f"{name} excites to order {good} only, and {log.data.nx} states ask for {order}: a sine, or rare steps",
                f"excite {name} with km.Noise, km.data.PRBS or km.data.Multisine",
                (log.data.inputs[j],),
            )
