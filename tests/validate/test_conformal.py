"""Conformal bands: their rank, their coverage over redraws, and what feedback does to it."""

import numpy as np
import pytest

import koopmpc as km

MODEL = km.LinearPredictor([[0.9]], [[1.0]], [[1.0]], km.State(), 0.1, ("x",), ("u",))
STEPS = 8


def nonlinear(count: int, rng: np.random.Generator, gain: float = 0.0, steps: int = STEPS) -> km.Episodes:
    """x⁺ = 0.9 x + 0.3 sin 3x + u, u = noise − gain (x − 0.5), from x ~ U[−2, 2]."""
    x = rng.uniform(-2, 2, count)
    X, U = [x], []
    for _ in range(steps):
        U.append(rng.uniform(-0.3, 0.3, count) - gain * (x - 0.5))
        x = 0.9 * x + 0.3 * np.sin(3 * x) + U[-1]
        X.append(x)
    runs = [km.Episode(X=own, U=u) for own, u in zip(np.array(X).T[:, :, None], np.array(U).T[:, :, None], strict=True)]
    return km.Episodes(runs, 0.1, ("x",), ("u",))


def test_the_band_is_the_ranked_score_times_the_scale() -> None:
    rng = np.random.default_rng(0)
    band = km.validate.conformal(MODEL, nonlinear(60, rng), STEPS, rng=0)
    assert band.episodes == 45
    fresh = nonlinear(29, rng)  # as long as the horizon: every forecast starts at 0
    worst = []
    for e in fresh:
        gap = np.abs(e.X[1:] - MODEL.rollout(e.X[0], e.U)[1:])
        worst.append(np.max(gap / band.scale))
    again = band.recalibrate(MODEL, fresh)
    assert again.quantile == pytest.approx(np.sort(worst)[26], rel=1e-12)  # ⌈30 · 0.9⌉ = 27th of 29
    assert np.array_equal(again.scale, band.scale)
    assert np.allclose(again.width, again.quantile * band.scale)
    drawn = km.validate.forecast(MODEL, fresh[0], STEPS, bands=again)
    for end, sign in ((drawn.low, -1), (drawn.high, 1)):
        np.testing.assert_allclose(end[1:], drawn.predicted[1:] + sign * again.width)
    assert again.measure_coverage(MODEL, fresh).share == pytest.approx(27 / 29)


@pytest.mark.parametrize(("level", "needed"), [(0.9, 9), (0.95, 19), (0.5, 1)])
def test_too_few_episodes_give_an_infinite_band(level: float, needed: int) -> None:
    rng = np.random.default_rng(1)
    band = km.validate.conformal(MODEL, nonlinear(40, rng), STEPS, level=level)
    assert band.needed == needed
    assert np.isfinite(band.recalibrate(MODEL, nonlinear(needed, rng)).width).all()
    if needed > 1:
        few = band.recalibrate(MODEL, nonlinear(needed - 1, rng))
        assert np.isinf(few.width).all()
        assert few.measure_coverage(MODEL, nonlinear(5, rng)).share == 1.0


def test_a_perfect_model_has_a_band_of_rounding() -> None:
    rng = np.random.default_rng(2)
    runs = []
    for _ in range(30):
        U = rng.standard_normal((STEPS, 1))
        runs.append(km.Episode(X=MODEL.rollout(rng.standard_normal(1), U), U=U))
    band = km.validate.conformal(MODEL, km.Episodes(runs, 0.1, ("x",), ("u",)), STEPS)
    assert band.width.max() < 1e-13


def test_wilsons_interval_holds_the_share() -> None:
    rng = np.random.default_rng(3)
    band = km.validate.conformal(MODEL, nonlinear(60, rng), STEPS)
    covered = band.measure_coverage(MODEL, nonlinear(50, rng))
    assert 0 <= covered.low <= covered.share <= covered.high <= 1
    assert covered.episodes == 50
    # p̂ = 45/50: Wilson's interval is [0.786, 0.957] (Brown, Cai & DasGupta, Stat. Sci. 16, 2001)
    p, z, n = covered.share, 1.959964, 50
    for edge in (covered.low, covered.high):
        if 0 < edge < 1:
            assert abs(p - edge) == pytest.approx(z * np.sqrt(edge * (1 - edge) / n), rel=1e-6)


def mean_coverage(redraws: int, seed: int) -> float:
    rng = np.random.default_rng(seed)
    shares = []
    for _ in range(redraws):
        band = km.validate.conformal(MODEL, nonlinear(132, rng, steps=12), STEPS, rng=rng)
        assert band.episodes == 99
        shares.append(band.measure_coverage(MODEL, nonlinear(100, rng, steps=12), rng=rng).share)
    return float(np.mean(shares))


def test_mean_coverage_over_a_few_redraws() -> None:
    # one redraw spreads by √(0.9·0.1/101 + 0.9·0.1/100) = 0.042
    assert abs(mean_coverage(20, seed=4) - 0.9) < 4 * 0.042 / np.sqrt(20)


@pytest.mark.slow
def test_mean_coverage_over_redraws_is_ninety_percent() -> None:
    assert abs(mean_coverage(400, seed=5) - 0.9) < 0.01


def test_feedback_breaks_the_promise_and_calibrating_on_it_restores_it() -> None:
    rng = np.random.default_rng(6)
    chance = 4 * np.sqrt(0.9 * 0.1 * (1 / 300 + 1 / 400))  # calibration and test both draw
    band = km.validate.conformal(MODEL, nonlinear(400, rng), STEPS, rng=rng)
    assert abs(band.measure_coverage(MODEL, nonlinear(400, rng), rng=rng).share - 0.9) < chance
    loop = nonlinear(300, rng, gain=0.8)  # holds x where sin 3x is largest
    assert band.measure_coverage(MODEL, loop, rng=rng).share < 0.9 - chance
    again = band.recalibrate(MODEL, loop, rng=rng)
    assert again.quantile > band.quantile
    fresh = again.measure_coverage(MODEL, nonlinear(400, rng, gain=0.8), rng=rng)
    assert abs(fresh.share - 0.9) < chance


def test_one_record_is_cut_into_blocks_whose_band_covers_the_next_record() -> None:
    shares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        record, fresh = nonlinear(1, rng, steps=900), nonlinear(1, rng, steps=900)
        band = km.validate.conformal(MODEL, record, STEPS, rng=seed)
        assert band.episodes == 45  # of 60 blocks a quarter gives the scale
        blocks = fresh.with_episodes([fresh[0].cut(a, a + STEPS) for a in range(0, 900 - STEPS, STEPS)])
        shares.append(band.measure_coverage(MODEL, blocks, rng=rng).share)
    assert abs(np.mean(shares) - 42 / 46) < 3 * np.sqrt(0.09 / (8 * 45))  # the rank of 45 scores
    two = nonlinear(1, np.random.default_rng(0), steps=2 * STEPS)
    assert np.isinf(km.validate.conformal(MODEL, two, STEPS).quantile)


def test_bad_input_is_refused() -> None:
    rng = np.random.default_rng(7)
    data = nonlinear(4, rng)
    with pytest.raises(km.errors.DataError, match="level is 1; pass a probability between 0 and 1"):
        km.validate.conformal(MODEL, data, STEPS, level=1)
    with pytest.raises(km.errors.DataError, match="a conformal band needs two episodes"):
        km.validate.conformal(MODEL, data[:1], STEPS)
    with pytest.raises(km.errors.DataError, match="has 8 steps, the horizon is 9"):
        km.validate.conformal(MODEL, data, 9)
    assert isinstance(km.validate.conformal(MODEL, data, STEPS), km.validate.ConformalBand)
