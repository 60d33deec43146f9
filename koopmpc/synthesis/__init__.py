"""From data alone: models and controllers chosen by evidence."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.synthesis.choice import DesignRow as DesignRow
    from koopmpc.synthesis.designed import Design as Design
    from koopmpc.synthesis.designed import Evidence as Evidence
    from koopmpc.synthesis.designed import SavedDesign as SavedDesign
    from koopmpc.synthesis.loops.surrogates import Surrogate as Surrogate
    from koopmpc.synthesis.rates import ExpectedLoop as ExpectedLoop
    from koopmpc.synthesis.search.candidates import Candidate as Candidate
    from koopmpc.synthesis.search.leaderboard import LeaderboardRow as LeaderboardRow
    from koopmpc.synthesis.search.leaderboard import Selection as Selection
    from koopmpc.synthesis.search.recipe import Recipe as Recipe
    from koopmpc.synthesis.stabilise import Stabilised as Stabilised
    from koopmpc.synthesis.task import DesignTask as DesignTask
else:
    __getattr__, __dir__, __all__ = attach(__name__)
