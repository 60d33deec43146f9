"""Tests run what users run, and check every QP that a controller solves against its KKT conditions.

With KOOPMPC_TESTS=typed every jaxtyping shape is checked too; that hook must come before the first import of koopmpc.
With KOOPMPC_TESTS=bare nothing is checked: tests/speed measures what users run.
"""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

import tests.typecheck  # noqa: F401  # the hook looks it up by name

MODE = os.environ.get("KOOPMPC_TESTS", "")
if MODE == "typed":
    install_import_hook("koopmpc", "tests.typecheck.beartyped")

settings.register_profile("default", deadline=None, max_examples=30, derandomize=True)
settings.load_profile("default")


@pytest.fixture(autouse=True, scope="session")
def _every_qp_meets_kkt():
    if MODE == "bare":
        yield
        return
    import koopmpc.control.target
    from koopmpc.control import solvers
    from tests.control.kkt import CheckedDAQP, CheckedOSQP

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(solvers.SOLVERS, "osqp", CheckedOSQP)
        patch.setattr(koopmpc.control.target, "DAQP", CheckedDAQP)
        yield
