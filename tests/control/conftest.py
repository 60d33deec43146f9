"""Every QP that a test of this folder solves is checked against the KKT conditions."""

import pytest

import koopmpc.control.target
from koopmpc.control.solvers import choose
from tests.control.kkt import CheckedOSQP


@pytest.fixture(autouse=True, scope="package")
def _every_qp_meets_kkt():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(choose.SOLVERS, "osqp", CheckedOSQP)
        patch.setattr(koopmpc.control.target, "OSQP", CheckedOSQP)
        yield
