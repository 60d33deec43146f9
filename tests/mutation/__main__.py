"""Mutation testing, run by `make mutants`: small changes of the library, of which the tests must notice each.

Comparisons are swapped, + becomes −, constants change, statements and checks are left out, conditions turned round, None
returned. A seed draws them by their text: a change stays drawn while its line stands, wherever it moves. Seed 0 draws
from the six rooms that must not be wrong, the 200 of tests/mutation/drawn.txt first, which were drawn when the tests knew
nothing of them; since then tests were written for those that survived. Any other seed draws evenly from all rooms, the C
included, and all kinds of changes, and says what share of all changes the tests notice.

The suite is run once, in a copy of the library in which each change can be turned on: that says which tests meet which
change, in processes that they start too, and how long each takes. Then each change is turned on in children of a process
that has imported and collected everything, and the tests that meet it are run until one fails: those of the same name
first, then those of its room, the short ones first. No other test could notice it, so that the rest of the suite is left
out. What an import runs, or overlaps with another change, is met by every test that enters a function of its file, and C by
those that build its file.

A change that no test notices survives, and is printed. Where the tests of other names that meet one take more than ENOUGH
seconds, the rest is not run, and the print says so. Changes that nobody could notice stand, with the reason, in
tests/mutation/equivalent.txt; they count neither as noticed nor as survived.
"""

import argparse
import compileall
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from py_compile import PycInvalidationMode
from queue import SimpleQueue

from tests.mutation.changes import Mutant
from tests.mutation.draw import HOME, drawn_of, list_changes, name_of, read_sources, room_of
from tests.mutation.switched import switched

COPIED = (
    *("koopmpc", "problems", "tests", "docs", "pyproject.toml", "README.md", "CHANGELOG.md", "Makefile"),
    *("CONTRIBUTING.md", "CITATION.cff", "LICENSE", "mkdocs.yml", "constraints.txt"),
)
ENOUGH = 30.0  # seconds of processor time of tests in files of other names that a change has to outlive
PYTEST = (sys.executable, "-m", "pytest", "-q", "--benchmark-disable", "-p", "no:cacheprovider", "-p", "no:cov")
ORDER = ("killed", "timed out", "equivalent", "survived", "not run")


class Copy:
    """A copy of the library in which the changes can be turned on, and the process that runs its tests."""

    def __init__(self, folder: Path, changes: Mapping[str, Mutant], tests: list[str]) -> None:
        self.folder, self.switched, self.outside, self._tests = folder, set[str](), set[str](), tests
        self._warm: Warm | None = None
        for name in COPIED:
            if (HOME / name).is_dir():
                shutil.copytree(HOME / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(HOME / name, folder / name)
        shutil.copy(HOME / "tests/mutation/switch.py", folder / "sitecustomize.py")
        for file in {change.file for change in changes.values() if change.file.endswith(".py")}:
            own = {name: change for name, change in changes.items() if change.file == file}
            text, held, outside = switched((HOME / file).read_bytes(), own, file)
            (folder / file).write_bytes(text)
            self.switched |= held
            self.outside |= outside
        for name in ("koopmpc", "tests"):  # by content: a changed file is never taken for the one that was compiled
            compileall.compile_dir(folder / name, quiet=1, invalidation_mode=PycInvalidationMode.CHECKED_HASH)

    def environment(self, **more: str) -> dict[str, str]:
        kept = {"PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1", "KOOPMPC_TESTS": ""}
        return {**os.environ, **kept, **more}

    def outcome(self, name: str, mutant: Mutant, tests: list[tuple[str, float]]) -> tuple[str, str]:
        """Return "killed", "timed out" or "survived", and the test under way then."""
        if name in self.switched - self.outside:
            return self.warm().run(name, tests)
        path = self.folder / mutant.file
        source = path.read_bytes()
        if name not in self.switched:
            path.write_bytes(mutant.of((HOME / mutant.file).read_bytes()))
        try:
            if mutant.file.endswith(".py"):  # all is imported anew
                with closing(Warm(self, sorted({test.split("::")[0] for test, _ in tests}), name)) as fresh:
                    return fresh.run(name, tests)
            return self.warm().run("", tests)
        finally:
            path.write_bytes(source)

    def warm(self) -> "Warm":
        """Return the process that has collected all tests."""
        if not self._warm:
            self._warm = Warm(self, self._tests, "")
        return self._warm

    def close(self) -> None:
        """End the process."""
        if self._warm:
            self._warm.close()


class Warm:
    """A process that has imported and collected what it is given, with a change turned on or with none."""

    def __init__(self, copy: Copy, tests: list[str], change: str) -> None:
        theirs, self._asks = os.pipe()
        self._answers, ours = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.mutation.warm", str(theirs), str(ours), *tests],
            cwd=copy.folder,
            env=copy.environment(KOOPMPC_CHANGE=change),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(theirs, ours),
        )
        os.close(theirs)
        os.close(ours)
        self._lines = os.fdopen(self._answers)
        self.ready = bool(self._lines.readline())

    def run(self, change: str, tests: list[tuple[str, float]]) -> tuple[str, str]:
        """Return what becomes of a change, and the test under way then; "" where nothing could be imported."""
        if not self.ready:
            return "killed", ""
        os.write(self._asks, (json.dumps([change, tests]) + "\n").encode())
        code, test = json.loads(self._lines.readline())
        return "survived" if code == 0 else "killed" if code > 0 else "timed out", test

    def close(self) -> None:
        """End the process."""
        os.close(self._asks)
        self._lines.close()
        self._process.wait()


class Map:
    """Which tests meet which change, the seconds of each test, and those that fail without any change."""

    def __init__(self, held: list) -> None:
        self.meets: dict[str, list[str]] = held[0]
        self.seconds: dict[str, float] = held[1]
        self.broken = set(held[2])

    @staticmethod
    def measure(copy: Copy, workers: int, names: list[str], tests: list[str]) -> list:
        """Run the suite once with no change turned on."""
        notes = copy.folder / "notes"
        notes.mkdir()
        command = [*PYTEST, "-n", str(workers), "--dist", "loadfile", "-p", "tests.mutation.notes", *tests]
        done = subprocess.run(
            command,
            cwd=copy.folder,
            env=copy.environment(KOOPMPC_NOTES=str(notes)),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        if done.returncode > 1:
            raise SystemExit(f"the tests do not run without any change:\n{done.stdout[-3000:]}")
        meets, seconds, failed = {name: set[str]() for name in names}, dict[str, float](), list[str]()
        for path in notes.glob("*.json"):
            took, wrong = json.loads(path.read_text())
            seconds |= took
            failed += wrong
        files: dict[str, list[str]] = {}
        for test in seconds:
            files.setdefault(test.split("::")[0], []).append(test)
        for path in notes.glob("*.met"):
            for line in path.read_text().splitlines():
                name, _, test = line.partition("\t")
                test, _, phase = test.rpartition(" ")
                shared = (
                    files.get(test.split("::")[0], []) if phase == "(setup)" else ()
                )  # of a fixture that others use
                meets.setdefault(name, set()).update([test, *shared] if test else ())
        return [{name: sorted(tests) for name, tests in meets.items()}, seconds, failed]

    def tests_of(self, name: str, mutant: Mutant, *, outside: bool) -> list[tuple[str, float]]:
        """Return the tests that meet a change, in the order in which they are run, with their seconds."""
        some = {*self.meets.get(name, ()), *(self.meets.get(mutant.file, ()) if outside else ())}
        own, same = f"tests/{room_of(mutant.file)}/", f"test_{Path(mutant.file).stem}.py"

        def place(test: str) -> tuple[bool, bool, float]:
            file = test.split("::")[0]
            return Path(file).name != same, not file.startswith(own), self.seconds[test]

        chosen = sorted((test for test in some if test in self.seconds and test not in self.broken), key=place)
        return [(test, self.seconds[test]) for test in chosen]


def equivalents() -> dict[tuple[str, str, str], str]:
    """Return the reasons of changes that nobody can notice, by file, line and changed line."""
    blocks = (HOME / "tests/mutation/equivalent.txt").read_text().strip().split("\n\n")
    rows = [[line.strip() for line in block.splitlines()] for block in blocks if not block.startswith("#")]
    return {(file, old.removeprefix("- "), new.removeprefix("+ ")): " ".join(why) for file, old, new, *why in rows}


def interval(noticed: int, judged: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson, 1927)."""
    z, n = 1.96, max(judged, 1)
    share = noticed / n
    half = z * math.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    return (share + z**2 / (2 * n) - half) / (1 + z**2 / n), (share + z**2 / (2 * n) + half) / (1 + z**2 / n)


def within(tests: list[tuple[str, float]], mutant: Mutant) -> Iterator[tuple[str, float]]:
    """Yield the tests in the file of the same name, of which one may have paid for all, and ENOUGH seconds of others."""
    spent = 0.0
    for test, seconds in tests:
        if Path(test.split("::")[0]).name != f"test_{Path(mutant.file).stem}.py":
            spent += seconds
            if spent > ENOUGH and spent > seconds:
                return
        yield test, seconds


def main() -> int:
    parser = argparse.ArgumentParser(prog="tests.mutation")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--count", type=int, default=200, help="changes that each seed draws")
    parser.add_argument("--first", type=int, default=200, help="run only the first of them")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--least", type=float, default=0.92, help="score below which it fails")
    parser.add_argument("--only", default="", help="draw from files whose name holds one of these, with commas between")
    parser.add_argument("--tests", nargs="+", default=["tests"], help="files and folders of the tests that may notice")
    parser.add_argument("--kept", type=Path, help="folder that keeps the map and what was found: a run goes on from it")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no change after these")
    asked = parser.parse_args()
    ends, say = time.monotonic() + 60 * asked.minutes, sys.stdout.write
    drawn: dict[int, list[str]] = {}
    changes: dict[str, Mutant] = {}
    everything: dict[bool, list[tuple[Mutant, str]]] = {}
    for seed in asked.seeds:
        sources = {
            n: text for n, text in read_sources(seed).items() if any(word in n for word in asked.only.split(","))
        }
        if (seed == 0) not in everything:  # other seeds draw from the same
            everything[seed == 0] = list_changes(sources)
        own = drawn_of(everything[seed == 0], seed, asked.count)
        named = {name_of(mutant, sources[mutant.file]): mutant for mutant in own}
        drawn[seed] = list(named)[: asked.first]
        changes |= named
    known = equivalents()
    log = asked.kept and asked.kept / "found.txt"  # one line for each change
    lines = [json.loads(line) for line in log.read_text().splitlines()] if log and log.exists() else []
    past = {line["name"]: line for line in lines}
    with tempfile.TemporaryDirectory() as temporary:
        made = [Copy(Path(temporary) / str(i), changes, asked.tests) for i in range(asked.workers)]
        copies: SimpleQueue[Copy] = SimpleQueue()
        for copy in made:
            copies.put(copy)
        kept = asked.kept and asked.kept / "map.json"
        held = json.loads(kept.read_text()) if kept and kept.exists() else [{}, {}, []]
        if not set(changes) <= set(held[0]):
            held = Map.measure(made[0], asked.workers, list(changes), asked.tests)
            if kept:
                kept.write_text(json.dumps(held))
        found_by = Map(held)
        for test in sorted(found_by.broken):  # noting may break one, as where a disk is full
            if made[0].warm().run("", [(test, found_by.seconds[test])])[0] == "survived":
                found_by.broken.remove(test)
        sound = set[str]()  # tests that pass in a child where nothing is changed

        def judge(name: str) -> tuple[str, str]:
            """Return what becomes of a change, and the text that says so."""
            mutant = changes[name]
            before, after = mutant.lines((HOME / mutant.file).read_bytes())
            told = f"{mutant.file}:{mutant.first}\n- {before}\n+ {after}\n"
            why = known.get((mutant.file, before, after))
            if why is not None:
                return "equivalent", f"{told}  {why}\n"
            if name in past:
                return past[name]["found"], past[name]["change"]
            if time.monotonic() > ends:
                return "not run", told
            copy, began = copies.get(), time.monotonic()
            try:
                every = found_by.tests_of(name, mutant, outside=name in copy.outside or name not in copy.switched)
                while True:
                    tests = [test for test in within(every, mutant) if test[0] not in found_by.broken]
                    found, failed = copy.outcome(name, mutant, tests) if tests else ("survived", "")
                    if not failed or failed in sound:
                        break
                    one = [test for test in tests if test[0] == failed]
                    if copy.warm().run("", one)[0] == "survived":
                        sound.add(failed)
                        break
                    found_by.broken.add(failed)  # it counts for nothing
            finally:
                copies.put(copy)
            if found == "survived":
                told += f"  {len(tests)} of the {len(every)} tests that meet it were run\n"
            if log:
                line = {"name": name, "found": found, "by": failed, "change": told, "took": time.monotonic() - began}
                with log.open("a") as file:
                    file.write(json.dumps(line) + "\n")
            return found, told

        failing = False
        with ThreadPoolExecutor(asked.workers) as pool:
            for seed in asked.seeds:
                counts = Counter[str]()
                for found, told in pool.map(judge, drawn[seed]):
                    counts[found] += 1
                    if found in ("survived", "equivalent"):
                        say(f"\n{found}: {told}")
                    sys.stdout.flush()
                noticed = counts["killed"] + counts["timed out"]
                judged = noticed + counts["survived"]
                low, high = interval(noticed, judged)
                said = ", ".join(f"{counts[each]} {each}" for each in ORDER)
                say(f"\nseed {seed}, {len(drawn[seed])} of {asked.count} changes: {said}; ")
                say(f"score {noticed / max(judged, 1):.1%} (95 % interval {low:.1%} to {high:.1%})\n")
                failing |= noticed < asked.least * judged
        for copy in made:
            copy.close()
    return int(failing)


if __name__ == "__main__":
    sys.exit(main())
