"""Tests run what users run, and check every QP that a controller solves against its KKT conditions.

With KOOPMPC_TESTS=typed every jaxtyping shape is checked too; that hook must come before the first import of koopmpc.
With KOOPMPC_TESTS=bare nothing is checked: tests/speed measures what users run.
"""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import pytest
from hypothesis import settings

import tests.bare
import tests.typecheck

MODE = os.environ.get("KOOPMPC_TESTS", "")
if MODE != "bare":
    os.environ.setdefault("KOOPMPC_CFLAGS", "-O0")  # the numbers are those of -O3, and compiling takes half the time
if MODE == "typed":
    tests.typecheck.hook()

LONGEST = [
    "synthesis/test_design.py",
    "apps/test_goal.py",
    "apps/test_fit.py",
    "faults/test_sweeps.py",
    "loop/test_realtime.py",
    "codegen/test_parity.py",
    "test_parallel.py",
    "apps/test_check.py",
    "test_reading.py",
    "validate/logs/test_audit.py",
    "test_docs_pages.py",
    "apps/test_sweep.py",
    "apps/test_store.py",
    "views/test_recorder.py",
    "synthesis/test_fresh.py",
    "synthesis/test_records.py",
    "loop/test_live.py",
    "guarantees/test_certify.py",
    "docs/test_pages.py",
    "faults/test_logs.py",
    "apps/test_shipped.py",
    "models/test_moments_sources.py",
    "control/test_random_bilinear_loops.py",
    "codegen/test_export.py",
    "apps/test_problems.py",
    "control/test_staged_mpc.py",
    "control/test_bilinear_mpc.py",
    "data/test_mender.py",
    "test_cli.py",
    "control/test_invariance.py",
    "apps/test_inspect.py",
    "control/test_koopman_mpc.py",
    "test_saved_files.py",
    "synthesis/test_stabilise.py",
    "loop/test_adaptive.py",
    "faults/test_glitches.py",
    "synthesis/test_train.py",
]  # files that take a process 6 s and more, here or in `make typed`


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Leave what was imported and collected to no search for garbage: each would walk through 1.5 million objects."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files: at the end no process waits long for another."""
    place = {Path(__file__).parent / file: i for i, file in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(place)))


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run what the type hook would forestall, or stand between, in a process without it: one for each file."""
    if MODE != "typed" or not pyfuncitem.get_closest_marker("unhooked"):
        return None
    end, said = tests.bare.run_unhooked(pyfuncitem.path, pyfuncitem.config.option.markexpr)[pyfuncitem.name]
    if end == "skipped":
        pytest.skip(said)
    assert end == "passed", said
    return True


settings.register_profile("default", deadline=None, max_examples=30, derandomize=True)
settings.load_profile("default")


@pytest.fixture(autouse=True, scope="session")
def _every_qp_meets_kkt():
    if MODE == "bare":
        yield
        return
    import koopmpc.apps.bench.single
    import koopmpc.control.target
    from koopmpc.control import solvers
    from tests.control.kkt import CheckedDAQP, CheckedOSQP

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(solvers.SOLVERS, "osqp", CheckedOSQP)
        patch.setitem(solvers.SOLVERS, "daqp", CheckedDAQP)
        patch.setattr(koopmpc.control.target, "FINISHER", CheckedDAQP)
        patch.setattr(koopmpc.apps.bench.single, "_COLD_STEPS", 2)  # a sleep before each of 25 is half of a short run
        yield
