"""Subset: some parts of a source."""

from collections.abc import Sequence

from koopmpc.data.source import Part, Source


class Subset(Source):
    """The parts of a source that stand at these places, in its order.

    Parameters
    ----------
    source
        One whose parts are a list.
    which
        Indices of parts.
    """

    def __init__(self, source: Source, which: Sequence[int]) -> None:
        super().__init__(source.dt, source.states, source.inputs, source.disturbances)
        self.source, self.which = source, tuple(sorted(which))

    def parts(self, history: int = 0) -> list[Part]:
        """Return the parts in order."""
        every = list(self.source.parts(history))
        return [every[i] for i in self.which]
