"""The figures of the library under their short names: `km.plot.spectrum(model)`, saved by `km.plot.save`."""

from koopmpc.figures.eigenfunctions import plot_eigenfunctions as eigenfunctions
from koopmpc.figures.error import plot_error as error
from koopmpc.figures.reconstruction import plot_reconstruction as reconstruction
from koopmpc.figures.runs import plot_runs as runs
from koopmpc.figures.series import plot_rollout as rollout
from koopmpc.figures.series import plot_run as run
from koopmpc.figures.spectrum import plot_spectrum as spectrum
from koopmpc.figures.style import save

__all__ = ["eigenfunctions", "error", "reconstruction", "rollout", "run", "runs", "save", "spectrum"]
