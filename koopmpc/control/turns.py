"""One thread at a time: a controller that two threads enter at once says so, instead of corrupting what both write.

Its token is a list of one element: `pop` and `append` are atomic, take 20 ns each, and a copy has a token of its own.
"""

from collections.abc import Callable
from functools import wraps
from threading import get_ident
from typing import Any, TypeVar, cast

from koopmpc.errors import ThreadError

TurnTaker = TypeVar("TurnTaker", bound=Callable[..., Any])
Token = list[int]


def token() -> Token:
    """Return the token of a new controller."""
    return [0]


def busy(controller: object) -> ThreadError:
    """Return the error of a thread that found another one inside."""
    name = type(controller).__name__
    return ThreadError(f"two threads entered one {name} at once; give each thread a copy: copy.copy(controller)")


def alone(method: TurnTaker) -> TurnTaker:
    """Return the method so that it raises ThreadError while another thread is in a method of the same object.

    Methods of one thread may call each other.
    """

    @wraps(method)
    def entered(self: Any, *arguments: Any, **options: Any) -> Any:
        me = get_ident()
        if self._inside == me:
            return method(self, *arguments, **options)
        try:
            held = self._token.pop()
        except IndexError:
            raise busy(self) from None
        self._inside = me
        try:
            return method(self, *arguments, **options)
        finally:
            self._inside = 0
            self._token.append(held)

    return cast("TurnTaker", entered)
