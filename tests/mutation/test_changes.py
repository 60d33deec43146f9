"""Changes of a source file are those that are asked for, one at a time, and leave alone what is only said."""

import ast
from pathlib import Path

import pytest

from tests.mutation.__main__ import drawn_of
from tests.mutation.changes import mutants
from tests.tiers import slow

SOURCE = '''"""Words with 1 < 2."""
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy

def f(x: "1 n" = 3, *, on=True) -> float | None:
    """Return 1 + 1."""
    if x < 2 and not on:
        raise ValueError(f"{x + 1} is too small, ä")
    y = x - 1.5
    self.kept = y
    print(max(x, y), isinstance(x, int | float), zip(x, strict=True))
    return y
'''.encode()
HEAD = 'def f(x: "1 n" = {}, *, on={}) -> float | None:'
EXPECTED = [
    HEAD.format(4, True),
    HEAD.format(3, False),
    "if (not (x < 2 and (not on))):",
    "if (x < 2 or not on):",
    "if (x <= 2) and not on:",
    "if x < 3 and not on:",
    "if x < 2 and on:",
    "pass",
    "y = (x + 1.5)",
    "y = x - 3.0",
    "pass",
    "pass",
    "print(min(x, y), isinstance(x, int | float), zip(x, strict=True))",
    "return None",
]


def test_each_change_is_one_place_of_the_code_that_does_something() -> None:
    assert sorted(mutant.lines(SOURCE)[1] for mutant in mutants("file.py", SOURCE)) == sorted(EXPECTED)


def test_what_stands_in_for_a_divisor_of_zero_and_a_most_of_rounds_stay() -> None:
    source = b"s = np.where(size > 0, size, 1.0)\nt = np.where(size > 0, other, 1.0)\nsolve(max_iter=200, step=7)\n"
    found = [mutant.lines(source)[1] for mutant in mutants("file.py", source)]
    assert "s = np.where((size >= 0), size, 1.0)" in found
    assert "t = np.where(size > 0, other, 2.0)" in found
    assert "solve(max_iter=200, step=8)" in found
    assert not any(line.endswith("size, 2.0)") or "201" in line for line in found)


@pytest.mark.parametrize("name", ["control/lqr.py", *slow(["data/files/parquet.py", "loop/simulate.py"])])
def test_every_change_of_the_library_is_a_program_that_differs(name: str) -> None:
    source = (Path(__file__).parents[2] / "koopmpc" / name).read_bytes()
    whole, made = ast.dump(ast.parse(source)), list(mutants(name, source))
    assert len(made) > 20
    assert all(ast.dump(ast.parse(mutant.of(source))) != whole for mutant in made)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_change_stays_drawn_when_its_line_moves_and_when_others_come_and_go(seed: int) -> None:
    path, moved = Path(__file__).parents[2] / "koopmpc/control/lqr.py", b"def more(a):\n    return a + 2\n\n\n"

    def drawn(name: str, source: bytes, count: int) -> list[tuple[str, str]]:
        everything = [(mutant, "\n".join(mutant.lines(source))) for mutant in mutants(name, source)]
        return [mutant.lines(source) for mutant in drawn_of(everything, seed, count)]

    before, after = drawn("a.py", path.read_bytes(), 30), drawn("b.py", moved + path.read_bytes(), 33)
    assert len(set(before)) == 30
    assert set(before) <= set(after)
