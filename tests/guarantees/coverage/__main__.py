"""python -m tests.guarantees.coverage: measure plants, print the table, and keep it with --write."""

import argparse
import sys

from tests.guarantees.coverage.judge import judge
from tests.guarantees.coverage.plants import list_tasks
from tests.guarantees.coverage.table import save_rows, stored, summarise


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.guarantees.coverage", description=__doc__)
    parser.add_argument("--plants", nargs="+", choices=list(list_tasks()), default=list(list_tasks()))
    parser.add_argument("--write", action="store_true", help="keep the rows in table.json")
    parser.add_argument("--rest", action="store_true", help="leave out plants that were measured")
    asked = parser.parse_args()
    rows = {}
    for name in asked.plants:
        if asked.rest and name in stored():
            continue
        try:
            rows[name] = judge(list_tasks()[name]())
        except Exception as error:  # a plant without a design is a row of the report, not the end of it
            sys.stderr.write(f"{name}: {type(error).__name__}: {error}\n")
            continue
        sys.stderr.write(f"{name}: {rows[name]}\n")
        if asked.write:
            save_rows(stored() | rows)
    sys.stdout.write(summarise(rows) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
