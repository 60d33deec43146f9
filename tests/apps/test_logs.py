"""Logs before a fit: records that cannot be fitted, or only in part, faults that are left out, and what is held out."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

import koopmpc as km
from koopmpc.apps.fitting.logs import describe_guesses, read_logs, round_step, shorten_notes
from koopmpc.apps.fitting.repair import audit_episodes
from koopmpc.validate.logs.log import Place
from koopmpc.validate.logs.summary import excerpt_logs
from tests.commands import koopmpc


def write(path, rows=1200, **columns):
    """Write a record of a first-order plant; `columns` replace or add some."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, rows // 10 + 1), 10)[:rows]
    y = np.zeros(rows)
    for k in range(rows - 1):
        y[k + 1] = 0.9 * y[k] + 0.1 * u[k]
    table = {"t [s]": 0.1 * np.arange(rows), "valve": u, "y": y + 1e-3 * rng.standard_normal(rows)} | columns
    text = "\n".join(",".join(f"{v:.10g}" for v in row) for row in np.column_stack([*table.values()]))
    path.write_text(",".join(table) + "\n" + text + "\n")
    return path


def refusal(*arguments):
    """Return what `koopmpc fit` says where it stops; it ends with a code above zero and without a traceback."""
    result = koopmpc("fit", *arguments)
    assert result.exit_code > 0
    assert isinstance(result.exception, SystemExit)
    return re.sub(r"[\s│]+", " ", result.output)


def read(path, **options):
    return read_logs(path, None, np.random.default_rng(0), options)


@pytest.mark.parametrize(
    ("still", "said"),
    [
        ({"valve": 7.0}, "no input moves: valve is 7 throughout, so what it does cannot be learned"),
        ({"y": 3.0}, "no state moves: y are constant"),
    ],
)
def test_a_column_that_never_moves_is_named_and_nothing_is_fitted(tmp_path, monkeypatch, still, said):
    monkeypatch.chdir(tmp_path)
    columns = {name: np.full(1200, value) for name, value in still.items()}
    assert said in refusal(write(tmp_path / "a.csv", **columns))
    assert not list(tmp_path.rglob("model.npz"))


def test_a_short_record_is_told_how_long_it_must_be(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refusal(write(tmp_path / "a.csv", rows=180))
    need = int(re.search(r"so (\d+) in all", said).group(1))
    with pytest.raises(km.errors.DataError, match="in all"):
        read(write(tmp_path / "b.csv", rows=need - 20))
    assert len(read(write(tmp_path / "c.csv", rows=need + 1)).held_out) >= 2


def test_a_column_that_repeats_another_is_left_out_with_a_note(tmp_path):
    path = write(tmp_path / "a.csv")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    table = np.hstack([table, table[:, 2:]])
    path.write_text("t [s],valve,y,y2\n" + "\n".join(",".join(map(repr, row)) for row in table.tolist()) + "\n")
    found = read(path)
    assert found.seen.states == ("y",)
    assert any("y2 repeats y" in note for note in found.notes)


def test_a_gap_of_missing_readings_ends_in_a_note_and_the_other_rows_stay(tmp_path):
    path = write(tmp_path / "a.csv", rows=2400)
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    rows = [",".join(map(repr, row)) for row in table.tolist()]
    rows[700:740] = [f"{row[0]!r},{row[1]!r}," for row in table[700:740].tolist()]
    path.write_text("t [s],valve,y\n" + "\n".join(rows) + "\n")
    found = read(path)
    assert any(re.search(r"row|gap|missing|empty", note) for note in found.notes)
    assert sum(map(len, found.fitted)) > 2200


def tank(rows, seed=0, quantum=0.0):
    """Return a record of a slow tank with a valve that moves in steps: y⁺ = y + 0.05 (u − √y)."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.6, 1.6, rows // 15 + 1), 15)[:rows] + 0.02 * rng.standard_normal(rows)
    y = np.ones(rows + 1)
    for k in range(rows):
        y[k + 1] = y[k] + 0.05 * (u[k] - np.sqrt(max(y[k], 0.0)))
    y += 1e-3 * rng.standard_normal(rows + 1)
    return (np.round(y / quantum) * quantum if quantum else y), u


def record(y, u):
    return km.Episodes([km.Episode(X=y[:, None], U=u[:, None])], 1.0, ["level"], ["valve"])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_fifth_of_a_record_that_is_stuck_goes_from_learned_and_unseen_parts_alike(seed):
    y, u = tank(2000, seed)
    stuck = np.zeros(2001, dtype=bool)
    for first in range(60, 1960, 200):
        stuck[first : first + 40] = True
        y[first : first + 40] = y[first]
    rest, notes, *_ = audit_episodes(record(y, u))
    assert any("were left out" in note for note in notes)
    kept = np.concatenate([e.X[:, 0] for e in rest])
    values, counts = np.unique(kept, return_counts=True)
    assert counts.max() < 12, f"{values[counts.argmax()]} is repeated {counts.max()} times"
    assert len(kept) > 0.75 * 2001


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_equal_neighbours_of_a_slow_and_quantised_sensor_stay(seed):
    y, u = tank(2000, seed, quantum=0.01)
    data = record(y, u)
    rest, notes, *_ = audit_episodes(data)
    assert len(rest) == 1
    assert len(rest[0]) == len(data[0])
    assert not any("left out" in note for note in notes)


def test_rows_at_both_rails_stay_unless_models_do_better_without_them():
    y, u = tank(2000)
    clipped = np.clip(y, np.quantile(y, 0.02), np.quantile(y, 0.98))
    rest, notes, *_ = audit_episodes(record(clipped, u))
    (note,) = [note for note in notes if note.startswith("sensor at its limit")]
    assert ("were kept" in note) == (sum(map(len, rest)) == 2000)
    assert len(rest) < 10 or "were left out" in note


def test_single_wild_readings_always_go_and_leave_the_record_in_one_piece():
    y, u = tank(1500)
    y[[200, 700, 1100]] += 3.0
    rest, notes, *_ = audit_episodes(record(y, u))
    assert max(float(e.X.max()) for e in rest) < 3.0
    assert len(rest) == 1
    assert any(note.startswith("spikes") and "replaced by the line" in note for note in notes)


def test_a_column_that_repeats_another_hides_no_effect_of_an_input():
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, 600), np.zeros(601)
    for k in range(600):
        y[k + 1] = 0.9 * y[k] + 0.5 * u[k]
    y += 0.01 * rng.standard_normal(601)
    twice = km.Episodes([km.Episode(X=np.column_stack([y, y]), U=u[:, None])], 1.0, ["level", "copy"], ["valve"])
    assert audit_episodes(twice).notes == audit_episodes(record(y, u)).notes
    assert audit_episodes(twice).rest.nx == 2  # they are left out later, and that is said


def test_a_coarse_sensor_whose_changes_are_mostly_zero_is_said_to_show_that():
    y, u = tank(2000, quantum=0.05)
    (note,) = [note for note in audit_episodes(record(y, u)).notes if note.startswith("quantised")]
    assert "half of its changes from row to row are zero" in note


def test_a_sensor_at_its_limit_is_no_held_sample_and_makes_no_input_a_feedback():
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, 600), np.zeros(601)
    for k in range(600):
        y[k + 1] = 0.9 * y[k] + 0.5 * u[k]
    y = np.clip(y + 0.01 * rng.standard_normal(601), -0.5, 0.5)
    notes = audit_episodes(record(y, u)).notes
    assert any(note.startswith("sensor at its limit") for note in notes)
    assert not any(note.startswith(("held samples", "rows twice")) or "feedback" in note for note in notes)


def test_the_verdict_on_a_record_looks_as_far_ahead_as_its_output_remembers(tmp_path):
    rng = np.random.default_rng(0)
    u, tau = rng.standard_normal(6000), 60
    y = signal.lfilter([0, 1], [1, -np.exp(-1 / tau)], u)
    rows = np.column_stack([0.01 * np.arange(len(y)), u, y])
    np.savetxt(tmp_path / "slow.csv", rows, delimiter=",", header="time [s],u,y", comments="")
    split = read_logs(tmp_path / "slow.csv", None, rng, {})
    assert split.horizon == 20  # models are chosen by these
    assert tau / 2 < split.ahead <= 2 * tau
    assert all(len(e) >= split.ahead for e in split.held_out)
    assert len(split.held_out) >= 12  # so that a band is finite
    assert f"judged {split.ahead} steps = {0.01 * split.ahead:.3g} s ahead" in " ".join(split.notes)
    asked = read_logs(tmp_path / "slow.csv", 30, rng, {})
    assert (asked.horizon, asked.ahead) == (30, 30)
    np.savetxt(tmp_path / "short.csv", rows[:900], delimiter=",", header="time [s],u,y", comments="")
    short = read_logs(tmp_path / "short.csv", None, rng, {})  # too short for a band at any horizon
    assert 20 < short.ahead <= 45 - 12
    assert len(short.held_out) >= 4
    assert "the outputs remember" in " ".join(short.notes)


def test_the_verdict_on_several_records_looks_no_further_ahead_than_a_block_of_one_of_them(tmp_path):
    rng = np.random.default_rng(0)
    for i in range(5):
        u = rng.standard_normal(300)
        y = signal.lfilter([0, 1], [1, -np.exp(-1 / 100)], u)
        rows = np.column_stack([0.01 * np.arange(300), u, y])
        np.savetxt(tmp_path / f"{i}.csv", rows, delimiter=",", header="time [s],u,y", comments="")
    split = read_logs(tmp_path, None, rng, {})
    assert len(split.held_out) == 5  # a block of a fifth of all would cross the ends of records
    assert 20 < split.ahead < 60
    assert all(len(e) > split.ahead for e in split.held_out)


def test_of_notes_that_differ_from_file_to_file_the_first_are_shown_and_the_others_counted(tmp_path):
    files = [tmp_path / f"{i}.csv" for i in range(9)]
    short = shorten_notes([*(f"{file}: gap {i}" for i, file in enumerate(files)), "of all: one"], files)
    assert short[:2] == [f"{files[0]}: gap 0", f"{files[1]}: gap 1"]
    assert short[6:] == ["of all: one", "3 more files have notes of their own; load_episodes shows them"]


def test_a_clock_that_is_set_back_is_told_and_one_that_starts_anew_is_not(tmp_path):
    def table(times):
        rows = np.column_stack([times, np.random.default_rng(0).normal(size=(len(times), 2))])
        np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="time [s],x,u", comments="")
        return km.load_episodes(tmp_path / "a.csv")

    assert len(table(np.tile(np.arange(10) * 0.1, 3))) == 3
    with pytest.warns(km.FitWarning, match="the clock is set back 1 times, before row 11; an episode ends there"):
        assert len(table(np.concatenate([np.arange(10), np.arange(5, 15)]) * 0.1)) == 2


@pytest.mark.parametrize(
    ("median", "step"), [(2.002, 2.0), (0.0501, 0.05), (0.33333, 0.33333), (1.0, 1.0), (7.3e-4, 7.3e-4)]
)
def test_an_uneven_clock_has_the_step_that_its_recorder_was_set_to(median, step):
    assert round_step(median) == step


@given(st.integers(0, 2**32 - 1))
def test_what_is_left_out_and_replaced_is_what_the_pieces_lack_and_change(seed):
    rng = np.random.default_rng(seed)
    raw = km.Episodes(
        [km.Episode(X=rng.normal(size=(n + 1, 2)), U=rng.normal(size=(n, 1))) for n in rng.integers(6, 20, 3)], 0.5
    )
    pieces, origins, changed, kept = [], [], [], np.zeros(0, bool)
    for e, episode in enumerate(raw):
        first, last = sorted(rng.choice(len(episode) + 1, 2, replace=False))
        mask = np.zeros(len(episode) + 1, bool)
        if last - first >= 2:
            X = episode.X[first : last + 1].copy()
            i, j = rng.integers(len(X)), rng.integers(2)
            changed.append((X[i, j], X[i, j] + 1.0))
            X[i, j] += 1.0
            pieces.append(km.Episode(X=X, U=episode.U[first:last]))
            origins.append(Place(e, int(first), int(last) + 1))
            mask[first : last + 1] = True
        kept = np.concatenate([kept, mask])
    if not pieces:
        return
    excerpt = excerpt_logs(raw, raw.with_episodes(pieces), origins)
    rows = np.isfinite(excerpt.values[:, 0])
    t = excerpt.time[rows]
    out = np.zeros(len(t), bool)
    for begin, end in excerpt.left_out:
        out |= (t > begin) & (t < end)
    np.testing.assert_array_equal(out, ~kept)
    assert sorted((was, now) for _, _, was, now in excerpt.replaced) == sorted(changed)
    assert len(t) == sum(len(episode) + 1 for episode in raw)


def test_many_rows_are_thinned_and_no_mark_is_lost():
    rng = np.random.default_rng(0)
    raw = km.Episodes([km.Episode(X=rng.normal(size=(50_001, 1)), U=rng.normal(size=(50_000, 1)))], 1.0)
    X = raw[0].X.copy()
    X[12_345] = 7.0
    excerpt = excerpt_logs(raw, raw.with_episodes([km.Episode(X=X, U=raw[0].U)]), [Place(0, 0, 50_001)])
    assert len(excerpt.time) < 5_000
    assert excerpt.replaced[:, [0, 3]].tolist() == [[12_345.0, 7.0]]
    assert 12_345.0 in excerpt.time


def test_roles_that_names_alone_tell_are_said_to_be_guessed_and_short_episodes_are_too_few(tmp_path):
    (sentence,) = describe_guesses([write(tmp_path / "a.csv")], {})
    assert "guessed from their names; --inputs u,v and --states a,b say it" in sentence
    assert describe_guesses([tmp_path / "a.csv"], {"inputs": ["valve"]}) == []
    rng = np.random.default_rng(0)
    data = km.Episodes([km.Episode(X=rng.normal(size=(21, 2)), U=rng.normal(size=(20, 1))) for _ in range(2)], 0.1)
    for name in ("own.csv", "own.npz"):
        data.save(tmp_path / name)
        assert describe_guesses([tmp_path / name], {}) == []
    with pytest.raises(km.errors.DataError, match="too few of 22 steps"):
        read_logs(tmp_path / "own.npz", 20, np.random.default_rng(0), {})
