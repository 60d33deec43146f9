"""Tests run with every jaxtyping shape checked, and every QP that one solves against its KKT conditions.

The hook must come before the first import of koopmpc. tests/speed measures what users run, without either.
"""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

import tests.typecheck  # noqa: F401  # the hook looks it up by name

CHECKED = not os.environ.get("KOOPMPC_NO_TYPE_HOOK")
if CHECKED:
    install_import_hook("koopmpc", "tests.typecheck.beartyped")

settings.register_profile("default", deadline=None, max_examples=30, derandomize=True)
settings.load_profile("default")


@pytest.fixture(autouse=True, scope="session")
def _every_qp_meets_kkt():
    if not CHECKED:
        yield
        return
    import koopmpc.control.target
    from koopmpc.control.solvers import choose
    from tests.control.kkt import CheckedOSQP

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(choose.SOLVERS, "osqp", CheckedOSQP)
        patch.setattr(koopmpc.control.target, "OSQP", CheckedOSQP)
        yield
