"""Persistency of excitation: known orders of known signals; feedback: how much of u is a function of ψ(x)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km


def driven(*inputs: np.ndarray) -> km.Episodes:
    rng = np.random.default_rng(0)
    return km.Episodes([km.Episode(X=rng.standard_normal((len(U) + 1, 1)), U=U) for U in inputs], 0.1)


@given(st.integers(1, 4), st.integers(0, 99))
def test_a_sum_of_m_sines_is_of_order_two_m(m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rates = rng.permutation(np.linspace(0.3, 2.8, 7))[:m]
    k = np.arange(300)
    u = sum(rng.uniform(0.5, 2) * np.sin(rate * k + rng.uniform(0, 6)) for rate in rates)
    assert km.validate.persistency(driven(u[:, None]), 12).order == 2 * m
    offset = km.validate.persistency(driven(u[:, None] + 5), 12)
    assert offset.order == 2 * m + 1
    assert np.isinf(offset.conditions[2 * m + 1 :]).all()
    assert offset.windows == 300 - 11


def test_noise_excites_to_any_order_and_a_constant_to_order_one() -> None:
    rng = np.random.default_rng(1)
    noise = km.validate.persistency(driven(rng.standard_normal((9000, 2)), rng.standard_normal((400, 2))), 15)
    assert noise.order == noise.asked == 15
    assert noise.conditions[0] < 1.1
    assert (np.diff(noise.conditions) >= -1e-9).all()
    assert noise.windows == 9000 - 14 + 400 - 14
    assert km.validate.persistency(driven(np.ones((50, 1))), 5).order == 1
    assert km.validate.persistency(driven(np.zeros((50, 1))), 5).order == 0
    one = rng.standard_normal((50, 1))
    assert km.validate.persistency(driven(np.hstack([one, 2 * one])), 3).order == 0  # two inputs, one direction


def test_short_episodes_count_together_and_too_few_windows_do_not_suffice() -> None:
    rng = np.random.default_rng(2)
    many = driven(*(rng.standard_normal((6, 1)) for _ in range(20)))
    assert km.validate.persistency(many, 6).order == 6
    assert km.validate.persistency(many[:3], 6).order == 3  # three windows of six
    with pytest.raises(km.errors.DataError, match="order is 7, the longest episode has 6 steps; pass 6 or less"):
        km.validate.persistency(many, 7)
    with pytest.raises(km.errors.DataError, match="the episodes have no inputs"):
        km.validate.persistency(km.Episodes([km.Episode(X=[[1.0], [2.0]])], 0.1), 1)


def test_feedback_is_the_share_of_u_that_the_observables_explain() -> None:
    share = km.validate.feedback_share
    rng = np.random.default_rng(3)
    runs = []
    for _ in range(30):
        X = rng.uniform(-1, 1, (101, 2))
        noise = rng.uniform(-1, 1, (100, 1))
        law = 3 + X[:-1] @ [[1.0], [-2.0]]
        runs.append(km.Episode(X=X, U=np.hstack([law, law + noise, noise, 3 + 0 * noise, X[:-1, :1] ** 3])))
    data = km.Episodes(runs, 0.1)
    found = share(data, km.State() + km.Constant())
    var = (1 + 4) / 3
    assert found[0] == pytest.approx(1, abs=1e-6)
    assert found[1] == pytest.approx(var / (var + 1 / 3), abs=0.01)
    assert found[2] < 0.01
    assert found[3] == pytest.approx(1, abs=1e-6)  # a constant input is a function of the Constant
    assert found[4] == pytest.approx(21 / 25, abs=0.01)  # correlation² of x and x³ on [−1, 1]
    cubed = share(data, km.State() + km.Constant() + km.Monomials(3))
    assert cubed[4] == pytest.approx(1, abs=1e-6)
    raw = share(data, km.State())  # without a Constant the mean is energy that x lacks
    assert raw[0] == pytest.approx(var / (var + 9), abs=0.01)


@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_a_smooth_input_is_no_feedback_where_the_model_holds_past_inputs(gain: float) -> None:
    """u_k = .98 u_{k−1} + e_k is known from its past; only under feedback do outputs tell what the past leaves open."""
    rng = np.random.default_rng(4)
    Y, U, slow = np.zeros((2001, 1)), np.zeros((2000, 1)), 0.0
    for k in range(2000):
        slow = 0.98 * slow + 0.1 * rng.standard_normal()
        U[k] = slow - gain * Y[k]
        Y[k + 1] = 0.7 * Y[k] + U[k] + 0.2 * rng.standard_normal()
    data, psi = km.Episodes([km.Episode(X=Y, U=U)], 0.1), km.State() + km.Constant()
    share = float(km.validate.feedback_share(data, psi, embedding=km.Delay(2))[0])
    assert share > 0.5 if gain else share < 0.1
    wave = km.Episodes([km.Episode(X=Y, U=np.sin(0.3 * np.arange(2000.0))[:, None])], 0.1)
    assert km.validate.feedback_share(wave, psi, embedding=km.Delay(2))[0] < 0.1  # its past says all of it
