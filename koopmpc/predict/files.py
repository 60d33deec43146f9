"""Values as .npz files: arrays as they are, everything else as JSON; nothing is pickled, and no code is run."""

import json
from pathlib import Path
from typing import TypeVar, cast

import numpy as np

from koopmpc import checks
from koopmpc.errors import LogError
from koopmpc.values import Arrays, Value, from_data, to_data

V = TypeVar("V", bound=Value)
_FORMAT = "koopmpc-1"


def save_value(value: Value, path: str | Path) -> None:
    """Write `value` as .npz: float arrays as they are, everything else as JSON; nothing is pickled.

    Raises
    ------
    LogError
        The path cannot be written.
    """
    arrays: Arrays = {}
    tree = {"format": _FORMAT, "value": to_data(value, arrays)}
    text = np.frombuffer(json.dumps(tree).encode(), dtype=np.uint8)
    with checks.writing(path) as file:
        np.savez_compressed(file, allow_pickle=False, tree=text, **arrays)


def load_value(path: str | Path, *kinds: type[V]) -> V:
    """Read a Value of one of these kinds that `save_value` wrote.

    Raises
    ------
    LogError
        The file is missing, a folder, damaged, or holds something else.
    """
    wanted = " or ".join(kind.__name__ for kind in kinds)
    advice = f"pass the .npz of a saved {wanted}"
    source = checks.existing(path, advice)
    try:
        arrays = checks.read_arrays(source, ("tree",))
        tree = cast("object", json.loads(arrays.pop("tree").tobytes().decode()))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise LogError(f"{path} is damaged: the text in it cannot be read; {advice}") from error
    except (OSError, ValueError) as error:
        raise LogError(f"{path} is no file that koopmpc saved, or is damaged: {error}; {advice}") from error
    node = cast("dict[str, object]", tree) if isinstance(tree, dict) else {}
    if node.get("format") != _FORMAT:
        raise LogError(f"{path} is no {_FORMAT} file; save it again with this version")
    try:
        value = from_data(node.get("value"), arrays)
    except LogError as error:
        raise LogError(f"{path}: {error}") from error
    except Exception as error:  # a class met something that it was never meant to hold
        raise LogError(f"{path} is damaged, or was made by hand: {error}") from error
    if not isinstance(value, kinds):
        raise LogError(f"{path} holds a {type(value).__name__}, not a {wanted}")
    return value
