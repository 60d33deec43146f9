"""Which changes a seed draws: seed 0 those of tests/mutation/drawn.txt, any other evenly over rooms and operators."""

import hashlib
from itertools import zip_longest
from pathlib import Path

from tests.mutation.c_changes import c_mutants
from tests.mutation.changes import Mutant, mutants

HOME = Path(__file__).parents[2]
FIRST = ("control", "models", "estimate", "loop", "data")  # the rooms of seed 0


def read_sources(seed: int) -> dict[str, bytes]:
    """Return the files from which the seed draws: for seed 0 five rooms, for others all of koopmpc and its C."""
    rooms = [HOME / "koopmpc" / room for room in FIRST] if seed == 0 else [HOME / "koopmpc"]
    files = {path for room in rooms for path in room.rglob("*.py")}
    if seed:
        files |= {*(HOME / "koopmpc/codegen/c").glob("*.[ch]")}  # not the solver of others in codegen/daqp
    return {str(path.relative_to(HOME)): path.read_bytes() for path in sorted(files)}


def list_changes(sources: dict[str, bytes]) -> list[tuple[Mutant, str]]:
    """Return every change of these files, each with what names it: its line before and after."""
    found = [
        m for name, source in sources.items() for m in (mutants if name.endswith(".py") else c_mutants)(name, source)
    ]
    return [(mutant, "\n".join(mutant.lines(sources[mutant.file]))) for mutant in found]


def name_of(mutant: Mutant, source: bytes) -> str:
    """Return what names a change, wherever its line moves: ten digits of a hash of its line before and after."""
    return hashlib.sha256("\n".join(mutant.lines(source)).encode()).hexdigest()[:10]


def room_of(file: str) -> str:
    """Return the room of a file: a folder of koopmpc, "c", or "koopmpc" for the files on top."""
    parts = file.split("/")
    return "c" if file.endswith((".c", ".h")) else parts[1] if len(parts) > 2 else parts[0]


def drawn_of(everything: list[tuple[Mutant, str]], seed: int, count: int) -> list[Mutant]:
    """Return the changes that the seed draws from all, each given with what names it: its line before and after.

    Each room gives as many, and within a room each operator: a room or operator with few changes leaves its places to the others.
    """
    first = (HOME / "tests/mutation/drawn.txt").read_text().split() if seed == 0 else []
    named: dict[str, Mutant] = {}
    for mutant, text in everything:
        named.setdefault(hashlib.sha256(text.encode()).hexdigest()[:10], mutant)
    rest = sorted(named, key=lambda name: hashlib.sha256(f"{seed} {name}".encode()).digest())
    if seed:
        rooms: dict[str, dict[str, list[str]]] = {}
        for name in rest:
            mutant = named[name]
            rooms.setdefault(room_of(mutant.file), {}).setdefault(mutant.operator, []).append(name)
        rest = _take_turns([_take_turns(list(operators.values())) for operators in rooms.values()])
    return [named[name] for name in dict.fromkeys([name for name in first if name in named] + rest)][:count]


def _take_turns(lists: list[list[str]]) -> list[str]:
    """Return the first of each list, then the second of each, and so on."""
    return [name for turn in zip_longest(*lists) for name in turn if name is not None]
