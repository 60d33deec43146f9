"""Changes of a source file are those that are asked for, one at a time, and leave alone what is only said."""

import ast
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

import koopmpc as km
from tests.compiler import find_compiler, needs_compiler
from tests.mutation.__main__ import Copy, Warm, interval
from tests.mutation.c_changes import c_mutants
from tests.mutation.changes import mutants
from tests.mutation.draw import drawn_of, list_changes, read_sources, room_of
from tests.mutation.switched import switched
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
    "name", ["estimate/gate.py", *slow(["control/kinds/lqr.py", "data/files/parquet.py", "loop/simulate.py"])]
)
def test_every_change_of_the_library_is_a_program_that_differs(name: str) -> None:
    source = (Path(__file__).parents[2] / "koopmpc" / name).read_bytes()
    whole, made = ast.dump(ast.parse(source)), list(mutants(name, source))
    assert len(made) > 20
    assert all(ast.dump(ast.parse(mutant.of(source))) != whole for mutant in made)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_change_stays_drawn_when_its_line_moves_and_when_others_come_and_go(seed: int) -> None:
    path, moved = Path(__file__).parents[2] / "koopmpc/control/kinds/lqr.py", b"def more(a):\n    return a + 2\n\n\n"

    def drawn(name: str, source: bytes, count: int) -> list[tuple[str, str]]:
        everything = [(mutant, "\n".join(mutant.lines(source))) for mutant in mutants(name, source)]
        return [mutant.lines(source) for mutant in drawn_of(everything, seed, count)]

    # the three changes of `more` are of three operators, whose later changes then come a turn of all operators later
    turn = len({mutant.operator for mutant in mutants("a.py", path.read_bytes())})
    before, after = drawn("a.py", path.read_bytes(), 30), drawn("b.py", moved + path.read_bytes(), 33 + turn)
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
        if "/apps/" in name or "/loop/" in name or name.endswith(".c")
    }
    everything = list_changes(sources)
    drawn = drawn_of(everything, 4, 60)
    rooms = Counter(room_of(mutant.file) for mutant in drawn)
    assert set(rooms) == {"apps", "loop", "c"}
    assert max(rooms.values()) - min(rooms.values()) <= 1
    assert len({mutant.operator for mutant in drawn}) >= 10
    assert not any("daqp/" in name for name in read_sources(4))


def test_each_change_is_made_where_it_is_on_and_only_there() -> None:
    named = {str(i): mutant for i, mutant in enumerate(mutants("file.py", SOURCE))}
    for name, mutant in named.items():
        text, held, outside = switched(SOURCE, {name: mutant}, "file.py")
        assert held == {name}
        assert (outside == {name}) == mutant.lines(SOURCE)[1].startswith("def")
        for on in (name, ""):
            expected = ast.parse(mutant.of(SOURCE) if on else SOURCE)
            assert ast.unparse(Chosen(on).visit(ast.parse(text))) == ast.unparse(expected)


class Chosen(ast.NodeTransformer):
    """Leaves of a source with switches what one change makes of it, without what notes that a function is entered."""

    def __init__(self, on: str) -> None:
        self._on = on

    def _choice(self, node: ast.If | ast.IfExp) -> Any:
        if not ast.unparse(node.test).startswith("is_on("):
            return self.generic_visit(node)
        return node.body if ast.unparse(node.test) == f"is_on('{self._on}')" else node.orelse

    visit_If = visit_IfExp = _choice

    def visit_Expr(self, node: ast.Expr) -> Any:
        return None if ast.unparse(node).startswith("is_on(") else self.generic_visit(node)


TESTS = """
import os, subprocess, sys, pytest

def test_it():
    assert not is_on("here")

def test_a_process_that_it_starts():
    subprocess.run([sys.executable, "-c", "assert not is_on('there')"], check=True)

def test_it_ends():
    while is_on("endless"):
        pass

def test_it_starts_clean():
    assert "left" not in os.environ
    os.environ["left"] = "here"
"""


@pytest.mark.slow
def test_tests_that_were_collected_once_meet_each_change_in_a_child_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(TESTS)
    shutil.copy(Path(__file__).parent / "switch.py", tmp_path / "sitecustomize.py")
    path = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])
    their_end, asks = os.pipe()
    answers, our_end = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.mutation.warm", str(their_end), str(our_end), "test_it.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.DEVNULL,
        pass_fds=(their_end, our_end),
    )
    os.close(their_end)
    os.close(our_end)
    tests = [[f"test_it.py::{name}", -5.9] for name in re.findall(r"def (test_\w+)", TESTS)]
    with os.fdopen(answers) as lines, os.fdopen(asks, "w") as requests:
        assert json.loads(lines.readline()) == ["ready"]
        for change, codes, name in [
            ("here", {1}, "test_it"),
            ("there", {1}, "test_a_process_that_it_starts"),
            ("endless", {-signal.SIGXCPU, -signal.SIGALRM}, "test_it_ends"),  # a busy machine gives it no second
            ("nothing", {0}, ""),
            ("nothing", {0}, ""),
        ]:
            requests.write(json.dumps([change, tests]) + "\n")
            requests.flush()
            code, met = json.loads(lines.readline())
            assert (code in codes, met) == (True, f"test_it.py::{name}" if name else "")
    assert process.wait() == 0


def test_a_change_that_breaks_an_import_leaves_nothing_to_ask(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text("import nothing_of_this_name")
    copy = Copy.__new__(Copy)
    copy.folder = tmp_path
    shutil.copy(Path(__file__).parent / "switch.py", tmp_path / "sitecustomize.py")
    with closing(Warm(copy, ["test_it.py"], "any")) as warm:
        assert warm.run("any", [("test_it.py::test_it", 0.1)]) == ("killed", "")


def test_an_interval_is_that_of_wilson() -> None:
    assert interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)  # Newcombe (1998), table I, method 3
    assert interval(20, 20)[1] == pytest.approx(1)
