"""Checks of arguments, with the messages about shapes, dtypes, NaN and definiteness."""

import inspect
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from itertools import chain
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base.errors import DataError, DefinitenessError, ShapeError

HUGE = 1e30  # a state or a reference beyond it is a bad one: its square overflows
_REAL = np.dtype(np.float64)
MOST = 2**31 - 1  # refuse a larger number of steps, episodes or tries: C and CasADi count no further
LARGEST = 1e100  # refuse a matrix of a model or a weight with a larger entry: products of three of them overflow

ByName = Mapping[str, float]
"""Name of a signal, with or without its unit → number."""


def array(
    value: ArrayLike | ByName,
    name: str,
    shape: Sequence[int | None] | None = None,
    *,
    finite: bool = True,
    infinite: bool = False,
) -> Float[np.ndarray, "..."]:
    """Return `value` as a new float64, C-contiguous array of the stated shape.

    Parameters
    ----------
    value
        Scalar, list or array.
    name
        What the user calls it; it opens every message.
    shape
        Expected shape; ``None`` in a place accepts any length there. ``None`` for the whole accepts any shape.
    finite
        Refuse NaN and infinities.
    infinite
        Accept ±inf (limits have them), but never NaN.

    Raises
    ------
    ShapeError
        The shape differs.
    DataError
        The value is no array of real numbers, or holds NaN or inf.
    """
    result = _to_floats(value, name)
    if shape is not None and shape != result.shape:
        fits = len(shape) == result.ndim and all(n is None or n == m for n, m in zip(shape, result.shape, strict=True))
        if not fits:
            raise ShapeError(f"{name} has shape {result.shape}, expected {_format_shape(shape)}")
    if finite and not np.isfinite(result).all():
        if not infinite:
            bad = np.argwhere(~np.isfinite(result))
            where = tuple(int(i) for i in bad[0])
            raise DataError(f"{name} holds {len(bad)} NaN or inf, the first at {where}; remove or repair them first")
        if np.isnan(result).any():
            raise DataError(f"{name} holds NaN; use ±inf where there is no limit")
    return result


def _to_floats(value: object, name: str) -> Float[np.ndarray, "..."]:
    try:
        raw = np.asarray(value)
        if np.iscomplexobj(raw):
            raise DataError(f"{name} is complex; pass real numbers")
        if raw.dtype.kind not in "biufO" or (raw.dtype.kind == "O" and any(v is None for v in raw.flat)):
            raise TypeError("numbers cannot be None or text")
        return np.array(raw, dtype=np.float64, order="C")
    except DataError:
        raise
    except (TypeError, ValueError, OverflowError) as error:  # an integer beyond 1e308 overflows
        raise DataError(
            f"{name} is not an array of numbers: got {type(value).__name__}, {error}; pass numbers of one shape"
        ) from error


def bounded(
    value: ArrayLike | ByName, name: str, shape: Sequence[int | None] | None = None
) -> Float[np.ndarray, "..."]:
    """Return `value` as `array` does, if none of its entries is beyond 1e100: an SVD of what overflows may not end."""
    result = array(value, name, shape)
    largest = float(np.abs(result).max(initial=0.0))
    if largest > LARGEST:
        raise DataError(f"{name} holds {largest:.3g}, so products with {name} overflow; choose other units")
    return result


@contextmanager
def explain_overflow() -> Generator[None]:
    """Raise a DataError for a decomposition of numbers that are not finite."""
    try:
        with np.errstate(all="ignore"):
            yield
    except np.linalg.LinAlgError as error:
        raise DataError(
            f"products of the model, the weights and the limits overflow ({error}); choose units in which they are "
            "nearer to one"
        ) from error


def start(x0: ArrayLike | None, nx: int) -> Float[np.ndarray, " nx"] | None:
    """Return the state (nx,) in which a run begins; None where it is not known."""
    return None if x0 is None else array(x0, "x0", (nx,))


def vector(value: ArrayLike | ByName, name: str, length: int, *, infinite: bool = False) -> Float[np.ndarray, " n"]:
    """Return `value` as a vector of `length`; a scalar is repeated."""
    result = array(value, name, infinite=infinite)
    if result.ndim == 0:
        return np.full(length, float(result))
    if result.shape != (length,):
        raise ShapeError(f"{name} has shape {result.shape}, expected ({length},) or a scalar")
    return result


def weight(
    value: ArrayLike | ByName, name: str, size: int | None = None, *, definite: bool = False
) -> Float[np.ndarray, "n n"]:
    """Return a symmetric positive (semi)definite matrix; a scalar or a 1-D `value` is a diagonal."""
    result = bounded(value, name)
    got = result.shape
    if result.ndim == 0:
        result = float(result) * np.eye(1 if size is None else size)
    elif result.ndim == 1:
        result = np.diag(result)
    if result.ndim != 2 or result.shape[0] != result.shape[1]:
        raise ShapeError(f"{name} has shape {got}, expected a square matrix or its diagonal")
    if size is not None and result.shape[0] != size:
        raise ShapeError(f"{name} has shape {got}, expected ({size}, {size}) or its diagonal")
    scale = float(np.abs(result).max(initial=0.0))
    if float(np.abs(result - result.T).max(initial=0.0)) > 1e-9 * max(scale, 1e-300):
        raise DefinitenessError(f"{name} is not symmetric; pass (M + Mᵀ)/2")
    result = 0.5 * (result + result.T)
    diagonal = np.abs(result.diagonal())
    unit = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    alike = result / np.outer(unit, unit)  # on a diagonal of ones rounding is the same in all units
    smallest = float(np.linalg.eigvalsh(alike).min(initial=np.inf))
    if smallest < -1e-9 * float(np.abs(alike).max(initial=0.0)) or (definite and smallest <= 0):
        least = float(np.linalg.eigvalsh(result).min())
        if definite and smallest >= -1e-9:
            raise DefinitenessError(f"{name} is not positive definite: its least eigenvalue is {least:.3g}; raise it")
        raise DefinitenessError(f"{name} is indefinite: its least eigenvalue is {least:.3g}; weights must be ⪰ 0")
    return result


def root(P: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the root of a weight, F with FᵀF = P ⪰ 0, by its eigenvalues in the units of `weight`.

    Eigenvalues below 0 are rounding.
    """
    size = np.sqrt(np.maximum(P.diagonal(), 0.0))
    live = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(P / np.outer(live, live))
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * size


def names(given: Sequence[str] | None, what: str, letter: str, size: int) -> tuple[str, ...]:
    """Return `size` names: those given, or ``x0, x1, …`` with this letter."""
    if given is None:
        return tuple(f"{letter}{i}" for i in range(size))
    given = texts(given, what)
    if len(given) != size:
        raise ShapeError(f"{what} has {len(given)} names, expected {size}; give one name each: got {tuple(given)}")
    return given


def distinct(*lists: Sequence[str]) -> None:
    """Raise a DataError where two states, inputs or disturbances have one name."""
    repeated = [name for name, n in Counter(chain(*lists)).items() if n > 1]
    if repeated:
        raise DataError(f"two states or inputs are named {repeated[0]!r}; rename one")


def texts(given: object, what: str) -> tuple[str, ...]:
    """Return a sequence of names as a tuple; refuse a single text, and entries of another type."""
    try:
        found = tuple(cast("Iterable[object]", given))
    except TypeError:  # an array without dimensions is an Iterable too
        found = (None,)
    if isinstance(given, str) or not all(isinstance(name, str) for name in found):
        raise DataError(f"{what} is {given!r}; pass a tuple of names")
    return cast("tuple[str, ...]", found)


def among(value: object, known: Iterable[str]) -> bool:
    """Return whether `value` is one of these words; an array or a list does not pass."""
    return isinstance(value, str) and value in known


def positive(value: float, name: str, unit: str = "") -> float:
    """Return `value` as a finite float above zero."""
    number = float(array(value, name, ()))
    if number <= 0:
        raise DataError(f"{name} is {number:g}{unit and ' ' + unit}; it must be above zero")
    return number


def count(value: int, name: str, least: int = 1) -> int:
    """Return `value` as an int from `least` to 2³¹ − 1."""
    if isinstance(value, bool) or not isinstance(cast(object, value), int | np.integer):
        raise DataError(f"{name} is {value!r}; pass a whole number")
    if value < least:
        told = f"{value}" if value > -LARGEST else "below -1e100"  # Python writes no integer of 4,301 digits
        raise DataError(f"{name} is {told}; it must be at least {least}")
    if value > MOST:
        told = f"{value:.3g}" if value < LARGEST else "beyond 1e100"  # an integer beyond 1e308 overflows
        raise DataError(f"{name} is {told}; it must be at most {MOST}")
    return int(value)


def article(value: object) -> str:
    """Return the name of the value's class with its article: a dict, an int."""
    return _article(type(value).__name__)


def _article(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOaeio' else 'a'} {name}"


def members(value: object, name: str, needed: Sequence[str], advice: str) -> None:
    """Raise where `value` lacks an attribute or a method that it needs, or is a class that has them."""
    if isinstance(value, type):
        raise DataError(f"{name} is the class {value.__name__}; pass one that was made of it")
    missing = [member for member in needed if not hasattr(value, member)]
    if missing:
        raise DataError(f"{name} is {article(value)} and has no {', '.join(missing)}; {advice}")


def kind(value: object, name: str, wanted: type | tuple[type, ...], advice: str) -> None:
    """Raise where `value` is of another class than `wanted`."""
    if not isinstance(value, wanted):
        classes = wanted if isinstance(wanted, tuple) else (wanted,)
        names = " or ".join(dict.fromkeys(_article(each.__name__) for each in classes))  # NumPy has a bool, too
        raise DataError(f"{name} is {article(value)}, expected {names}; {advice}")


def takes(function: Callable[..., object], name: str, count: int, advice: str) -> None:
    """Raise where a function cannot be called with `count` arguments; one without a signature passes."""
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        raise DataError(f"{name} does not take {count} arguments; {advice}") from None
    except ValueError:  # built in C
        return


def refuse_crossed(
    low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], name: str, signals: Sequence[str] = ()
) -> None:
    """Raise where a lower limit stands above its upper one; `signals` name the entries, where they are known."""
    bad = np.flatnonzero(low > high)
    if bad.size:
        i = int(bad[0])
        place = f"for {signals[i]}" if signals else f"at index {i}"
        raise DataError(f"{name} limits cross {place}: lower {low[i]:g} is above upper {high[i]:g}; swap or widen them")


def reference_rows(reference: Float[np.ndarray, "..."], N: int, nr: int, first: int = 0) -> Float[np.ndarray, "N1 nr"]:
    """Return rows first … first + N of a reference (nr,) that is held or (M, nr) whose last row is repeated.

    What is beyond 1e30 comes back as NaN, for its square may overflow.
    """
    R = array(reference, "reference", finite=False)
    if R.shape[-1:] != (nr,) or R.ndim > 2 or len(R) == 0:
        given = R.shape[-1] if R.ndim else 1
        fewer = "; to track fewer outputs pass Cost(of=km.State(…), …)" if 0 < given < nr else ""
        raise ShapeError(
            f"reference has shape {R.shape}, expected ({nr},), or rows of {nr} for steps k … k+{first + N}{fewer}"
        )
    R = np.where(np.abs(R) < HUGE, R, np.nan).reshape(-1, nr)
    return np.ascontiguousarray(R[np.minimum(np.arange(first, first + N + 1), len(R) - 1)])


def generator(rng: np.random.Generator | int) -> np.random.Generator:
    """Return a Generator; an int is a seed."""
    if isinstance(rng, np.random.Generator):
        return rng
    if isinstance(rng, bool) or not isinstance(cast(object, rng), int | np.integer) or rng < 0:
        raise DataError(f"rng is {rng!r}; pass a seed (a whole number from 0 on) or a numpy Generator")
    return np.random.default_rng(rng)


def _format_shape(shape: Sequence[int | None]) -> str:
    sizes = ["any" if n is None else str(n) for n in shape]
    return "(" + ", ".join(sizes) + (",)" if len(sizes) == 1 else ")")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ``", did you mean 'pendulum'?"`` for the known name nearest to `name`; empty where none is near."""
    close = get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f", did you mean {close[0]!r}?" if close else ""


def numbers(value: ArrayLike | None, name: str) -> Float[np.ndarray, "..."]:
    """Return `value` as float64, itself where it is one already, for this is the control path."""
    try:
        if value is not None and getattr(value, "dtype", _REAL).kind != "c":  # numpy would only warn of these
            return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pass
    return array(value, name, finite=False)  # pyright: ignore[reportArgumentType]


def check_named(given: Any, what: str, *, infinite: bool = False) -> dict[str, float]:
    """Return the numbers by name; refuse names of another type than text, and values of another type than number."""
    wrong = next((name for name in given if not isinstance(name, str)), None)
    if wrong is not None or not given:
        raise DataError(f"{what} is {given!r}; pass names of signals with their numbers, as {{'theta': 10}}")
    return {name: float(array(value, f"{what}[{name!r}]", (), infinite=infinite)) for name, value in given.items()}


def list_values(given: Any) -> Any:
    """Return the numbers alone."""
    return list(cast("Mapping[str, float]", given).values()) if isinstance(given, Mapping) else given


def order_by_name(given: Any, what: str, names: Sequence[str], omitted: float | None) -> Float[np.ndarray, " n"]:
    """Return the numbers in the order of the names of a plant, whose units may be left out.

    `omitted` is the number of a name that is not given; None where each must be.
    """
    values: dict[int, float] = {}
    for name, value in cast("Mapping[str, float]", given).items():
        at = [i for i, known in enumerate(names) if known == name]
        at = at or [i for i, known in enumerate(names) if _stem(known) == name.strip()]
        if len(at) != 1 or at[0] in values:
            wrong = "is given twice" if len(at) == 1 else "fits two" if at else "is not there"
            raise DataError(f"{what} names {name!r}, which {wrong}; the names are {', '.join(names)}")
        values[at[0]] = value
    if omitted is None and len(values) < len(names):
        missing = ", ".join(name for i, name in enumerate(names) if i not in values)
        raise DataError(f"{what} has no value for {missing}; name each of {', '.join(names)}")
    return np.array([values.get(i, omitted) for i in range(len(names))], dtype=np.float64)


def order_entries(given: Mapping[str, Any], what: str, names: Sequence[str]) -> list[Any]:
    """Return entries of any kind in the order of the names of a plant, None for an omitted one; see `order_by_name`."""
    entries = list(given.values())
    place = order_by_name({name: float(i) for i, name in enumerate(given)}, what, names, np.nan)
    return [None if np.isnan(at) else entries[int(at)] for at in place]


def _stem(name: str) -> str:
    """Return a name without its unit."""
    return name.partition("[")[0].strip()
