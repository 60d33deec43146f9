"""Columns of a table whose cells are not all numbers: labels, which are left alone, or numbers with a broken cell."""

from decimal import Decimal
from numbers import Real

import numpy as np

from koopmpc.errors import DataError


def numbers(column: np.ndarray, name: str, where: str) -> np.ndarray:
    """Return a column of objects as floats, None as NaN; a column of text as it is, if it is no spoilt one.

    Parameters
    ----------
    column
        (rows,) of any kind.
    name, where
        For messages: the column, and its file.

    Raises
    ------
    DataError
        Half of the cells or more are numbers, written with a decimal comma or as complex ones perhaps, and
        another is none: the column would be lost for one cell.
    """
    if column.dtype.kind != "O":
        return column
    present = [cell for cell in column if cell is not None]
    if present and all(isinstance(cell, Real | Decimal) for cell in present):
        return np.array([np.nan if cell is None else float(cell) for cell in column])
    like = sum(map(_like_a_number, present))
    if like == 0 or 2 * like < len(present):
        return column
    row, cell = next(
        (i, cell) for i, cell in enumerate(column) if cell is not None and not _is_a_number(cell)
    )
    raise DataError(
        f"{where}: {name!r} holds {str(cell)!r} in row {row + 1}, which is no real number; repair the cell, leave it "
        "empty where the value is missing, or name the columns to use: pass states= and inputs="
    )


def _is_a_number(cell: object) -> bool:
    try:
        float(str(cell))
    except ValueError:
        return False
    return True


def _like_a_number(cell: object) -> bool:
    try:
        complex(str(cell).strip().replace(",", "."))
    except ValueError:
        return False
    return True
