"""Names of observables, sums, and the rows found by name."""

import numpy as np
import pytest
from hypothesis import given

import koopmpc as km
from tests.lifting.families import NAMES, Case, cases, made


@pytest.mark.parametrize(
    ("lifting", "names"),
    [
        (km.State(), ("theta [rad]", "omega [rad/s]")),
        (km.Constant(), ("1",)),
        (km.Monomials(2), ("theta^2", "theta*omega", "omega^2")),
        (km.Fourier(2, "theta"), ("sin(theta)", "cos(theta)", "sin(2 theta)", "cos(2 theta)")),
        (km.Fourier(1), ("sin(theta)", "cos(theta)", "sin(omega)", "cos(omega)")),
        (km.Fourier(1, ["omega [rad/s]", 0]), ("sin(omega)", "cos(omega)", "sin(theta)", "cos(theta)")),
        (km.Fourier(1, -1), ("sin(omega)", "cos(omega)")),
        (km.ThinPlate([[0.5, -1]]), ("thinplate(0.5, -1)",)),
        (km.Gaussian([[0.5, -1]], 0.25), ("gaussian(0.5, -1; 0.25)",)),
        (km.Expressions(lambda x: [x[0] * x[1]], "power"), ("power",)),
    ],
)
def test_names(lifting: km.Lifting, names: tuple[str, ...]) -> None:
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
        with pytest.raises(km.errors.DataError, match="bound to other states"):
            _ = a + b
        return
    both = a + b
    assert len(set(both.names)) == both.nz == len(set(a.names) | set(b.names))
    for part in (a, b):
        assert np.array_equal(both(X)[:, [both.names.index(name) for name in part.names]], part(X))


def test_sums_are_flat_and_associative() -> None:
    a, b, c = km.State(), km.Fourier(1), km.Monomials(2)
    assert (a + b) + c == a + (b + c)
    assert len(((a + b) + c).parts) == len((a + (b + c)).parts) == 3


def test_what_is_bound_binds_what_is_added() -> None:
    assert (km.State().bind(NAMES) + km.Constant()).names == (*NAMES, "1")
    assert (km.Constant() + km.State().bind(NAMES)).names == ("1", *NAMES)


def test_other_centres_are_other_observables() -> None:
    assert (km.ThinPlate([[0.0]]) + km.ThinPlate([[1e-9]])).bind(("x",)).nz == 2
    assert (km.Gaussian([[0.0]], 1.0) + km.Gaussian([[0.0]], 2.0)).bind(("x",)).nz == 2


def test_binding_again_follows_the_new_states() -> None:
    lifting = (km.State() + km.Monomials(2)).bind(("a",))
    assert lifting.bind(("b", "c")).names == ("b", "c", "b^2", "b*c", "c^2")


def test_what_a_controller_tracks_and_its_lifting_lacks_is_named() -> None:
    lifting = km.State() + km.Fourier(1, 0)
    nz = lifting.bind(NAMES[:2]).nz
    model = km.LinearPredictor(np.eye(nz), np.ones((nz, 1)), np.eye(2, nz), lifting, 0.1, NAMES[:2], ["u"])
    cost = km.Cost(np.eye(4), 1.0, of=km.Fourier(2, 0))
    with pytest.raises(km.errors.ObservableError, match=r"lacks 'sin\(2 theta\)'; add it to"):
        km.KoopmanMPC(model, cost, km.Limits(), 5)
