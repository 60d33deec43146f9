"""Factors of rows that come one after the other, and what is no outlier among them, against plain sums over all rows."""

import numpy as np
import pytest

from koopmpc.identify.fits.online import OutlierGate, ShadowModel
from koopmpc.identify.moments.rows import ForgettingMemory, WindowMemory, absorb, empty_factor

K = np.array([[1.0, 2.0], [-0.5, 0.3]])  # t = Kᵀ r, of two regressors


def factor(rows):
    R = empty_factor(rows.shape[1])
    absorb(R, rows)
    return R


def ready(nz=1, spread=0.0, size=1.0):
    """A gate that forecasts by K, with these mean squares, whose spread has been seen."""
    gate = OutlierGate(4, 2, nz)
    rng = np.random.default_rng(0)
    r = rng.normal(size=(40, 2))
    gate.first(np.hstack([r, r @ K]))
    gate.renew(factor(np.hstack([r, r @ K])), np.full(2, spread), np.full(4, size))
    gate._seen = 200
    return gate


def row(r, off=(0.0, 0.0)):
    return np.concatenate([r, np.asarray(r) @ K + off])[None]


@pytest.mark.parametrize(("count", "forgetting"), [(1, 0.9), (25, 0.97), (25, 1.0)])
def test_a_factor_that_forgets_is_that_of_the_weighted_rows(count, forgetting):
    rng = np.random.default_rng(1)
    blocks, waiting = [rng.normal(size=(count, 4)) for _ in range(6)], rng.normal(size=(3, 4))
    memory = ForgettingMemory(4, 2, forgetting, 1e-12)
    for block in blocks:
        memory.push(block)
    rows = np.vstack([*blocks, waiting])
    weights = forgetting ** np.arange(len(rows))[::-1]
    for pending, some in ((waiting, rows), (waiting[:0], rows[:-3])):
        R, weight = memory.factor(pending)
        own = weights[: len(some)] / weights[len(some) - 1]
        np.testing.assert_allclose(R.T @ R, (some * own[:, None]).T @ some, atol=1e-12 * len(rows))
        assert weight == pytest.approx(own.sum(), rel=1e-12)
    np.testing.assert_allclose(memory.R.T @ memory.R, memory.factor(waiting[:0])[0].T @ memory.factor(waiting[:0])[0])


def test_a_direction_without_news_keeps_its_floor_and_what_it_says():
    rng = np.random.default_rng(2)
    r = rng.normal(size=(50, 2))
    memory = ForgettingMemory(4, 2, 0.8, 1e-4)
    memory.push(np.hstack([r, r @ K]))
    most = np.abs(memory.R.diagonal()[:2]).copy()
    for _ in range(30):  # the second regressor is silent
        r = np.column_stack([rng.normal(size=10), np.zeros(10)])
        memory.push(np.hstack([r, r @ K]))
        most = np.maximum(most, np.abs(memory.R.diagonal()[:2]))
    R = memory.R
    np.testing.assert_allclose(np.linalg.solve(R[:2, :2], R[:2, 2:]), K, atol=1e-9)
    assert abs(R[1, 1]) == pytest.approx(0.01 * most[1])
    assert abs(R[0, 0]) > 0.1 * most[0]


@pytest.mark.parametrize(("length", "block"), [(7, 3), (6, 3), (2, 4), (20, 5)])
def test_a_window_is_the_factor_of_its_last_rows(length, block):
    rng = np.random.default_rng(3)
    window, rows = WindowMemory(3, length, block), np.empty((0, 3))
    for _ in range(12):
        new = rng.normal(size=(block, 3))
        window.push(new)
        rows = np.vstack([rows, new])
        for count in range(block):
            waiting = rng.normal(size=(count, 3))
            last = np.vstack([rows, waiting])[-length:]
            R, weight = window.factor(waiting)
            np.testing.assert_allclose(R.T @ R, last.T @ last, atol=1e-11)
            assert weight == len(last)


def test_spreads_and_sizes_are_means_over_the_first_hundred_rows_and_fade_by_a_hundredth_after_them():
    rng = np.random.default_rng(4)
    r, gate = rng.normal(size=(180, 2)), OutlierGate(4, 2, 1)
    rows = np.hstack([r, r @ K + 0.1 * rng.normal(size=(180, 2))])
    gate.first(rows[:10])
    assert gate.begun
    gate.learn(factor(np.hstack([r[:9], r[:9] @ K])))  # as many rows as say what K is
    assert gate.K is not None
    for k in range(10, 180):
        gate.keep(rows[k : k + 1].copy())

    def faded(squares, first):
        """The mean of the first `first` values, then a hundredth of each later one."""
        mean = squares[:first].mean(axis=0)
        for square in squares[first:]:
            mean = 0.99 * mean + 0.01 * square
        return mean

    np.testing.assert_allclose(gate._spread, faded((rows[10:, 2:] - r[10:] @ K) ** 2, 100))
    np.testing.assert_allclose(gate._size, faded(rows**2, 100))


@pytest.mark.parametrize(("rows", "learned"), [(8, False), (9, True)])
def test_forecasts_begin_after_four_rows_for_each_regressor(rows, learned):
    r = np.random.default_rng(0).normal(size=(rows, 2))
    gate = OutlierGate(4, 2, 1)
    gate.first(np.hstack([r, r @ K]))
    gate.learn(factor(np.hstack([r, r @ K])))
    assert (gate.K is not None) == learned
    if learned:
        np.testing.assert_allclose(gate.K, K)
        gate.learn(factor(np.zeros((3, 4))))  # rows that do not say what K is leave the one there was
        np.testing.assert_allclose(gate.K, K)


@pytest.mark.parametrize(("spread", "size", "limit"), [(0.04, 1.0, 6.0), (0.0, 4.0, 0.6), (1e-6, 1.0, 0.3)])
@pytest.mark.parametrize("column", [0, 1])
def test_the_gate_stands_at_thirty_spreads_of_which_each_is_a_hundredth_of_its_column_at_least(
    spread, size, limit, column
):
    for share, kept in ((0.99, 1), (-0.99, 1), (1.01, 0), (-1.01, 0)):
        gate = ready(spread=spread, size=size)
        assert gate.keep(row([0.1, 0.2], limit * share * np.eye(2)[column])) == kept


def test_an_outlier_counts_as_if_it_stood_at_the_gate_and_is_no_part_of_the_sizes():
    gate = ready(spread=0.04)
    before = gate._size.copy()
    gate.keep(row([0.1, 0.2], [1e6, 0.0]))
    assert gate._spread[0] == pytest.approx(0.04 * (0.99 + 0.01 * 900))
    np.testing.assert_array_equal(gate._size, before)
    assert gate.keep(row([0.1, 0.2])) == 1
    assert (gate._size != before).any()


def test_innovations_are_judged_once_twenty_have_been_seen():
    for seen, kept in ((19, 1), (20, 0)):
        gate = ready(spread=0.04)
        gate._seen = seen
        assert gate.keep(row([0.1, 0.2], [100.0, 0.0])) == kept


def test_without_forecasts_a_value_beyond_a_thousand_sizes_is_an_outlier_except_in_an_input():
    rng = np.random.default_rng(0)
    for column, off, kept in ((0, 999.0, 1), (0, 1001.0, 0), (2, 1001.0, 0), (3, -1001.0, 0), (1, 1e9, 1)):
        gate = OutlierGate(4, 2, 1)  # one observable, one input, two targets
        gate.first(rng.choice([-1.0, 1.0], size=(40, 4)))
        one = np.ones((1, 4))
        one[0, column] = off
        assert gate.keep(one) == kept
        few = OutlierGate(4, 2, 1)  # twenty rows say nothing of their size yet
        few.first(rng.choice([-1.0, 1.0], size=(20, 4)))
        assert few.keep(one.copy()) == 1
    gate = OutlierGate(4, 2, 1)  # a column that has been zero has no size
    gate.first(np.hstack([np.zeros((40, 1)), np.ones((40, 3))]))
    assert gate.keep(np.full((1, 4), 5.0)) == 1


def test_a_far_value_counts_as_if_it_stood_at_a_thousand_sizes_while_it_is_not_judged():
    gate = OutlierGate(4, 2, 1)
    gate.first(np.ones((99, 4)))
    far = np.ones((1, 4))
    far[0, 0] = 1e8
    assert gate.keep(far) == 0
    np.testing.assert_allclose(gate._size, [1 + 0.01 * (1e6 - 1), 1, 1, 1])


def test_kept_rows_move_to_the_front_in_their_order():
    gate = ready(spread=0.04)
    rows = np.vstack([row([k, 1.0], [1e3 * (k % 2), 0.0]) for k in range(6)])
    whole = rows.copy()
    assert gate.keep(rows) == 3
    np.testing.assert_array_equal(rows[:3], whole[::2])


def test_the_first_rows_are_compared_with_all_others():
    rows = np.ones((32, 4)) + 0.1 * np.random.default_rng(0).normal(size=(32, 4))
    rows[5, 0], rows[9, 3], rows[12, 1] = 1e4, -1e4, 1e9  # an observable, a target, an input
    whole, gate = rows.copy(), OutlierGate(4, 2, 1)
    assert gate.first(rows) == 30
    kept = np.delete(whole, [5, 9], axis=0)
    np.testing.assert_array_equal(rows[:30], kept)
    np.testing.assert_allclose(gate._size, (kept**2).mean(axis=0))
    silent = np.zeros((32, 4))
    silent[3] = 1.0  # a column that was zero but once is no outlier
    assert OutlierGate(4, 2, 1).first(silent) == 32
    two = np.ones((32, 4))
    two[3:5, 0] = 1e4, 1.1e4  # two that agree are no accident
    assert OutlierGate(4, 2, 1).first(two) == 32


def test_signals_have_fallen_after_twenty_rows_in_sequence_below_a_hundredth():
    for rows, broken, low, fell in (
        (19, None, 0.0095, False), (20, None, 0.0095, True), (25, 10, 0.0095, False), (25, 2, 0.0095, True),
        (40, None, 0.0101, False),
    ):  # fmt: skip
        gate = ready(spread=1.0)
        for k in range(rows):
            small = 1.0 if k == broken else low
            gate.keep(row([small, 1.0]))
            gate._size[:] = 1.0
        assert gate.fell == fell
    gate = ready(spread=1.0)
    for _ in range(40):  # an input that rests is no signal that fell
        gate.keep(row([1.0, 0.001]))
    assert not gate.fell


def test_a_shadow_model_is_judged_by_means_over_the_second_half():
    rng = np.random.default_rng(0)
    rival, first = ShadowModel(ForgettingMemory(4, 2, 0.9, 0.01), 2, 10.0), 1.5 * K
    pushed, errors, squares = [], [], []
    for k in range(33):  # blocks of three: 99 rows of a period of 100
        r = rng.normal(size=(3, 2))
        rows = np.hstack([r, r @ K + 0.1 * rng.normal(size=(3, 2))])
        if 3 * k >= 50:
            R = rival.memory.R
            own = np.linalg.solve(R[:2, :2], R[:2, 2:])
            errors.append(((rows[:, 2:] - rows[:, :2] @ np.array([first, own])) ** 2).swapaxes(0, 1))
            squares.append(rows**2)
        assert not rival.push(rows, first)
        pushed.append(rows)
    np.testing.assert_allclose(rival._errors, np.vstack(errors).mean(axis=0))
    np.testing.assert_allclose(rival.spread, np.vstack(errors).mean(axis=0)[1])
    np.testing.assert_allclose(rival.size, np.vstack(squares).mean(axis=0))
    assert rival.rows == 99
    assert rival.push(rows[:1], first)  # the end of the period


@pytest.mark.parametrize(("noise", "takes_over"), [((0.1, 0.1), True), ((0.3, 0.1), True), ((0.1, 4.0), False)])
def test_a_shadow_model_must_be_twice_as_good_in_one_column_and_no_worse_in_the_others(noise, takes_over):
    """The first factor is off by half a unit in the first column, and exact in the second."""
    rng = np.random.default_rng(0)
    rival = ShadowModel(ForgettingMemory(4, 2, 0.95, 0.01), 2, 10.0)
    first = K + np.array([0.5, 0.0])
    answers = []
    for _ in range(100):
        r = rng.normal(size=(1, 2))
        noisy = noise * rng.normal(size=(1, 2))
        forecast = np.hstack([r, r @ K + noisy * [1, 0]])
        rival.memory.push(np.hstack([r, r @ K + noisy]))  # the rival alone has learned from noise in the second
        answers.append(rival.push(forecast, first))
    assert any(answers) == takes_over


def test_a_shadow_model_needs_both_forecasts():
    rng = np.random.default_rng(0)
    rival = ShadowModel(ForgettingMemory(4, 2, 0.9, 0.01), 2, 10.0)
    for _ in range(150):
        r = rng.normal(size=(1, 2))
        assert not rival.push(np.hstack([r, r @ K]), None)
    silent = ShadowModel(ForgettingMemory(4, 2, 0.9, 0.01), 2, 10.0)
    assert not any(silent.push(np.zeros((1, 4)), K) for _ in range(150))


@pytest.mark.parametrize(
    ("first", "second", "size", "better"),
    [
        ([1.0, 1.0], [0.24, 0.9], 1.0, True),
        ([1.0, 1.0], [0.26, 0.26], 1.0, False),  # by more than twice, as a root of mean squares
        ([1.0, 1.0], [0.1, 1.1], 1.0, False),  # worse in the other column
        ([1.0, 0.001], [0.1, 0.009], 1.0, True),  # a hundredth of a column's mean square is no matter
        ([1.0, 0.001], [0.1, 0.011], 1.0, False),
        ([1.1e-6, 0.0], [0.0, 0.0], 1.0, True),  # off by more than a thousandth of the column
        ([0.9e-6, 0.0], [0.0, 0.0], 1.0, False),
        ([1.0, 1.0], [0.0, 0.0], 1.1e6, False),
    ],
)
def test_when_a_shadow_model_is_better(first, second, size, better):
    rival = ShadowModel(ForgettingMemory(4, 2, 0.9, 0.01), 2, 10.0)
    rival.rows, rival._judged = 99, 10**12  # the last row of a period changes no mean
    rival._errors, rival.size = np.array([first, second]), np.full(4, size)
    r = np.random.default_rng(0).normal(size=(20, 2))
    rival.memory.push(np.hstack([r, r @ K]))
    assert rival.push(row([0.1, 0.2]), K) == better
    assert rival._judged == 0


@pytest.mark.parametrize(("off", "takes_over"), [(0.0012, True), (0.0008, False)])
def test_a_shadow_model_takes_over_where_the_first_factor_is_off_by_more_than_a_thousandth(off, takes_over):
    rng, K = np.random.default_rng(0), np.array([[1.0], [-0.5]])
    rival = ShadowModel(ForgettingMemory(3, 2, 0.9, 0.01), 2, 10.0)
    first = K * (1 + off)  # t is forecast as (1 + off) t: off by this share of it
    answers = [rival.push(np.hstack([r, r @ K]), first) for r in rng.normal(size=(200, 1, 2))]
    assert any(answers) == takes_over


def test_a_shadow_model_judges_by_the_second_half_of_each_of_its_periods():
    rng, K = np.random.default_rng(0), np.array([[1.0], [-0.5]])
    for begin, takes_over in ((0, False), (50, True)):  # where the first factor is off
        rival = ShadowModel(ForgettingMemory(3, 2, 0.9, 0.01), 2, 10.0)
        answers = [
            rival.push(np.hstack([r, r @ K]), K * (1 + 0.1 * (begin <= k % 100 < begin + 50)))
            for k, r in enumerate(rng.normal(size=(300, 1, 2)))
        ]
        assert any(answers) == takes_over
        assert all(k % 100 == 99 for k, yes in enumerate(answers) if yes)  # at the end of a period
