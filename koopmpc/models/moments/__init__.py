"""Second moments of lifted snapshots, all that a linear regression needs of its data: `km.moments.second_moments`."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.models.moments.moments import Moments as Moments
    from koopmpc.models.moments.read import second_moments as second_moments
else:
    __getattr__, __dir__, __all__ = attach(__name__)
