"""Everything that touches Rerun; `km.recording.record_model` and `km.recording.run_episodes` beside what `km` has."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.views.recording.model import record_model as record_model
    from koopmpc.views.recording.reader import run_episodes as run_episodes
    from koopmpc.views.recording.recorder import RecorderOptions as RecorderOptions
    from koopmpc.views.recording.viewer import view as view
else:
    __getattr__, __dir__, __all__ = attach(__name__)
