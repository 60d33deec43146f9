"""Machine code and the interpreter write the same numbers into the same arrays."""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from koopmpc.plants import compiled
from koopmpc.plants.compiled import Routine
from tests.example_plants import CartPole


def function() -> ca.Function:
    """Return a function with loops, matrices and elementary functions."""
    A, x = ca.SX.sym("A", 3, 3), ca.SX.sym("x", 3)
    step = ca.Function("step", [x, A], [ca.tanh(A @ x) + ca.sin(x)]).mapaccum("steps", 20)
    M, x0 = ca.MX.sym("M", 3, 60), ca.MX.sym("x0", 3)
    return ca.Function("march", [x0, M], [step(x0, M), ca.sum2(M**2)])


def results(routine_of) -> tuple[np.ndarray, np.ndarray, bool]:
    rng = np.random.default_rng(0)
    x, M = rng.standard_normal(3), rng.standard_normal((20, 3, 3))
    X, sums = np.zeros((20, 3)), np.zeros(3)
    routine = routine_of(function(), [x, M], [X, sums])
    routine.call()
    first = X.copy()
    x *= 2  # the same arrays are read again
    routine.call()
    assert not np.array_equal(first, X)
    return X, sums, routine.compiled


@pytest.mark.skipif(compiled.compiler() is None, reason="no C compiler here")
def test_machine_code_is_the_interpreter_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    fast = results(Routine)
    monkeypatch.setattr(compiled, "compiler", lambda: None)
    slow = results(Routine)
    assert (fast[2], slow[2]) == (True, False)
    assert np.array_equal(fast[0], slow[0])
    assert np.array_equal(fast[1], slow[1])


def test_what_cannot_be_compiled_is_interpreted() -> None:
    plant = km.discretize(CartPole(), 0.02, km.CVODES())
    x, u, x_next = np.array([0.1, 0, 0.2, 0]), np.array([1.0]), np.zeros(4)
    routine = Routine(plant.F, [x, u], [x_next])
    routine.call()
    assert not routine.compiled
    assert np.allclose(x_next, plant(x, u), rtol=1e-12)


def test_arrays_that_do_not_fit_are_refused() -> None:
    with pytest.raises(AssertionError, match="an array has 2 entries, the function 3"):
        Routine(function(), [np.zeros(2), np.zeros((20, 3, 3))], [np.zeros((20, 3)), np.zeros(3)])
    with pytest.raises(AssertionError, match="reads contiguous arrays"):
        Routine(function(), [np.zeros(6)[::2], np.zeros((20, 3, 3))], [np.zeros((20, 3)), np.zeros(3)])
