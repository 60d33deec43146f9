"""python -m tests.closed_loop: measure, print the table beside the stored one, and say what lost."""

import argparse
import sys
import time

from tests.closed_loop.controllers import CONTROLLERS, DESIGNED
from tests.closed_loop.judge import SEEDS, Table, measure
from tests.closed_loop.more_tasks import JUDGED
from tests.closed_loop.table import FIRST, STORED, losses, saved, stored, text
from tests.closed_loop.tasks import TASKS


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.closed_loop", description=__doc__)
    parser.add_argument("--tasks", nargs="+", choices=JUDGED, default=list(TASKS))
    parser.add_argument("--controllers", nargs="+", choices=[*CONTROLLERS, *DESIGNED], default=list(CONTROLLERS))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--quick", action="store_true", help="one training seed")
    parser.add_argument("--u-target", choices=("equilibrium", "zero", "given"), help="for all tasks, not stored")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--against", choices=("last", "first"), default="last", help="the table to compare with")
    parser.add_argument("--write", action="store_true", help="store the rows measured as the table to compare with")
    asked = parser.parse_args()
    seeds = asked.seeds[:1] if asked.quick else asked.seeds
    start = time.perf_counter()
    old = stored(STORED if asked.against == "last" else FIRST)
    kept = stored()

    def progress(number: int, of: int, table: Table) -> None:
        sys.stderr.write(f"{number} of {of} after {time.perf_counter() - start:.0f} s\n")
        if asked.write and asked.u_target is None:  # what is measured is kept, even if the rest never is
            both = {task: kept.get(task, {}) | table.get(task, {}) for task in JUDGED if task in kept or task in table}
            saved(both, STORED)

    table = measure(asked.tasks, asked.controllers, seeds, asked.u_target, asked.workers, progress)
    sys.stdout.write(text(table, old or None) + f"\n{time.perf_counter() - start:.0f} s\n")
    if asked.u_target is not None:
        return 0
    lost = losses(table, old)
    sys.stdout.write("".join(f"LOST  {line}\n" for line in lost))
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
