"""Names of observables, sums, and the rows found by name."""

import numpy as np
import pytest
from hypothesis import given

from koopmpc.errors import DataError, ObservableError
from koopmpc.lifting.base import Lifting, rows
from koopmpc.lifting.constant import Constant
from koopmpc.lifting.expressions import Expressions
from koopmpc.lifting.fourier import Fourier
from koopmpc.lifting.gaussian import Gaussian
from koopmpc.lifting.monomials import Monomials
from koopmpc.lifting.state import State
from koopmpc.lifting.sum import Sum
from koopmpc.lifting.thin_plate import ThinPlate
from tests.lifting.families import NAMES, Case, cases, made


@pytest.mark.parametrize(
    ("lifting", "names"),
    [
        (State(), ("theta [rad]", "omega [rad/s]")),
        (Constant(), ("1",)),
        (Monomials(2), ("theta^2", "theta*omega", "omega^2")),
        (Fourier(2, "theta"), ("sin(theta)", "cos(theta)", "sin(2 theta)", "cos(2 theta)")),
        (Fourier(1), ("sin(theta)", "cos(theta)", "sin(omega)", "cos(omega)")),
        (Fourier(1, ["omega [rad/s]", 0]), ("sin(omega)", "cos(omega)", "sin(theta)", "cos(theta)")),
        (Fourier(1, -1), ("sin(omega)", "cos(omega)")),
        (ThinPlate([[0.5, -1]]), ("thinplate(0.5, -1)",)),
        (Gaussian([[0.5, -1]], 0.25), ("gaussian(0.5, -1; 0.25)",)),
        (Expressions(lambda x: [x[0] * x[1]], "power"), ("power",)),
    ],
)
def test_names(lifting: Lifting, names: tuple[str, ...]) -> None:
    assert lifting.bind(NAMES[:2]).names == names


@given(cases())
def test_a_sum_with_itself_is_itself(case: Case) -> None:
    lifting, X = made(case)
    twice = lifting + lifting
    assert twice.names == lifting.names
    assert np.array_equal(twice(X), lifting(X))


@given(cases(), cases())
def test_a_sum_holds_each_name_once_and_finds_both_parts(first: Case, second: Case) -> None:
    (a, X), (b, _) = made(first), made(second)
    if a.bound != b.bound:
        with pytest.raises(DataError, match="bound to other states"):
            _ = a + b
        return
    both = a + b
    assert len(set(both.names)) == both.nz == len(set(a.names) | set(b.names))
    assert np.array_equal(both(X)[:, rows(both, a)], a(X))
    assert np.array_equal(both(X)[:, rows(both, b)], b(X))


def test_sums_are_flat_and_associative() -> None:
    a, b, c = State(), Fourier(1), Monomials(2)
    assert (a + b) + c == a + (b + c) == Sum((a, b, c))


def test_what_is_bound_binds_what_is_added() -> None:
    assert (State().bind(NAMES) + Constant()).names == (*NAMES, "1")
    assert (Constant() + State().bind(NAMES)).names == ("1", *NAMES)


def test_other_centres_are_other_observables() -> None:
    assert (ThinPlate([[0.0]]) + ThinPlate([[1e-9]])).bind(("x",)).nz == 2
    assert (Gaussian([[0.0]], 1.0) + Gaussian([[0.0]], 2.0)).bind(("x",)).nz == 2


def test_binding_again_follows_the_new_states() -> None:
    lifting = (State() + Monomials(2)).bind(("a",))
    assert lifting.bind(("b", "c")).names == ("b", "c", "b^2", "b*c", "c^2")


def test_rows_names_what_is_missing() -> None:
    held = (State() + Fourier(1, 0)).bind(NAMES[:2])
    with pytest.raises(
        ObservableError, match=r"lacks 'sin\(2 theta\)'; add it to the lifting: it holds theta"
    ):
        rows(held, Fourier(2, 0).bind(NAMES[:2]))
