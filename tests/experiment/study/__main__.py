"""python -m tests.experiment.study STUDY: measure plants or tasks, print what they amount to, keep it with --write."""

import argparse
import sys
import warnings
from collections.abc import Callable
from typing import Any

from tests.experiment.study.alarms import judge_alarms
from tests.experiment.study.bent import judge_bent
from tests.experiment.study.drift import judge_drift
from tests.experiment.study.feedback import judge_feedback
from tests.experiment.study.halves import TASKS, judge_halves
from tests.experiment.study.plants import draw_task
from tests.experiment.study.safety import run_experiments
from tests.experiment.study.table import COUNTS, load_rows, save_rows

LEVELS = (0.9, 0.7)  # of plants in turn


def judge_safety(number: int) -> Any:
    """Return the experiments of the plant of this number."""
    return run_experiments(draw_task(number), number, LEVELS[number % len(LEVELS)])


JUDGES: dict[str, Callable[[Any], Any]] = {
    "safety": judge_safety,
    "halves": judge_halves,
    "drift": judge_drift,
    "alarms": judge_alarms,
    "feedback": judge_feedback,
    "bent": judge_bent,
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.experiment.study", description=__doc__)
    parser.add_argument("study", choices=list(JUDGES))
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="of halves")
    parser.add_argument("--first", type=int, default=0, help="number of the first plant, of all but halves")
    parser.add_argument("--count", type=int, default=10, help="number of plants, of all but halves")
    parser.add_argument("--write", action="store_true", help="keep the rows")
    asked = parser.parse_args()
    numbers = range(asked.first, asked.first + asked.count)
    rows = load_rows(asked.study)
    for one in asked.tasks if asked.study == "halves" else numbers:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rows[str(one)] = JUDGES[asked.study](one)
        sys.stderr.write(f"{one}: {rows[str(one)]}\n")
        if asked.write:
            save_rows(asked.study, rows)
    found = COUNTS[asked.study](rows)
    sys.stdout.write("".join(f"{name}: {value}\n" for name, value in found.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
