"""What each excitation promises: bounds, levels, spectra, frequencies, feedback."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.roundtrip import returned

SEEDS = st.integers(0, 2**32 - 1)


def generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


@given(SEEDS, st.integers(1, 7), st.integers(1, 40))
def test_noise_stays_in_its_box_and_is_held(seed: int, hold: int, steps: int) -> None:
    U = km.Noise([-1, 2], [1, 2.5], hold).sequence(steps, 0.1, generator(seed))
    assert U.shape == (steps, 2)
    assert (U >= [-1, 2]).all()
    assert (U <= [1, 2.5]).all()
    moved = np.flatnonzero((np.diff(U, axis=0) != 0).any(axis=1)) + 1
    assert moved.tolist() == list(range(hold, steps, hold))


def test_noise_fills_its_box_evenly() -> None:
    u = km.Noise(-2, 6).sequence(20_000, 0.1, generator(0)).ravel()
    counts = np.histogram(u, bins=8, range=(-2, 6))[0]
    assert np.abs(counts - 2500).max() < 5 * np.sqrt(2500)


@pytest.mark.parametrize("order", range(3, 14))
def test_registers_are_of_maximal_length(order: int) -> None:
    bits = km.data.PRBS(0, 1, 1, order).sequence(2**order - 1, 0.1, generator(0)).ravel()
    words = {tuple(np.roll(bits, -k)[:order].tolist()) for k in range(len(bits))}
    assert len(bits) == len(words) == 2**order - 1  # every state of the register but zero, once
    assert bits.sum() == 2 ** (order - 1)


@given(SEEDS, st.integers(1, 5), st.integers(4, 9))
def test_prbs_has_two_levels_and_a_flat_spectrum(seed: int, hold: int, order: int) -> None:
    period = 2**order - 1
    u = km.data.PRBS(-1, 1, hold, order).sequence(2 * period * hold, 0.1, generator(seed)).ravel()
    assert set(u.tolist()) == {-1.0, 1.0}
    assert (u[: period * hold] == u[period * hold :]).all()
    bits = u[: period * hold : hold]
    assert bits.sum() == 1  # balanced but for one
    power = np.abs(np.fft.fft(bits)) ** 2
    np.testing.assert_allclose(power[1:], period + 1, rtol=1e-9)


def test_the_inputs_of_a_prbs_are_hardly_correlated() -> None:
    U = km.data.PRBS([-1, -1, -1], [1, 1, 1], order=8).sequence(255, 0.1, generator(0))
    np.testing.assert_allclose(U.T @ U, 256 * np.eye(3) - 1, atol=1e-9)


@given(SEEDS, st.sampled_from([3, [1, 4, 9], [7]]))
def test_multisine_holds_only_its_harmonics_and_reaches_its_peak(seed: int, harmonics: int | list[int]) -> None:
    U = km.data.Multisine([2, 0.5], 2.0, harmonics, offset=[1, 0]).sequence(120, 0.05, generator(seed))
    np.testing.assert_allclose(U[:40], U[40:80], rtol=0, atol=0)
    one = U[:40] - [1, 0]
    np.testing.assert_allclose(np.abs(one).max(axis=0), [2, 0.5], rtol=1e-12)
    lines = np.abs(np.fft.rfft(one, axis=0))
    wanted = [1, 2, 3] if harmonics == 3 else harmonics
    others = [j for j in range(21) if j not in wanted]  # type: ignore[operator]
    assert lines[others].max() < 1e-10
    for column in lines[wanted].T:
        np.testing.assert_allclose(column, column[0], rtol=1e-9)
        assert column[0] > 1e-3


def local_frequency(u: np.ndarray, dt: float) -> float:
    """Return f of u_{k−1} + u_{k+1} = 2 cos(2π f dt) u_k, by least squares."""
    middle = u[1:-1]
    return float(np.arccos(middle @ (u[:-2] + u[2:]) / (2 * middle @ middle)) / (2 * np.pi * dt))


@pytest.mark.parametrize(("f0", "f1"), [(0.5, 4.0), (4.0, 0.5)])
def test_a_chirp_runs_from_f0_to_f1(f0: float, f1: float) -> None:
    dt, duration = 0.01, 200.0
    u = km.data.Chirp(3.0, f0, f1, duration, offset=-1.0).sequence(40_000, dt, generator(0)).ravel() + 1
    assert np.abs(u).max() == pytest.approx(3, rel=1e-3)
    assert (u[:20_000] == u[20_000:]).all()
    assert local_frequency(u[:400], dt) == pytest.approx(f0, rel=0.1)
    assert local_frequency(u[19_600:20_000], dt) == pytest.approx(f1, rel=0.1)
    assert local_frequency(u[9800:10_200], dt) == pytest.approx((f0 + f1) / 2, rel=0.02)


@given(SEEDS)
def test_feedback_is_its_formula(seed: int) -> None:
    rng = generator(seed)
    K, x_ref, u_ref, y = rng.normal(size=(2, 3)), rng.normal(size=3), rng.normal(size=2), rng.normal(size=3)
    noise = km.Noise([-1, -1], [1, 1], hold=2)
    plain = km.Feedback(K, x_ref=x_ref, u_ref=u_ref)
    np.testing.assert_allclose(plain.start(5, 0.1, rng)(0, y), u_ref - K @ (y - x_ref), rtol=1e-12)
    noisy = km.Feedback(K, noise, x_ref, u_ref, u_min=-0.5, u_max=[0.1, np.inf]).start(5, 0.1, generator(1))
    V = noise.sequence(5, 0.1, generator(1))
    for k in range(5):
        expected = np.minimum(np.maximum(u_ref - K @ (y - x_ref) + V[k], -0.5), [0.1, np.inf])
        np.testing.assert_allclose(noisy(k, y), expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    "excitation",
    [km.Noise(-1, 1, 2), km.data.PRBS([0, 0], [1, 2]), km.data.Multisine(1, 1.0, 3), km.data.Chirp(1, 1, 2, 5), km.Feedback([[1, 2]], km.Noise(-1, 1))],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_excitations_are_values_and_follow_the_seed(excitation: Any) -> None:
    assert returned(excitation) == excitation
    y = np.zeros(2)
    first, again = (excitation.start(30, 0.05, generator(3)) for _ in range(2))
    U = np.array([first(k, y) for k in range(30)])
    assert U.shape == (30, excitation.nu)
    assert np.array_equal(U, [again(k, y) for k in range(30)])
    other = excitation.start(30, 0.05, generator(4))
    same = np.array_equal(U, [other(k, y) for k in range(30)])
    assert same == isinstance(excitation, km.data.Chirp)  # the one with nothing random in it
