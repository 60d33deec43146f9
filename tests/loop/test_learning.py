"""What Adaptive measures and decides, step by step: its forecasts, what it learns from, which model is in use."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import koopmpc as km
from koopmpc.loop.adaptive import LearnedPair

A, B, E = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[0.1], [0.5]]), np.array([[0.3], [-0.2]])
NAMES = ("a", "b"), ("u",)


def model(scale: float = 1.0) -> km.LinearPredictor:
    return km.LinearPredictor(scale * A, B, np.eye(2), km.State(), 0.1, *NAMES, E=E)


def data() -> km.Episodes:
    rng, X = np.random.default_rng(0), [np.ones(2)]
    U, W = rng.standard_normal((2, 40, 1))
    for u, w in zip(U, W, strict=True):
        X.append(A @ X[-1] + B @ u + E @ w)
    return km.Episodes([km.Episode(X=np.array(X), U=U, W=W)], 0.1, *NAMES)


def learning(**options) -> km.supervise.Adaptive:
    mpc = km.KoopmanMPC(model(), km.Cost(1, 0.1), km.Limits(-9, 9), 4)
    return km.supervise.Adaptive(mpc, km.OnlineEDMD.start(data(), km.State()), **options)


def path(rng: np.random.Generator, steps: int) -> list[LearnedPair]:
    """Return pairs that follow one another."""
    X = [*rng.standard_normal((steps + 1, 2))]
    U, W = rng.standard_normal((2, steps, 1))
    return [LearnedPair(X[k], U[k], W[k], X[k + 1]) for k in range(steps)]


@pytest.mark.parametrize("steps", [1, 3, 20])
def test_errors_are_those_of_forecasts_from_each_pair_on_as_far_as_pairs_follow_one_another(steps):
    rng, one = np.random.default_rng(1), learning(memory=50)
    pairs = path(rng, 5) + path(rng, 1) + path(rng, 3)
    one._memory.extend(pairs)
    changes = np.array([pair.x_next - pair.x for pair in pairs])
    size, used, wanted = np.sqrt(np.mean(changes**2, axis=0)), model(1.1), []
    for ahead in range(1, steps + 1):
        for i in range(len(pairs) - ahead + 1):
            part = pairs[i : i + ahead]
            if any(then.x is not before.x_next for before, then in pairwise(part)):
                continue
            x = part[0].x
            for pair in part:
                x = used.A @ x + used.B @ pair.u + used.E @ pair.w
            wanted.append((part[-1].x_next - x) / size)
    np.testing.assert_allclose(one._errors(used, pairs, steps), wanted, atol=1e-12)
    every = [each for each in wanted if steps == one.horizon]
    if every:
        assert one._error(used, pairs) == pytest.approx(np.sqrt(np.mean(np.square(every))))


def test_the_error_of_a_model_looks_as_far_ahead_as_the_horizon():
    rng, one = np.random.default_rng(2), learning()
    pairs = path(rng, 8)
    one._memory.extend(pairs)
    found = one._errors(model(1.2), pairs, one.horizon)
    assert one._error(model(1.2), pairs) == pytest.approx(np.sqrt(np.mean(found**2)))
    assert len(found) == 8 + 7 + 6 + 5


def test_a_state_that_does_not_move_has_size_one():
    one = learning()
    assert one._size.tolist() == [1, 1]
    still = LearnedPair(np.zeros(2), np.zeros(1), np.zeros(1), np.array([3.0, 0.0]))
    one._memory.append(still)
    assert one._size.tolist() == [3, 1]


def test_a_model_suffices_where_each_state_is_missed_by_half_more_than_its_own_data_at_most():
    rng, one = np.random.default_rng(3), learning()
    pairs = path(rng, 300)  # so many that chance explains less than a half more
    one._memory.extend(pairs)
    missed = np.array([p.x_next - A @ p.x - B @ p.u - E @ p.w for p in pairs])
    usual = np.sqrt(np.mean(missed**2, axis=0))
    assert not one._suffices(model(), pairs)  # a model that was given has no data
    for share, wanted in (([1 / 1.49, 1 / 1.49], True), ([1 / 1.49, 1 / 1.51], False), ([1 / 1.51, 1.0], False)):
        one._usual = usual * share
        assert one._suffices(model(), pairs) == wanted


def test_a_few_samples_that_are_off_are_left_out_and_a_third_in_sequence_is_a_change(monkeypatch):
    one = learning(outlier=4.0, memory=8)
    script = [1.0, 50.0, 1.2, 0.8, 3.9, 4.5, 0.9, 9.0, 9.0, 1.0, 9.0, 9.0, 9.0, 9.0, 1.0, 30.0, 30.0, 30.0, 30.0, 30.0]
    learned, kept, off = [], [], 0
    for misfit in script:  # the rule once more: the median of what was kept last, once there are three
        usual = np.median(kept[-8:]) if len(kept) >= 3 else np.inf
        off = off + 1 if misfit > 4.0 * usual else 0
        learned.append(not 0 < off < 3)
        if learned[-1]:
            kept.append(misfit)
    assert False in learned
    misfits, got = iter(script), []
    monkeypatch.setattr(one, "_errors", lambda *_: np.array([[0.6, 0.8]]) * next(misfits))
    monkeypatch.setattr(one.online, "learn", lambda x, u, x_next, w: got.append((*x, *u, *x_next, *w)))
    rng = np.random.default_rng(4)
    before, wanted = (rng.standard_normal(2), np.ones(1), np.ones(1), True), []
    for k, keeps in enumerate(learned):
        one._before = before
        x, applied = rng.standard_normal(2), None if k % 2 else [5.0]
        one._take(x, applied)
        if keeps:
            wanted.append((*before[0], *(before[1] if k % 2 else [5.0]), *x, *before[2]))
        before = x, rng.standard_normal(1), rng.standard_normal(1), True
    assert got == wanted
    assert (one.learned, one.skipped) == (learned.count(True), learned.count(False))
    assert len(one._memory) == 8


@pytest.mark.parametrize(
    ("x", "applied", "inside"),
    [([1.0, 1.0], None, True), ([np.nan, 0.0], None, True), ([2.0, 0.0], [1e31], True), ([2.0, 0.0], None, False)],
)
def test_nothing_is_learned_where_nothing_moved_or_nothing_is_known(x, applied, inside):
    one = learning()
    one._before = np.ones(2), np.zeros(1), np.zeros(1), inside
    one._take(np.array(x), applied)
    assert (one.learned, one.skipped, len(one._memory)) == (0, 1, 0)


def test_what_was_applied_is_told_to_the_controller_and_kept_as_it_was():
    one, given, told = learning(), np.array([0.7]), []
    one(np.ones(2), [0, 0], w=[0.1])
    inner, one.controller = one.controller, Told(one.controller, told)
    one(np.array([0.5, 0.2]), [0, 0], given, w=[0.1])
    given[:] = 9.0
    assert [each.tolist() for each in told] == [[0.7]]
    assert one._memory[-1].u.tolist() == [0.7]
    assert inner is one.controller.inner


class Told:
    """A controller that notes the inputs it is told."""

    def __init__(self, inner, told):
        self.inner, self.told = inner, told

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def __call__(self, y, reference, applied, w):
        self.told.append(np.array(applied))
        return self.inner(y, reference, applied, w)


def test_the_memory_is_looked_at_every_so_many_steps_once_it_has_as_many_pairs(monkeypatch):
    for every, memory, first in ((3, 5, 6), (4, 2, 4), (2, 9, 4)):
        one, looked = learning(every=every, memory=memory), []
        monkeypatch.setattr(one, "_renew", lambda one=one, looked=looked: looked.append(one._steps))
        x, rng = np.ones(2), np.random.default_rng(0)
        for _ in range(12):
            one(x, [0, 0], w=[0.1])
            x = rng.standard_normal(2)
        assert looked == list(range(first, 13, every))
        assert one._memory.maxlen == memory
    assert learning()._memory.maxlen == 20


class Trial:
    """An Adaptive whose models have the errors that are written down, and which learned as many pairs as is said."""

    def __init__(self, monkeypatch, errors, suffices=False):
        self.one, self.used = learning(memory=10), []
        self.errors, self.suffices = errors, suffices
        self.first, self.new, self.old = self.one._first, model(1.1), model(1.2)
        monkeypatch.setattr(self.one, "_suffices", lambda *_: self.suffices)
        monkeypatch.setattr(self.one, "_error", lambda model, _: self.errors[self.named(model)])
        monkeypatch.setattr(self.one.online, "predictor", lambda: self.new)

    def named(self, model):
        return next(name for name in ("first", "new", "old") if getattr(self, name) is model)

    def renew(self, learned):
        self.one.learned = learned
        self.one._renew()
        counts = self.one.renewed, self.one.returned, self.one.refused
        return self.named(self.one.predictor), self.one._on_trial is not None, *counts


def test_a_model_on_trial_comes_into_use_where_it_has_a_third_of_the_error_on_pairs_that_came_later(monkeypatch):
    trial = Trial(monkeypatch, {"first": 1.0, "new": 0.33})
    assert trial.renew(7) == ("first", True, 0, 0, 0)
    assert trial.renew(16) == ("first", True, 0, 0, 0)  # the memory still holds what it was fitted to
    assert trial.renew(17) == ("new", False, 1, 0, 0)
    trial.errors = {"first": 0.81, "new": 1.0}
    assert trial.renew(20) == ("new", True, 1, 0, 0)  # the first one is not clearly better
    trial.errors = {"first": 0.79, "new": 1.0}
    assert trial.renew(20) == ("first", True, 1, 1, 0)


def test_a_model_on_trial_that_is_not_clearly_better_is_refused(monkeypatch):
    trial = Trial(monkeypatch, {"first": 1.0, "new": 0.34})
    assert trial.renew(0) == ("first", True, 0, 0, 0)
    assert trial.renew(10) == ("first", False, 0, 0, 1)
    assert trial.renew(11) == ("first", True, 0, 0, 1)
    trial.suffices = True
    assert trial.renew(30) == ("first", False, 0, 0, 1)


def test_the_best_of_the_earlier_models_comes_back(monkeypatch):
    trial = Trial(monkeypatch, {"first": 5.0, "new": 9.0, "old": 4.0})
    trial.one._good.append(trial.old)
    trial.one.controller.update(trial.new)
    assert trial.renew(0) == ("old", True, 0, 1, 0)


def test_a_model_of_which_no_controller_can_be_made_is_not_used(monkeypatch):
    trial = Trial(monkeypatch, {"first": 1.0, "new": 0.1})
    trial.new = replace(model(), B=np.full((2, 1), 1e99))
    own = trial.one.controller.update
    monkeypatch.setattr(
        trial.one.controller,
        "update",
        lambda model: own(model) if model is not trial.new else (_ for _ in ()).throw(km.errors.DataError("no")),
    )
    trial.renew(0)
    assert trial.renew(10) == ("first", False, 0, 0, 1)
    assert not trial.one._good


def test_too_little_to_fit_is_no_trial(monkeypatch):
    trial = Trial(monkeypatch, {"first": 1.0})

    def refuses():
        raise km.errors.DataError("too little")

    monkeypatch.setattr(trial.one.online, "predictor", refuses)
    assert trial.renew(0) == ("first", False, 0, 0, 0)


def test_only_the_last_five_models_are_kept():
    one = learning()
    for _ in range(9):
        one._good.append(model())
    assert len(one._good) == 5
