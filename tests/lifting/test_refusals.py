"""Bad input: each message says what was got and what to do; and what a file refuses."""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.bare import shown
from tests.lifting.families import NAMES
from tests.roundtrip import from_data, returned, to_data


@dataclass(frozen=True, eq=False)
class Drag(km.Lifting):
    """A user's own family: |ω| ω and its multiple."""

    gain: float = 2.0

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        return ("drag", "gained drag")

    def formula(self, x: ca.SX) -> ca.SX:
        drag = ca.fabs(x[1]) * x[1]
        return ca.vertcat(drag, self.gain * drag)


@dataclass(frozen=True, eq=False)
class Error(km.Lifting):
    """A user's own family with an operation that no graph holds."""

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        return ("erf",)

    def formula(self, x: ca.SX) -> ca.SX:
        return ca.erfinv(x[0])


@dataclass(frozen=True, eq=False)
class Wide(Drag):
    """A family that returns more than it names."""

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        return ("drag",)


def test_a_family_of_ones_own_needs_two_methods_and_is_saved_traced() -> None:
    X = np.random.default_rng(0).normal(size=(20, 2))
    lifting = (km.State() + Drag()).bind(NAMES[:2])
    drag = np.abs(X[:, 1]) * X[:, 1]
    np.testing.assert_allclose(lifting(X), np.column_stack([X, drag, 2 * drag]), rtol=1e-15)
    again = returned(lifting)
    assert not isinstance(again.parts[1], Drag)  # a file holds operations, never the class
    assert again.names == lifting.names
    assert np.array_equal(again(X), lifting(X))
    assert returned(again) == again


def test_unbound_liftings_are_saved_too() -> None:
    lifting = km.State() + km.Constant() + km.Monomials(3) + km.Fourier(2, [0, "omega"]) + km.ThinPlate([[0, 1]])
    lifting += km.Gaussian([[0, 1]], 0.5)
    again = returned(lifting)
    assert again == lifting
    assert again.bind(NAMES[:2]) == lifting.bind(NAMES[:2])


def test_expressions_keep_no_python_function_once_bound() -> None:
    calls: list[int] = []

    def fn(x: ca.SX) -> list[ca.SX]:
        calls.append(1)
        return [x[0] ** 2]

    lifting = km.Expressions(fn, ["square"]).bind(NAMES)
    lifting([[1, 2, 3], [2, 2, 3]])
    lifting.symbolic(ca.SX.sym("x", 3))
    assert len(calls) == 1
    assert returned(lifting) == lifting


DATA, SHAPE = km.errors.DataError, km.errors.ShapeError
MISTAKES = [
    (DATA, r"Fourier does not know its states yet; call .bind\(states\)", lambda: km.Fourier(2)([[1.0]])),
    (DATA, "Sum does not know its states yet", lambda: (km.State() + km.Constant()).names),
    (DATA, "State does not know its states yet", lambda: km.State().symbolic(ca.SX.sym("x", 2))),
    (SHAPE, r"x has 2 states, the lifting was bound to 3 \(theta \[rad\], omega \[rad/s\], p \[m\]\)",
        lambda: km.State().bind(NAMES)([[1.0, 2.0]])),
    (SHAPE, r"x has shape \(2, 2, 3\), the lifting", lambda: km.State().bind(NAMES)(np.zeros((2, 2, 3)))),
    (SHAPE, r"x has shape \(\), the lifting was bound to 3", lambda: km.State().bind(NAMES)(1.0)),
    (SHAPE, "x has 4 states, the lifting", lambda: km.State().bind(NAMES).symbolic(ca.SX.sym("x", 4))),
    (SHAPE, r"x has shape \(1, 3\)", lambda: km.State().bind(NAMES).symbolic(ca.SX.sym("x", 1, 3))),
    (DATA, "two states are named 'a'; rename one", lambda: km.State().bind(("a", "a"))),
    (DATA, r"two observables are named 'a\^2'; rename one", lambda: km.Monomials(2).bind(("a [m]", "a [s]"))),
    (DATA, "degree is 1; it must be at least 2", lambda: km.Monomials(1)),
    (DATA, "harmonics is 0; it must be at least 1", lambda: km.Fourier(0)),
    (DATA, r"state 'phi'; the states are theta \[rad\], omega", lambda: km.Fourier(1, "phi").bind(NAMES)),
    (DATA, r"state 3; the states are .* or 0 … 2", lambda: km.Fourier(1, 3).bind(NAMES)),
    (SHAPE, "centers has 2 columns and there are 3 states", lambda: km.ThinPlate([[0, 1]]).bind(NAMES)),
    (DATA, "pass at least one row, one row for each centre", lambda: km.ThinPlate(np.zeros((0, 3)))),
    (SHAPE, r"centers has shape \(2,\), expected \(any, any\)", lambda: km.ThinPlate([0, 1])),
    (DATA, "centers holds 1 NaN or inf", lambda: km.Gaussian([[0, np.nan]], 1)),
    (DATA, "width is 0; it must be above zero", lambda: km.Gaussian([[0, 1]], 0)),
    (DATA, r"fn returns shape \(1, 1\) and names has 2; return one expression for each name",
        lambda: km.Expressions(lambda x: [x[0]], ["a", "b"]).bind(NAMES)),
    (DATA, "two observables are named", lambda: km.Expressions(lambda x: [x[0], x[1]], ["a", "a"]).bind(NAMES)),
    (DATA, "uses the operation 'erfinv'", lambda: km.Expressions(lambda x: [ca.erfinv(x[0])], ["a"]).bind(NAMES)),
    (DATA, r"call .bind\(states\), which traces", lambda: to_data(km.Expressions(lambda x: [x[0]], ["a"]))),
    (DATA, "uses the operation 'erfinv'", lambda: to_data(Error().bind(NAMES))),
    (DATA, "Drag does not know its states yet", lambda: to_data(Drag())),
    (SHAPE, r"Wide.formula returns shape \(2, 1\), but names 1 observables; return a column of 1",
        lambda: Wide().bind(NAMES).symbolic(ca.SX.sym("x", 3))),
    (
        DATA,
        r"a stream is read once, by the fit; take Standardized\.of from",
        lambda: km.lifting.Standardized.of(
            km.data.Stream(iter([km.Episodes([km.Episode(X=np.zeros((4, 3)))], 0.1)])), km.State()
        ),
    ),
    (DATA, "scale holds 0; it must be above zero for every state",
        lambda: km.lifting.Standardized(km.State(), [0, 0], [1, 0])),
    (SHAPE, r"scale has shape \(1,\), expected \(2,\)", lambda: km.lifting.Standardized(km.State(), [0, 0], [1])),
    (SHAPE, "mean and scale have 2 entries and there are 3 states",
        lambda: km.lifting.Standardized(km.State(), [0, 0], [1, 1]).bind(NAMES)),
    (DATA, "count is 0; it must be at least 1", lambda: km.RandomFourier(0, 1.0)),
    (DATA, "width is 0; it must be above zero", lambda: km.RandomFourier(3, 0.0)),
    (DATA, "frequencies and phases belong together", lambda: km.RandomFourier(3, 1.0, phases=[0, 0, 0])),
    (SHAPE, "frequencies has 1 columns and there are 3 states",
        lambda: km.RandomFourier(1, 1.0, frequencies=[[1.0]], phases=[0.0], bound=NAMES)),
    (DATA, r"RandomFourier does not know its states yet", lambda: km.RandomFourier(1, 1.0)([1.0])),
]  # fmt: skip


@pytest.mark.parametrize(("error", "text", "mistake"), MISTAKES, ids=[text for _, text, _ in MISTAKES])
def test_a_mistake_says_what_was_got_and_what_to_do(error: Any, text: str, mistake: Any) -> None:
    with pytest.raises(error, match=text):
        mistake()


def test_a_lifting_that_a_file_spoils_is_a_log_error() -> None:
    tree = to_data(km.Monomials(3))
    tree["degree"] = 0
    with pytest.raises(km.errors.LogError, match="'Monomials' that cannot be built: degree is 0"):
        from_data(tree)


def test_what_is_no_lifting_at_all() -> None:
    """What the type hook of the tests would catch first, as users see it."""
    lines = shown(
        """
data = km.Episodes([km.Episode(X=np.zeros((4, 2)))], 0.1)
show(lambda: km.State() + 3)
show(lambda: km.State() + km.Constant)
show(lambda: km.edmd(data, km.State))
show(lambda: km.edmd(data, "State"))
"""
    )
    assert lines == [
        "DataError 3 is not a lifting; pass one, or a sum: State() + Constant()",
        "DataError the lifting is the class Constant; pass an instance: Constant(…)",
        "DataError the lifting is the class State; pass an instance: State(…)",
        "DataError 'State' is not a lifting; pass one, or a sum: State() + Constant()",
    ]
