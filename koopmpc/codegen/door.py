"""The structures that Python passes to c/door.c, which defines the same ones."""

import ctypes

import numpy as np
from jaxtyping import Float


def point_to(array: np.ndarray | None) -> ctypes.c_void_p | None:
    """Return the address of an array's first number, for C; None, C's null pointer, for None."""
    return None if array is None else ctypes.c_void_p(array.ctypes.data)


# ctypes is fastest with one pointer as argument: a call passes one structure.
class Rows(ctypes.Structure):
    """Rows of a preview: their address and their number."""

    _fields_ = (("values", ctypes.c_void_p), ("count", ctypes.c_int))


_FIELDS = (
    ("state", ctypes.c_void_p),
    ("y", ctypes.c_void_p),
    ("reference", Rows),
    ("applied", ctypes.c_void_p),
    ("w", Rows),
    ("u", ctypes.c_void_p),
    ("status", ctypes.c_int),
    ("fallback", ctypes.c_int),
    ("iterations", ctypes.c_int),
)


class Frame(ctypes.Structure):
    """The arguments and results of a call, as in C."""

    _fields_ = (*_FIELDS, ("slack", ctypes.c_double), ("refused", ctypes.c_int), ("gap", ctypes.c_double))


class SingleFrame(ctypes.Structure):
    """A `Frame` in single precision."""

    _fields_ = (*_FIELDS, ("slack", ctypes.c_float), ("refused", ctypes.c_int), ("gap", ctypes.c_float))


_BOUNDS = ("u_low", "u_high", "du_low", "du_high", "x_low", "x_high")


class BoundRows(ctypes.Structure):
    """Rows of limits, as in C."""

    _fields_ = tuple((name, Rows) for name in _BOUNDS)


class WholeRun(ctypes.Structure):
    """The arguments and results of a whole run, as in C."""

    _fields_ = (
        ("steps", ctypes.c_long),
        *((name, ctypes.c_int) for name in ("nx", "ny", "preview", "measured")),
        *((name, ctypes.c_void_p) for name in ("step", "measure", "rows", "W", "X", "Y", "U")),
        *((name, ctypes.c_void_p) for name in ("slack", "times", "reports")),
    )


class AbreastStep(ctypes.Structure):
    """The arguments of a step of many controllers, as in C."""

    _fields_ = (
        *((name, ctypes.c_long) for name in ("count", "size", "stride")),
        *((name, ctypes.c_int) for name in ("first", "measured")),
        *((name, ctypes.c_void_p) for name in ("which", "states", "Y", "rows", "W", "U", "reports")),
    )


def gather_run(
    code: ctypes.CDLL,
    steps: int,
    arrays: dict[str, np.ndarray],
    W: Float[np.ndarray, "wrows nw"] | None,
    *,
    preview: bool,
) -> WholeRun:
    """Return the arguments of a whole run; the structure keeps no reference to the arrays."""
    whole = WholeRun(steps, arrays["X"].shape[-1], arrays["Y"].shape[-1], preview, W is not None)
    for name, routine in (("step", code.plant_step), ("measure", code.plant_measure)):
        setattr(whole, name, ctypes.cast(routine, ctypes.c_void_p))
    for name, array in ({"W": W} | arrays if W is not None else arrays).items():
        assert array.flags.c_contiguous, "machine code reads contiguous arrays"
        setattr(whole, name, array.ctypes.data)
    return whole
