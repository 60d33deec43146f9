"""Problems, the controllers that are compared on them, and the results."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.apps.bench.controllers import CONTROLLERS as CONTROLLERS
    from koopmpc.apps.bench.controllers import Prepared as Prepared
    from koopmpc.apps.bench.controllers import register_law as register_law
    from koopmpc.apps.bench.inspect import compare_runs as compare_runs
    from koopmpc.apps.bench.inspect import inspect_logs as inspect_logs
    from koopmpc.apps.bench.inspect import worst_moments as worst_moments
    from koopmpc.apps.bench.options import SweepOptions as SweepOptions
    from koopmpc.apps.bench.problem_files import list_problems as list_problems
    from koopmpc.apps.bench.problem_files import new_problem as new_problem
    from koopmpc.apps.bench.problem_files import shipped as shipped
    from koopmpc.apps.bench.report import build_summary_table as build_summary_table
    from koopmpc.apps.bench.report import median_interval as median_interval
    from koopmpc.apps.bench.report import results_table as results_table
    from koopmpc.apps.bench.report import write_report as write_report
    from koopmpc.apps.bench.row_filter import RowFilter as RowFilter
    from koopmpc.apps.bench.single import FAULTS as FAULTS
    from koopmpc.apps.bench.single import failures as failures
    from koopmpc.apps.bench.single import replay_log as replay_log
    from koopmpc.apps.bench.store import RunRow as RunRow
    from koopmpc.apps.bench.store import load_rows as load_rows
    from koopmpc.apps.bench.store import reached as reached
    from koopmpc.apps.bench.store import row_to_view as row_to_view
else:
    __getattr__, __dir__, __all__ = attach(
        __name__,
        hints={
            "Where": 'it is km.bench.RowFilter("violation > 0.01") now',
            "inspected": "it is km.bench.inspect_logs now",
            "compared": "it is km.bench.compare_runs now",
            "replayed": "it is km.bench.replay_log now",
        },
    )
