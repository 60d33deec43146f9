"""find_hidden_state: silent on logs of the whole state, whatever noise, lifting and feedback; loud where one is hidden."""

import numpy as np
import pytest

import koopmpc as km
from tests.roundtrip import returned
from tests.validate.memory_cases import draw_plant, record

FAMILIES = ("white noise", "exact", "closed loop")
KINDS = 9  # plants of `draw_plant`


def draw_null(seed: int) -> km.Episodes:
    """Return logs of all states: with white noise, exact ones of nonlinear plants, or under feedback of noisy outputs."""
    rng = np.random.default_rng([seed, 1])
    plant = draw_plant(rng, seed // len(FAMILIES) % KINDS)
    family = FAMILIES[seed % len(FAMILIES)]
    noise = 0.0 if family == "exact" else float(10 ** rng.uniform(-3, -1.3))
    return record(plant, rng, noise, closed=family == "closed loop")


def draw_hidden(seed: int) -> km.Episodes:
    """Return logs of one output of a plant with two to four states."""
    rng = np.random.default_rng([seed, 2])
    plant = draw_plant(rng, seed % KINDS)
    noise = float(10 ** rng.uniform(-3, -1.5)) if rng.random() < 0.7 else 0.0
    return record(plant, rng, noise, closed=rng.random() < 0.3, states=(plant.output,))


FEW = [1, 5, 9, 16, 23]  # plants and families in turn
MANY = pytest.mark.slow


@pytest.mark.parametrize("seed", [*FEW, *(pytest.param(s, marks=MANY) for s in range(60_000, 60_054))])
def test_logs_of_the_whole_state_show_no_hidden_one(seed):
    found = km.validate.find_hidden_state(draw_null(seed))
    assert not found.shows_hidden_state
    assert str(found) == "no hidden state shows in 8 past rows"


@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(s, marks=MANY) for s in range(60_000, 60_036))])
def test_an_output_alone_shows_that_states_are_hidden(seed):
    found = km.validate.find_hidden_state(draw_hidden(seed))
    assert found.shows_hidden_state
    assert str(found).startswith("a hidden state shows: on unseen rows 8 past rows remove ")
    assert returned(found) == found


@pytest.mark.parametrize("closed", [False, True])
def test_an_angle_that_turns_and_leaves_its_range_hides_nothing(closed):
    """Its sine tells what unseen turns do; without it past rows did, and one long record in three was called wrong."""
    rng = np.random.default_rng(10_020)
    data = record(draw_plant(rng, 1), rng, 0.003, closed=closed)
    turning = np.concatenate([e.X[:, 0] for e in data])
    assert closed or np.ptp(turning) > 4 * np.pi
    assert not km.validate.find_hidden_state(data).shows_hidden_state


def test_units_and_offsets_change_nothing():
    data = draw_hidden(4)
    moved = km.Episodes([km.Episode(X=300 + 1e-4 * e.X, U=-5 + 1e3 * e.U) for e in data], data.dt, states=data.states)
    here, there = km.validate.find_hidden_state(data), km.validate.find_hidden_state(moved)
    assert np.allclose(here.gain, there.gain, atol=1e-3)
    assert here.shows_hidden_state == there.shows_hidden_state


def test_short_episodes_and_many_signals_cannot_tell():
    rng = np.random.default_rng(0)
    short = km.Episodes([km.Episode(X=rng.standard_normal((4, 1)), U=rng.standard_normal((3, 1)))] * 90, 0.1)
    many = km.Episodes([km.Episode(X=rng.standard_normal((400, 12)), U=rng.standard_normal((399, 1)))], 0.1)
    few = km.Episodes([km.Episode(X=rng.standard_normal((60, 1)), U=rng.standard_normal((59, 1)))], 0.1)
    for data in (short, many, few):
        found = km.validate.find_hidden_state(data)
        assert not found.shows_hidden_state
        assert str(found).startswith("cannot say whether a state is hidden")


@pytest.fixture(scope="module")
def spring() -> km.Episodes:
    return next(data for data in map(draw_hidden, range(20)) if len(data) > 1)


def test_audit_and_trust_say_it_and_are_silent_where_the_model_sees_the_past(spring):
    looked = km.validate.audit(spring)
    assert looked.kinds == ()
    assert looked.memory is not None
    assert "a hidden state shows" in str(looked)
    train, held_out = spring.split(0.6, rng=0)
    plain = km.edmd(train, km.State() + km.Constant())
    late = km.edmd(train, km.State() + km.Constant(), embedding=km.Delay(2))
    said = [finding.says for finding in km.trust(plain, held_out, 10, train=train).findings]
    assert sum(one.startswith("a hidden state shows") for one in said) == 1
    assert not any("hidden" in finding.says for finding in km.trust(late, held_out, 10, train=train).findings)


def test_select_takes_a_past_where_a_hidden_state_shows(spring):
    """One hidden speed: two past rows forecast no better than one, so four are not tried; test_select has where they are."""
    assert not km.select(
        spring, horizon=10, options=km.SearchOptions(candidates=[km.State() + km.Constant()], delays=[0])
    ).best.delays
    found = km.select(
        spring, horizon=10, options=km.SearchOptions(candidates=[km.State() + km.Constant()], bilinear=False)
    )
    assert {row.delays for row in found.leaderboard} == {0, 1, 2}
    assert found.best.delays
    assert any(note.startswith("a hidden state shows") for note in found.notes)
