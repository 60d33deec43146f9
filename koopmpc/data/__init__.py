"""Episodes: excitation, collection, files."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.data.episodes import Snapshots as Snapshots
    from koopmpc.data.excitation import PRBS as PRBS
    from koopmpc.data.excitation import Chirp as Chirp
    from koopmpc.data.excitation import Multisine as Multisine
    from koopmpc.data.files.folder import Files as Files
    from koopmpc.data.partial import PartialEpisodes as PartialEpisodes
    from koopmpc.data.smoother import Mender as Mender
    from koopmpc.data.smoother import Smoother as Smoother
    from koopmpc.data.source import Source as Source
    from koopmpc.data.source import Stream as Stream
else:
    __getattr__, __dir__, __all__ = attach(__name__)
