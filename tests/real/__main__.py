"""python -m tests.real: measure our models on records and twins, print the table, and say what lost."""

import argparse
import sys

from tests.real.judge import KNOWING, measure, names
from tests.real.records import FOLDER, RECORDS
from tests.real.table import COLUMNS, load, losses, save, text
from tests.real.yardsticks import YARDSTICKS


def main() -> int:
    """Return 1 where one of our models lost against the stored table."""
    parser = argparse.ArgumentParser(prog="python -m tests.real", description=__doc__)
    parser.add_argument("--records", nargs="+", choices=names(), default=names())
    parser.add_argument(
        "--models", nargs="+", choices=["fit", "select", *YARDSTICKS, KNOWING], default=["fit", "select"]
    )
    parser.add_argument("--write", action="store_true", help="store what is measured as the table to compare with")
    asked = parser.parse_args()
    old, table = load(), {}
    kept = {name: dict(row) for name, row in old.items()}
    for name in asked.records:
        if name in RECORDS and not FOLDER.exists():
            sys.stderr.write(f"{name}: no folder {FOLDER}; set KOOPMPC_RECORDS\n")
            continue
        table[name] = measure(name, tuple(asked.models))
        sys.stderr.write(f"{name} done\n")
        kept[name] = {m: e for m, e in (kept.get(name, {}) | table[name]).items() if m in COLUMNS}
        if asked.write:
            save({n: kept[n] for n in names() if n in kept})
    sys.stdout.write(text({n: kept[n] for n in names() if n in table}) + "\n")
    lost = losses(table, old)
    sys.stdout.write("".join(f"LOST  {line}\n" for line in lost))
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
