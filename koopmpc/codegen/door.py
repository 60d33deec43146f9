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


def _list_fields(real: type) -> tuple[tuple[str, type], ...]:
    """Return the fields of a call's arguments and results."""
    pointer, whole = ctypes.c_void_p, ctypes.c_int
    return (
        *(("state", pointer), ("y", pointer), ("reference", Rows), ("applied", pointer), ("w", Rows), ("u", pointer)),
        *((name, whole) for name in ("status", "fallback", "iterations")),
        *(("slack", real), ("refused", whole), ("gap", real), ("bounds", pointer)),
    )


class Frame(ctypes.Structure):
    """The arguments and results of a call, as in C."""

    _fields_ = _list_fields(ctypes.c_double)


class SingleFrame(ctypes.Structure):
    """A `Frame` in single precision."""

    _fields_ = _list_fields(ctypes.c_float)


_BOUNDS = ("u_low", "u_high", "du_low", "du_high", "x_low", "x_high")


_ROWS = np.dtype([("values", np.uintp), ("count", np.intc)], align=True)
_BOUND_ROWS = np.dtype([(name, _ROWS) for name in _BOUNDS], align=True)  # as in C


class BoundPage:
    """The limits of consecutive steps as C reads them: a struct for each, all of which point into one table.

    Parameters
    ----------
    first, steps
        The first step, and for how many there are limits.
    arrays
        Rows of each part from step `first` on, in the order of the struct.
    ahead
        Rows that a step reads.
    """

    def __init__(self, first: int, arrays: list[np.ndarray], ahead: int, steps: int) -> None:
        self.first, self.steps, self._arrays = first, steps, arrays  # C holds pointers only
        self.of: object = None  # the limits that these are
        self._table = np.zeros(steps, _BOUND_ROWS)
        for name, array in zip(_BOUNDS, arrays, strict=True):
            self._table[name]["values"] = array.ctypes.data + np.arange(steps) * array.strides[0]
            self._table[name]["count"] = ahead
        self._address, self._size = int(self._table.ctypes.data), _BOUND_ROWS.itemsize

    def at(self, k: int) -> int:
        """Return the address of the limits of step k."""
        return self._address + (k - self.first) * self._size


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
