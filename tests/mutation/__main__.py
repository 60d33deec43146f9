"""Mutation testing, run by `make mutants`: small changes of the library, of which the tests must notice each.

Comparisons are swapped, + becomes −, constants change, statements and checks are left out, conditions turned round, None
returned. A seed draws them by their text: a change stays drawn while its line stands, wherever it moves. Seed 0 draws
from the six rooms that must not be wrong, the 200 of tests/mutation/drawn.txt first, which were drawn when the tests knew
nothing of them; since then tests were written for those that survived. Any other seed draws evenly from all rooms, the C
included, and all kinds of changes, and says what share of all changes the tests notice.

Each change is made in a copy of the library. The tests that run the changed line are run until one fails, of C those that
build its file; a change that they do not notice is run against the whole suite. Which tests run which line, and how long
each takes, is measured once; `--near` leaves that out, and runs the tests of the same name, then those of the room. A
change that no test notices survives, and is printed. Those that change nothing that could be noticed stand, with the
reason, in tests/mutation/equivalent.txt.
"""

import argparse
import compileall
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from py_compile import PycInvalidationMode
from queue import SimpleQueue

from coverage import CoverageData

from tests.mutation.changes import Mutant
from tests.mutation.draw import FIRST, HOME, drawn_of, list_changes, read_sources, room_of

MORE = ("tests/faults", "tests/synthesis", "tests/validate", "tests/codegen")  # tests elsewhere that run these rooms
COPIED = (
    *("koopmpc", "problems", "tests", "docs", "pyproject.toml", "README.md", "CHANGELOG.md", "Makefile"),
    *("CONTRIBUTING.md", "CITATION.cff", "LICENSE", "mkdocs.yml", "constraints.txt"),
)
ENOUGH = 30.0  # seconds of processor time of tests that a change has to outlive
WHOLE = 3600.0  # the same of the whole suite
FEW = 5  # tests that may fail before anything is changed, as those of real time on a machine that is busy; none counts
PYTEST = (sys.executable, "-m", "pytest", "-q", "--benchmark-disable", "-p", "no:cacheprovider")


def copied(folder: Path) -> Path:
    """Copy what the tests need into the folder, and return it."""
    for name in COPIED:
        if (HOME / name).is_dir():
            shutil.copytree(HOME / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(HOME / name, folder / name)
    for name in ("koopmpc", "tests"):  # by content: a changed file is never taken for the one that was compiled
        compileall.compile_dir(folder / name, quiet=1, invalidation_mode=PycInvalidationMode.CHECKED_HASH)
    return folder


def environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "KOOPMPC_TESTS": ""}


Map = dict[str, dict[int, list[str]]]


def measured(folder: Path, workers: int, rooms: tuple[str, ...]) -> tuple[Map, dict[str, float]]:
    """Run the tests of the rooms; return which of them run each line of each file, and the seconds of each.

    Without rooms all tests are run. Those that read a C file to build it stand at its line 0.

    Raises
    ------
    SystemExit
        More than a few tests fail before anything is changed.
    """
    where = [*(f"tests/{room}" for room in rooms), *MORE] if rooms else ["tests"]
    done = subprocess.run(
        [*PYTEST, "-n", str(workers), "--dist", "loadfile", "-p", "tests.mutation.seconds", *where]
        + [f"--cov=koopmpc/{room}" for room in rooms or ("",)]
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
    for name, tests in json.loads((folder / "built.json").read_text()).items():
        found[f"koopmpc/codegen/{name}"] = {0: sorted(tests)}
    return found, json.loads((folder / "seconds.json").read_text())


def tests_of(mutant: Mutant, covering: Map, seconds: dict[str, float]) -> list[str]:
    """Return the tests that run this line, as many as take ENOUGH.

    The file of tests that has the name of the changed one comes first, then those of its room, the short ones first.
    """
    lines = covering.get(mutant.file, {})
    at = range(mutant.first, mutant.last + 1) if mutant.file.endswith(".py") else range(1)
    some = {test for n in at for test in lines.get(n, ()) if test in seconds}
    if not some and any(n in lines for n in at):  # it runs when it is imported
        some = {test for tests in lines.values() for test in tests if test in seconds}
    above = [n for n in lines if n < mutant.first and lines[n]]
    if not some and above:  # coverage does not see every line that runs
        some = {test for test in lines[max(above)] if test in seconds}
    own, same = f"tests/{room_of(mutant.file)}/", f"test_{Path(mutant.file).name}"
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


def near_tests(mutant: Mutant) -> list[str]:
    """Return the files of tests that may run a change: of the same name, of those that name its file, of its room."""
    stem, room = Path(mutant.file).stem, room_of(mutant.file)
    files = sorted((HOME / "tests").rglob("test_*.py"), key=lambda path: path.stat().st_size)
    if room == "c":
        where = [
            HOME / "tests/codegen" / f"test_{name}.py" for name in ("parity", "compiled", "bilinear", "export", "unit")
        ]
    else:
        names = re.compile(rf"\b{re.escape(mutant.file[:-3].replace('/', '.'))}\b")
        where = [path for path in files if path.stem == f"test_{stem}"]
        where += [path for path in files if names.search(path.read_text())]
        where += [path for path in files if path.parent.name == room or path.stem.startswith(f"test_{room}")]
        where += [path for path in files if path.parent.name == "tests"] * (room == "koopmpc")
    return [str(path.relative_to(HOME)) for path in dict.fromkeys(where)]


class Copy:
    """A copy of the library, and the process that runs tests in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = copied(folder)
        command, pipe = [sys.executable, "-m", "tests.mutation.warm"], subprocess.PIPE
        self._runner = subprocess.Popen(
            command, cwd=folder, env=environment(folder), stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True
        )
        self._broken: set[str] = set()  # tests that fail without any change

    def outcome(self, mutant: Mutant | None, tests: list[str], seconds: float, enough: float = 1e9) -> tuple[str, str]:
        """Return "killed", "timed out" or "survived", and the test that failed.

        A test that fails without any change as well counts for nothing; tests end once they took `enough` seconds.
        """
        while True:
            found, failed = self._run(mutant, tests, seconds, enough)
            if mutant is None or found != "killed":
                return found, failed
            again = [failed] if failed else tests[:1]  # without a name: nothing could be imported
            if self._run(None, again, seconds, enough)[0] == "survived":
                return found, failed
            if failed in self._broken:
                return "survived", ""
            self._broken.update(again)
            if not failed or len(self._broken) > FEW:  # whatever is changed would seem to survive
                raise SystemExit(f"the tests fail without any change: {', '.join(sorted(self._broken))}")

    def _run(self, mutant: Mutant | None, tests: list[str], seconds: float, enough: float) -> tuple[str, str]:
        left_out = [f"--deselect={test}" for test in sorted(self._broken)]
        asked = json.dumps([[*tests, *left_out], int(60 + 5 * seconds), enough])
        assert self._runner.stdin is not None
        assert self._runner.stdout is not None
        path = self.folder / (mutant.file if mutant else "pyproject.toml")
        source = path.read_bytes()
        if mutant:
            path.write_bytes(mutant.of(source))
        try:
            self._runner.stdin.write(asked + "\n")
            self._runner.stdin.flush()
            code, failed = json.loads(self._runner.stdout.readline())
        finally:
            path.write_bytes(source)
        return "survived" if code == 0 else "killed" if code > 0 else "timed out", failed

    def close(self) -> None:
        """End the process."""
        self._runner.communicate()


def equivalents() -> dict[tuple[str, str, str], str]:
    """Return the reasons of changes that nobody can notice, by file, line and changed line."""
    blocks = (HOME / "tests/mutation/equivalent.txt").read_text().strip().split("\n\n")
    rows = [[line.strip() for line in block.splitlines()] for block in blocks if not block.startswith("#")]
    return {(file, old.removeprefix("- "), new.removeprefix("+ ")): " ".join(why) for file, old, new, *why in rows}


def main() -> int:
    parser = argparse.ArgumentParser(prog="tests.mutation")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--least", type=float, default=0.92, help="score below which it fails")
    parser.add_argument("--only", default="", help="draw from files whose name holds one of these, with commas between")
    parser.add_argument("--part", default="1/1", help="2/3 runs the second third of the changes that are drawn")
    parser.add_argument("--kept", type=Path, help="folder that keeps the map and what was found: a run goes on from it")
    parser.add_argument("--near", action="store_true", help="measure no map; run tests of the same name and room")
    parser.add_argument("--rooms-only", action="store_true", help="do not run what survives against the whole suite")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no change after these")
    asked = parser.parse_args()
    ends = time.monotonic() + 60 * asked.minutes
    every = read_sources(asked.seed)
    sources = {name: text for name, text in every.items() if any(word in name for word in asked.only.split(","))}
    everything = list_changes(sources)
    drawn = drawn_of(everything, asked.seed, asked.count)
    part, parts = (int(number) for number in asked.part.split("/"))
    drawn = drawn[part - 1 :: parts]
    known, say = equivalents(), sys.stdout.write
    log = asked.kept and asked.kept / f"found.{part}"  # one line for each change
    past = {}
    if log:
        lines = [json.loads(line) for file in asked.kept.glob("found.*") for line in file.read_text().splitlines()]
        past = {line["key"]: line for line in lines}
    with tempfile.TemporaryDirectory() as temporary:
        made = [Copy(Path(temporary) / str(i)) for i in range(asked.workers)]
        copies: SimpleQueue[Copy] = SimpleQueue()
        for copy in made:
            copies.put(copy)
        kept = asked.kept and asked.kept / "map.json"
        covering, seconds = {}, {}
        if kept and kept.exists() and not asked.near:
            held, seconds = json.loads(kept.read_text())
            covering = {file: {int(n): tests for n, tests in lines.items()} for file, lines in held.items()}
        elif not asked.near:
            covering, seconds = measured(made[0].folder, asked.workers, FIRST if asked.seed == 0 else ())
            if kept:
                kept.write_text(json.dumps([covering, seconds]))
        quick = sorted(seconds, key=lambda test: seconds[test])[:20] or ["tests/test_values.py"]
        for copy in made:  # what is not changed must survive
            if copy.outcome(None, quick, 20.0)[0] != "survived":
                raise SystemExit("the tests fail without any change")

        def judge(mutant: Mutant) -> tuple[str, str]:
            """Return what becomes of a change, and the text that says so."""
            before, after = mutant.lines(sources[mutant.file])
            told = f"{mutant.file}:{mutant.first}\n- {before}\n+ {after}\n"
            why = known.get((mutant.file, before, after))
            if why is not None:
                return "equivalent", f"{told}  {why}\n"
            key = f"{mutant.start} {hashlib.sha256(mutant.of(sources[mutant.file])).hexdigest()}"
            if key in past:
                return past[key]["found"], told
            if time.monotonic() > ends:
                return "not run", told
            tests = near_tests(mutant) if asked.near else tests_of(mutant, covering, seconds)
            copy, found, failed = copies.get(), "survived", ""
            try:
                if tests:
                    limit = sum(seconds.get(test, 0.0) for test in tests) or ENOUGH
                    found, failed = copy.outcome(mutant, tests, limit, ENOUGH if asked.near else 1e9)
                if found == "survived" and asked.seed and not asked.rooms_only:
                    found, failed = copy.outcome(mutant, ["tests"], WHOLE)
            finally:
                copies.put(copy)
            if log:
                with log.open("a") as file:
                    file.write(json.dumps({"key": key, "found": found, "by": failed, "change": told}) + "\n")
            return found, told + ("" if tests else "  no test runs this line\n")

        counts = dict.fromkeys(("killed", "timed out", "equivalent", "survived", "not run"), 0)
        with ThreadPoolExecutor(asked.workers) as pool:
            for found, told in pool.map(judge, drawn):
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
