"""Mutation testing, run by `make mutants`: small changes of the library, of which the tests must notice each.

Changes are drawn from the rooms that must not be wrong: comparisons swapped, + for −, other constants, statements
and checks left out, conditions turned round, None returned. A seed draws them by their text: a change stays drawn while
its line stands, wherever it moves and whatever changes around it. The 200 changes that were drawn first, when the tests
knew nothing of them, stand in tests/mutation/drawn.txt and are seed 0; each that is gone is replaced by another. Since
then tests were written for those that survived: another seed says what share of all changes the tests notice. Each is made in a copy of the library, and the tests that
run the changed line are run until one fails. Which tests run which line, and how long each takes, is measured once.
A change that no test notices survives, and is printed. Those that change nothing that could be noticed stand, with the
reason, in tests/mutation/equivalent.txt.
"""

import argparse
import compileall
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from py_compile import PycInvalidationMode
from queue import SimpleQueue

from coverage import CoverageData

from tests.mutation.changes import Mutant, mutants

HOME = Path(__file__).parents[2]
ROOMS = ("control", "identify", "estimate", "loop", "data", "predict")
MORE = ("tests/faults", "tests/synthesis", "tests/validate", "tests/codegen")  # tests elsewhere that run these rooms
COPIED = ("koopmpc", "problems", "tests", "docs", "pyproject.toml", "README.md", "CHANGELOG.md", "Makefile")
ENOUGH = 30.0  # seconds of processor time of tests that a change has to outlive
FEW = 5  # tests that may fail before anything is changed, as those of real time on a machine that is busy; none counts
PYTEST = (sys.executable, "-m", "pytest", "-q", "--benchmark-disable", "-p", "no:cacheprovider")


def copied(folder: Path) -> Path:
    """Copy what the tests need into the folder, and return it."""
    for name in COPIED:
        if (HOME / name).is_dir():
            shutil.copytree(HOME / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.rrd"))
        else:
            shutil.copy(HOME / name, folder / name)
    for name in ("koopmpc", "tests"):  # by content: a changed file is never taken for the one that was compiled
        compileall.compile_dir(folder / name, quiet=1, invalidation_mode=PycInvalidationMode.CHECKED_HASH)
    return folder


def environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "KOOPMPC_TESTS": ""}


Map = dict[str, dict[int, list[str]]]


def measured(folder: Path, workers: int) -> tuple[Map, dict[str, float]]:
    """Run the tests of the rooms; return which of them run each line of each file, and the seconds of each.

    Raises
    ------
    SystemExit
        More than a few tests fail before anything is changed.
    """
    where = [f"tests/{room}" for room in ROOMS] + list(MORE)
    done = subprocess.run(
        [*PYTEST, "-n", str(workers), "--dist", "loadfile", "-p", "tests.mutation.seconds", *where]
        + [f"--cov=koopmpc/{room}" for room in ROOMS]
        + ["--cov-context=test", "--cov-report=", "--cov-fail-under=0"],
        cwd=folder,
        env=environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if done.returncode > 1 or len(failed) > FEW:
        raise SystemExit(f"the tests fail without any change:\n{done.stdout[-3000:]}")
    sys.stdout.write("".join(f"left out, for it fails without any change: {line}\n" for line in failed))
    data, found = CoverageData(str(folder / ".coverage")), {}
    data.read()
    for file in data.measured_files():
        lines = data.contexts_by_lineno(file)
        name = str(Path(file).relative_to(folder))
        found[name] = {n: sorted({c.rsplit("|", 1)[0] for c in held if c}) for n, held in lines.items()}
    return found, json.loads((folder / "seconds.json").read_text())


def tests_of(mutant: Mutant, covering: Map, seconds: dict[str, float]) -> list[str]:
    """Return the tests that run this line, as many as take ENOUGH.

    The file of tests that has the name of the changed one comes first, then those of its room, the short ones first.
    """
    lines, at = covering.get(mutant.file, {}), range(mutant.first, mutant.last + 1)
    some = {test for n in at for test in lines.get(n, ()) if test in seconds}
    if not some and any(n in lines for n in at):  # it runs when it is imported
        some = {test for tests in lines.values() for test in tests if test in seconds}
    above = [n for n in lines if n < mutant.first and lines[n]]
    if not some and above:  # coverage does not see every line that runs
        some = {test for test in lines[max(above)] if test in seconds}
    own, same = f"tests/{mutant.file.split('/')[1]}/", f"test_{Path(mutant.file).name}"
    files: dict[str, list[str]] = {}
    for test in sorted(some, key=lambda test: seconds.get(test, 0.0)):
        files.setdefault(test.split("::")[0], []).append(test)
    total = {file: sum(seconds.get(test, 0.0) for test in tests) for file, tests in files.items()}
    chosen, spent = [], 0.0
    for file in sorted(files, key=lambda file: (Path(file).name != same, not file.startswith(own), total[file])):
        for test in files[file]:
            if spent + seconds.get(test, 0.0) <= ENOUGH or not chosen:
                chosen.append(test)
                spent += seconds.get(test, 0.0)
    return chosen


class Copy:
    """A copy of the library, and the process that runs tests in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = copied(folder)
        command, pipe = [sys.executable, "-m", "tests.mutation.warm"], subprocess.PIPE
        self._runner = subprocess.Popen(
            command, cwd=folder, env=environment(folder), stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True
        )

    def outcome(self, mutant: Mutant, tests: list[str], seconds: float) -> str:
        """Return "killed", "timed out" or "survived"."""
        path, asked = self.folder / mutant.file, json.dumps([tests, int(60 + 5 * seconds)])
        assert self._runner.stdin is not None
        assert self._runner.stdout is not None
        source = path.read_bytes()
        path.write_bytes(mutant.of(source))
        try:
            self._runner.stdin.write(asked + "\n")
            self._runner.stdin.flush()
            code = int(self._runner.stdout.readline())
        finally:
            path.write_bytes(source)
        return "survived" if code == 0 else "killed" if code > 0 else "timed out"

    def close(self) -> None:
        """End the process."""
        self._runner.communicate()


def equivalents() -> dict[tuple[str, str, str], str]:
    """Return the reasons of changes that nobody can notice, by file, line and changed line."""
    blocks = (HOME / "tests/mutation/equivalent.txt").read_text().strip().split("\n\n")
    rows = [[line.strip() for line in block.splitlines()] for block in blocks if not block.startswith("#")]
    return {(file, old.removeprefix("- "), new.removeprefix("+ ")): " ".join(why) for file, old, new, *why in rows}


def drawn_of(everything: list[tuple[Mutant, str]], seed: int, count: int) -> list[Mutant]:
    """Return the changes that the seed draws from all, each given with what names it: its line before and after."""
    first = (HOME / "tests/mutation/drawn.txt").read_text().split() if seed == 0 else []
    named: dict[str, Mutant] = {}
    for mutant, text in everything:
        named.setdefault(hashlib.sha256(text.encode()).hexdigest()[:10], mutant)
    rest = sorted(named, key=lambda name: hashlib.sha256(f"{seed} {name}".encode()).digest())
    return [named[name] for name in dict.fromkeys([name for name in first if name in named] + rest)][:count]


def main() -> int:
    parser = argparse.ArgumentParser(prog="tests.mutation")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--least", type=float, default=0.92, help="score below which it fails")
    parser.add_argument(
        "--only", default="", help="draw from files whose name holds this, or one of these, with commas between"
    )
    parser.add_argument("--part", default="1/1", help="2/3 runs the second third of the changes that are drawn")
    parser.add_argument(
        "--kept", type=Path, help="folder that keeps the map and what was killed: a run goes on from it"
    )
    asked = parser.parse_args()
    files = sorted(path for room in ROOMS for path in (HOME / "koopmpc" / room).rglob("*.py"))
    names = [str(path.relative_to(HOME)) for path in files]
    sources = {
        name: (HOME / name).read_bytes() for name in names if any(word in name for word in asked.only.split(","))
    }
    everything = [mutant for name, source in sources.items() for mutant in mutants(name, source)]
    texts = ["\n".join(mutant.lines(sources[mutant.file])) for mutant in everything]
    drawn = drawn_of(list(zip(everything, texts, strict=True)), asked.seed, asked.count)
    part, parts = (int(number) for number in asked.part.split("/"))
    drawn = drawn[part - 1 :: parts]
    known, say = equivalents(), sys.stdout.write
    log = asked.kept and asked.kept / f"killed.{part}"  # one line for each change: a test that kills it stays
    killed = {line for file in asked.kept.glob("killed.*") for line in file.read_text().splitlines()} if log else set()
    with tempfile.TemporaryDirectory() as temporary:
        made = [Copy(Path(temporary) / str(i)) for i in range(asked.workers)]
        copies: SimpleQueue[Copy] = SimpleQueue()
        for copy in made:
            copies.put(copy)
        kept = asked.kept and asked.kept / "map.json"
        if kept and kept.exists():
            held, seconds = json.loads(kept.read_text())
            covering = {file: {int(n): tests for n, tests in lines.items()} for file, lines in held.items()}
        else:
            covering, seconds = measured(made[0].folder, asked.workers)
            if kept:
                kept.write_text(json.dumps([covering, seconds]))

        quick = sorted(seconds, key=lambda test: seconds[test])[:20]
        for copy in made:  # what is not changed must survive
            if copy.outcome(replace(drawn[0], start=0, end=0, text=""), quick, 20.0) != "survived":
                raise SystemExit("the tests fail without any change")

        def judged(mutant: Mutant) -> tuple[Mutant, str, str]:
            before, after = mutant.lines(sources[mutant.file])
            why = known.get((mutant.file, before, after))
            tests = tests_of(mutant, covering, seconds)
            told = f"{mutant.file}:{mutant.first}\n- {before}\n+ {after}\n"
            if why is not None:
                return mutant, "equivalent", f"{told}  {why}\n"
            key = f"{mutant.start} {hashlib.sha256(mutant.of(sources[mutant.file])).hexdigest()}"
            if key in killed:
                return mutant, "killed", told
            if not tests:
                return mutant, "survived", f"{told}  no test runs this line\n"
            copy = copies.get()
            try:
                found = copy.outcome(mutant, tests, sum(seconds.get(test, 0.0) for test in tests))
            finally:
                copies.put(copy)
            if log and found != "survived":
                with log.open("a") as file:
                    file.write(key + "\n")
            return mutant, found, f"{told}  {found}; {len(tests)} tests\n"

        counts = dict.fromkeys(("killed", "timed out", "equivalent", "survived"), 0)
        with ThreadPoolExecutor(asked.workers) as pool:
            for _, found, told in pool.map(judged, drawn):
                counts[found] += 1
                if found in ("survived", "equivalent"):
                    say(f"\n{found}: {told}")
                sys.stdout.flush()
        for copy in made:
            copy.close()
    noticed = counts["killed"] + counts["timed out"]
    score = noticed / max(noticed + counts["survived"], 1)
    said = ", ".join(f"{count} {name}" for name, count in counts.items())
    say(f"\n{len(drawn)} of {len(everything)} changes, seed {asked.seed}: {said}; score {score:.1%}\n")
    return int(score < asked.least)


if __name__ == "__main__":
    sys.exit(main())
