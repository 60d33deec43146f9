"""Every QP that a test of this folder solves is checked against the KKT conditions."""

import pytest

import koopmpc.control.koopman_mpc
import koopmpc.control.target
from tests.control.kkt import CheckedOSQP


@pytest.fixture(autouse=True, scope="package")
def _every_qp_meets_kkt():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(koopmpc.control.koopman_mpc, "OSQP", CheckedOSQP)
        patch.setattr(koopmpc.control.target, "OSQP", CheckedOSQP)
        yield
