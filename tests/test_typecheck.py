"""The type hook that the tests put above koopmpc refuses what jaxtyping's own decorator refuses, and takes what that takes."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError

import koopmpc as km
from tests import typecheck
from tests.bare import run_unhooked


def product(A: Float[np.ndarray, "m n"], x: Float[np.ndarray, "n"], count: int = 1) -> Float[np.ndarray, "m"]:
    return (A @ x)[:count]


def cut(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n-1"]:
    return x[1:] if x[0] else x


def rows(A: Float[np.ndarray, "m n"]) -> Iterator[int]:
    yield from range(len(A))


def quoted(x: "nowhere.Array", n: int) -> "nowhere.Array":  # a name for type checkers only
    return x


@dataclass(frozen=True)
class Gain:
    K: Float[np.ndarray, "nu nx"]
    P: Float[np.ndarray, "nx nx"]


one, two = np.ones(1), np.ones(2)
CALLS: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], bool]] = [
    (product, (np.ones((1, 2)), two), {}, True),
    (product, (np.ones((2, 2)), two), {"count": 2}, True),
    (product, (np.ones((2, 2)), two), {"count": 1}, False),  # the result is too short
    (product, (np.ones((2, 2)), one), {}, False),
    (product, (np.ones((1, 2)), two.astype(int)), {}, False),
    (product, (np.ones((1, 2)), two, 1.0), {}, False),
    (product, (np.ones((1, 2)),), {"x": np.ones((2, 1))}, False),
    (cut, (two,), {}, True),
    (cut, (np.zeros(2),), {}, False),
    (rows, (np.ones((2, 2)),), {}, True),
    (rows, (two,), {}, False),
    (quoted, (1, 2), {}, True),
    (quoted, (1, "2"), {}, False),
    (Gain, (np.ones((1, 2)), np.eye(2)), {}, True),
    (Gain, (np.ones((1, 2)), np.eye(3)), {}, False),
    (Gain, (), {"P": np.eye(2), "K": two}, False),
]


def takes(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
    try:
        function(*args, **kwargs)
    except TypeCheckError:
        return False
    return True


def with_jaxtyping(function: Any) -> Any:
    if isinstance(function, type):
        function = dataclass(frozen=True)(type(function.__name__, (), {"__annotations__": function.__annotations__}))
    return typecheck._jaxtyped(function, typechecker=typecheck.beartyped)


@pytest.mark.parametrize(("function", "args", "kwargs", "fits"), CALLS)
def test_a_call_is_refused_exactly_where_jaxtyping_refuses_it(function, args, kwargs, fits):
    assert takes(with_jaxtyping(function), args, kwargs) == fits
    assert takes(typecheck._checked(function), args, kwargs) == fits


def test_a_call_within_a_call_has_letters_of_its_own_and_the_outer_call_keeps_its():
    inner = typecheck._checked(cut)

    def outer(x: Float[np.ndarray, "n"], k: int) -> Float[np.ndarray, "n"]:
        return np.ones(inner(np.ones(7)).size + k)

    assert typecheck._checked(outer)(np.ones(9), 3).size == 9
    with pytest.raises(TypeCheckError):
        typecheck._checked(outer)(np.ones(9), 1)  # n is 9 here, not the 7 of the inner call


def test_an_inner_function_checks_each_time_that_it_is_made_and_sees_its_own_maker():
    def scaled(by: float, hint: Any = Float[np.ndarray, "n"]) -> Callable[..., Any]:
        @typecheck._checked
        def inner(x: hint, *, more: float = by) -> hint:
            return by * more * x

        return inner

    made = [scaled(by) for by in (2.0, 3.0, 4.0)]
    assert [f(one).item() for f in made] == [4, 9, 16]
    assert [f(one, more=1).item() for f in made] == [2, 3, 4]
    for f in made:
        with pytest.raises(TypeCheckError):
            f(np.eye(2))
    square = scaled(5.0, Float[np.ndarray, "n n"])
    assert square(np.eye(1)).item() == 25
    with pytest.raises(TypeCheckError):
        square(one)


@pytest.mark.skipif(os.environ.get("KOOPMPC_TESTS") != "typed", reason="without the hook nothing is checked")
def test_the_hook_stands_above_the_library():
    with pytest.raises(TypeCheckError):
        km.loop.Plans(np.zeros((3, 2)), np.zeros((1, 1, 1)))


OUTCOMES = """
import pytest
pytestmark = pytest.mark.unhooked
@pytest.fixture
def torn():
    yield
    raise OSError("the end")
def test_well():
    pass
def test_skip():
    pytest.skip("no compiler")
def test_wrong():
    assert 1 == 2, "one is not two"
def test_torn(torn):
    pass
"""


def test_what_runs_without_the_hook_may_be_skipped_and_what_fails_is_told(tmp_path):
    (file := tmp_path / "test_outcomes.py").write_text(OUTCOMES)
    ends = run_unhooked(file, "")
    assert {name: end for name, (end, _) in ends.items()} == {
        "test_well": "passed",
        "test_skip": "skipped",
        "test_wrong": "failure",
        "test_torn": "error",
    }
    for name, said in (("skip", "no compiler"), ("wrong", "one is not two"), ("torn", "the end")):
        assert said in ends[f"test_{name}"][1]
