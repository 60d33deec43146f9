"""Logs of runs as episodes, for a fit on what closed loops recorded."""

from pathlib import Path

import numpy as np

from koopmpc.data.episodes import Episodes
from koopmpc.data.sampling import Signals, episodes_from
from koopmpc.data.storage import reads
from koopmpc.recording.reader import load_run


@reads(".rrd")
def run_episodes(path: Path) -> Episodes:
    """Return the inputs and states of a run's log, or its measurements where the plant hides them all, as episodes.

    A row with a value missing cuts.

    Raises
    ------
    LogError
        The log is missing, damaged, or was not written by koopmpc.
    DataError
        The run has no two steps in sequence whose state is known.
    """
    run = load_run(path)
    steps = len(run.U)
    U = np.vstack([run.U, np.full((1, run.U.shape[1]), np.nan)])
    hidden = not np.isfinite(run.X).any()
    X, names = (run.Y, run.outputs) if hidden else (run.X, run.states)
    signals = Signals(None, X, U, np.empty((steps + 1, 0)), np.arange(steps + 1))
    return Episodes(episodes_from([signals], run.dt, str(path)), run.dt, names, run.inputs)
