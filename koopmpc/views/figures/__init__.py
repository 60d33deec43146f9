"""Figures of models and runs, by matplotlib: `km.plot.spectrum(model)` draws one, and `km.plot.save` writes it."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.views.figures.eigenvalues import eigenfunction_maps as eigenfunction_maps
    from koopmpc.views.figures.eigenvalues import spectrum as spectrum
    from koopmpc.views.figures.regions import blindness as blindness
    from koopmpc.views.figures.regions import certificate as certificate
    from koopmpc.views.figures.series import error as error
    from koopmpc.views.figures.series import reconstruction as reconstruction
    from koopmpc.views.figures.series import rollout as rollout
    from koopmpc.views.figures.series import run as run
    from koopmpc.views.figures.series import runs as runs
    from koopmpc.views.figures.style import save as save
else:
    __getattr__, __dir__, __all__ = attach(__name__)
