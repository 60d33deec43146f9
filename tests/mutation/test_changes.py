"""Changes of a source file are those that are asked for, one at a time, and leave alone what is only said."""

import ast
import hashlib
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import koopmpc as km
from tests.compiler import find_compiler, needs_compiler
from tests.mutation.c_changes import c_mutants
from tests.mutation.changes import mutants
from tests.mutation.draw import drawn_of, list_changes, read_sources, room_of
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


@pytest.mark.parametrize(
    "name", ["estimate/gate.py", *slow(["control/lqr.py", "data/files/parquet.py", "loop/simulate.py"])]
)
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


C = """#include "a.h"  /* 1 < 2 */
#define TWO 2
enum { N = 3 };
static void f(const double *x, koopmpc_real *y) {
  double z[N] = {0}; /* what it holds */
  for (int i = 0; i < N; i++) y[i] -= *x * (double)*y; // and 1 + 1
  if (x && z[0] < 1e-9) return;
  g(y, "a < b");
}
"""
EXPECTED_OF_C = [
    "double z[N] = {1}; /* what it holds */",
    "for (int i = 1; i < N; i++) y[i] -= *x * (double)*y; // and 1 + 1",
    "for (int i = 0; i <= N; i++) y[i] -= *x * (double)*y; // and 1 + 1",
    "for (int i = 0; i < N; i++) y[i] += *x * (double)*y; // and 1 + 1",
    "for (int i = 0; i < N; i++) y[i] -= *x / (double)*y; // and 1 + 1",
    "for (int i = 0; i < N; i++) ; // and 1 + 1",
    "if (!(x && z[0] < 1e-9)) return;",
    "if (x || z[0] < 1e-9) return;",
    "if (x && z[1] < 1e-9) return;",
    ";",
]


def test_each_change_of_c_is_one_place_that_does_something() -> None:
    source = C.encode()
    assert sorted(mutant.lines(source)[1] for mutant in c_mutants("file.c", source)) == sorted(EXPECTED_OF_C)


def controllers():
    """Controllers whose C takes different files."""
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, problem.dt)
    asked = problem.cost, problem.limits, problem.horizon
    data = km.collect(plant, problem.training.x0, problem.training.excitation, episodes=20, steps=40, rng=0)
    yield km.KoopmanMPC(km.edmd(data, problem.lifting), *asked, estimator=km.LiftedDisturbance())
    yield km.BilinearMPC(km.bilinear_edmd(data, problem.lifting), *asked)
    yield km.LQR(km.edmd(data, problem.lifting), problem.cost)


@needs_compiler
@pytest.mark.slow
def test_changed_c_compiles(tmp_path: Path) -> None:
    """One of forty changes of each file, in a program that is compiled from it."""
    compiler = find_compiler()
    assert compiler is not None
    tried = Counter()
    for number, controller in enumerate(controllers()):
        folder = tmp_path / str(number)
        km.export(controller, folder)
        for path in folder.glob("koopmpc*.c"):
            own = Path(km.__file__).parent / "codegen/c" / path.name
            if not own.exists() or path.read_bytes() != own.read_bytes():
                continue
            source = path.read_bytes()
            for mutant in c_mutants(path.name, source):
                if hashlib.sha256(f"{number} {mutant}".encode()).digest()[0] < 6:
                    path.write_bytes(mutant.of(source))
                    done = subprocess.run(
                        [*compiler, "-fsyntax-only", "-w", path], cwd=folder, capture_output=True, text=True
                    )
                    assert not done.returncode, (mutant.lines(source), done.stderr)
                    tried[path.name] += 1
            path.write_bytes(source)
    assert sum(tried.values()) > 100


def test_other_seeds_draw_from_every_room_and_every_kind_of_change() -> None:
    sources = {
        name: text
        for name, text in read_sources(4).items()
        if "/cli/" in name or "/loop/" in name or name.endswith(".c")
    }
    everything = list_changes(sources)
    drawn = drawn_of(everything, 4, 60)
    rooms = Counter(room_of(mutant.file) for mutant in drawn)
    assert set(rooms) == {"cli", "loop", "c"}
    assert max(rooms.values()) - min(rooms.values()) <= 1
    assert len({mutant.operator for mutant in drawn}) >= 10
    assert not any("daqp/" in name for name in read_sources(4))


@pytest.mark.parametrize(
    "text", ["import nothing_of_this_name", "def test_it():\n    assert False", "def test_it():\n    pass"]
)
def test_a_change_that_breaks_an_import_is_noticed_as_one_that_fails_a_test(tmp_path: Path, text: str):
    path = tmp_path / "test_it.py"
    path.write_text(text)
    asked = json.dumps([[str(path)], 60, 1e9]) + "\n"
    command = [sys.executable, "-m", "tests.mutation.warm"]
    code, failed = json.loads(
        subprocess.run(command, input=asked, stdout=subprocess.PIPE, text=True, check=True).stdout
    )
    assert (code > 0, bool(failed)) == ((False, False) if "pass" in text else (True, True))
