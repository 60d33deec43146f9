"""The type hook of the tests: every function and dataclass of koopmpc checks its arguments, its result and all array shapes.

`hook()` must come before the first import of koopmpc. It is jaxtyping's import hook with beartype, with two savings that
check the same: jaxtyping binds and checks the arguments of every call twice, here beartype checks them once, in a context
of shapes of the call's own; and a function inside a function is not compiled anew each time that its maker is called.
Together they halve the time of the typed tests, and coverage has fewer calls to trace.
"""

import dataclasses
import functools
import inspect
import sys
import typing
from collections.abc import Callable
from types import FunctionType
from typing import Any

import jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype

# Ints pass for floats; what does not fit is a TypeError, as jaxtyping's own errors are.
beartyped = beartype(conf=BeartypeConf(is_pep484_tower=True, violation_type=jaxtyping.TypeCheckError))

_jaxtyped = jaxtyping.jaxtyped
_SHAPES = _jaxtyped(
    "context"
)  # within it, a letter in the shapes has one size; it may be entered again while it is open
_typed_before: dict[
    tuple[Any, str], tuple[FunctionType, FunctionType]
] = {}  # inner functions and what beartype made of them


def hook() -> None:
    """Let every module of koopmpc that is imported from now on check its types."""
    from numpy._typing._array_like import _Buffer  # which the lowest numpy that is allowed has not
    from numpy._typing._nested_sequence import _NestedSequence

    _NestedSequence.register(tuple)  # numpy takes a tuple as ArrayLike, though it has no __reversed__
    _Buffer.register(np.ndarray)  # an array is ArrayLike at the first try in Python 3.11 too, as in 3.12
    if sys.version_info < (3, 12):  # later versions ask a protocol once for its attributes, too
        typing._get_protocol_attrs = functools.cache(typing._get_protocol_attrs)
    jaxtyping.jaxtyped = _checked  # the decorator that the import hook writes above each function and class
    jaxtyping.install_import_hook("koopmpc", "tests.typecheck.beartyped")


def _checked(what: Any = None, *, typechecker: Any = None) -> Any:
    """Return a function or dataclass that checks its types; take the arguments that jaxtyping.jaxtyped takes."""
    if what is None:
        return _checked
    if what == "context":
        return _SHAPES
    if inspect.isclass(what):
        init = vars(what).get("__init__")
        if dataclasses.is_dataclass(what) and init is not None and not hasattr(init, "_checked"):
            what.__init__ = _checked(init)
        return what
    if inspect.isgeneratorfunction(what) or any(isinstance(hint, str) for hint in what.__annotations__.values()):
        made = _jaxtyped(what, typechecker=beartyped)  # it leaves what is yielded and names in quotes unchecked
    else:
        typed = _typed(what)

        @functools.wraps(what)
        def made(*args: Any, **kwargs: Any) -> Any:
            __tracebackhide__ = True
            with _SHAPES:
                return typed(*args, **kwargs)

    made._checked = True
    return made


def _typed(function: FunctionType) -> Callable[..., Any]:
    """Return what beartype makes of `function`; an inner function that was seen before takes the place of its twin."""
    if "<locals>" not in function.__qualname__:
        return beartyped(function)
    key = function.__code__, repr(function.__annotations__)
    if key not in _typed_before:
        _typed_before[key] = function, beartyped(function)
    twin, typed = _typed_before[key]
    if typed is twin:  # nothing to check
        return function
    # beartype's function finds the one that it calls among its keyword defaults
    again = FunctionType(typed.__code__, typed.__globals__, typed.__name__, typed.__defaults__, typed.__closure__)
    again.__kwdefaults__ = {name: function if value is twin else value for name, value in typed.__kwdefaults__.items()}
    assert function in again.__kwdefaults__.values(), "beartype keeps the function elsewhere now"
    return again
