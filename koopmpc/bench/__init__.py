"""Problems, the sweep over controllers, the table."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.bench.library import list_problems as list_problems
else:
    __getattr__, __dir__, __all__ = attach(__name__, {"library": "list_problems"})
