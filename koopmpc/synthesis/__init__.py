"""From data alone: models and controllers chosen by evidence."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.synthesis.asked import DesignTask as DesignTask
    from koopmpc.synthesis.candidates import Candidate as Candidate
    from koopmpc.synthesis.candidates import Recipe as Recipe
    from koopmpc.synthesis.designed import Design as Design
    from koopmpc.synthesis.designed import DesignRow as DesignRow
    from koopmpc.synthesis.designed import Evidence as Evidence
    from koopmpc.synthesis.designed import ExpectedLoop as ExpectedLoop
    from koopmpc.synthesis.designed import SavedDesign as SavedDesign
    from koopmpc.synthesis.leaderboard import LeaderboardRow as LeaderboardRow
    from koopmpc.synthesis.leaderboard import Selection as Selection
    from koopmpc.synthesis.stabilise import Stabilised as Stabilised
    from koopmpc.synthesis.surrogates import Surrogate as Surrogate
else:
    __getattr__, __dir__, __all__ = attach(__name__)
