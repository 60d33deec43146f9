"""Rows of a table and their times: gaps, restarts, resampling, counted by hand."""

import re
import warnings

import numpy as np
import pytest

import koopmpc as km
from koopmpc.data.files.columns import TableSettings, find_roles, is_label
from koopmpc.data.files.sampling import Signals, episodes_from, resample
from koopmpc.data.files.tables import _plausible


def signals(time, X=None, U=None, first=1):
    rows = np.arange(len(X if time is None else time)) + first
    X = np.asarray(rows if X is None else X, dtype=float)
    U = 10 * X if U is None else np.asarray(U, dtype=float)
    return Signals(None if time is None else np.asarray(time, dtype=float), X[:, None], U[:, None], U[:, None], rows)


def said(action):
    """Return what it returns, and the sentences that it warns with."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = action()
    return found, [str(warning.message) for warning in caught]


def on_grid(part, dt):
    return said(lambda: resample([part], dt, "f"))[0]


def test_resampling_leaves_missing_rows_out_and_cuts_at_gaps():
    """A gap is more than 1.5 times the median step, and more than 1.5 times dt."""
    time = np.array([0, 1, 2, 3.4, 4.4, 6.0, 7.0, 8.0, 20.0, 30.0, 31.0])
    found = on_grid(signals(time), 0.5)
    assert [part.rows.tolist()[0] for part in found] == [1, 6, 10]
    assert [part.rows.tolist()[-1] for part in found] == [4, 8, 11]  # a row alone is no part
    assert [part.rows.tolist()[0] for part in on_grid(signals(time), 1.2)] == [1, 10]
    holes = signals([0, 1, 2, 3, 4], X=[0, 1, np.nan, 3, 4])
    (part,) = on_grid(holes, 2.0)  # 2 is no gap for a dt of 2
    np.testing.assert_allclose(part.X[:, 0], [0, 2, 4])
    late = signals([0, 1, np.nan, 3, 4])
    assert [part.rows.tolist()[-1] for part in on_grid(late, 1.0)] == [2, 5]
    assert on_grid(signals([1.0]), 1.0) == []
    assert on_grid(signals([1.0, 2.0], X=[np.nan, 1.0]), 1.0) == []


def test_what_resampling_cuts_and_leaves_out_is_told():
    def words(*parts, dt=1.0):
        return said(lambda: resample(list(parts), dt, "f"))[1]

    assert words(signals(np.arange(6))) == []
    assert words(signals([0, 1, 2.2, 3.1, 4, 4.9])) == [
        "f: sampling is unequal: 2 of 5 steps differ from dt = 0.9 s by more than 2 %, the first at row 2, where it is "
        "1 s; interpolated to 1 s"
    ]
    assert words(signals([0, 1, 2.2, 3.1, 4, 4.9]), dt=2.0) == []  # a wish, and no repair
    uneven = signals([0, 1, 2, 3.9, 5, 6])
    said_of_steps, said_of_gaps = words(uneven, signals(np.arange(4), first=7))
    assert "1 of 8 steps differ from dt = 1 s by more than 2 %, the first at row 5" in said_of_steps
    assert said_of_gaps.startswith("f: 1 gap (after row 3) cut 2 episodes into 3; 0 of 10 rows are lost")
    assert said_of_gaps.endswith("a gap is a step between complete rows of more than 1.5 times the usual one")
    empty = signals(np.arange(6), X=[0, 1, np.nan, 3, 4, 5])
    assert words(empty)[0].startswith("f: 1 gap (after row 2) cut 1 episode into 2; 1 of 6 rows are lost")
    left_out = "f: 1 of 6 rows have an empty cell or repeat a time; they were left out before resampling"
    assert words(empty, dt=2.0) == [left_out]  # a step of 2 is no gap for a dt of 2
    assert words(signals([0, 1, 2, 2, 3, 4])) == [left_out]


def test_episodes_end_at_gaps_and_what_is_lost_is_counted():
    x = [0, 1, np.nan, 3, 4, 5, np.nan, 7, np.nan, 9, 10]
    found, words = said(lambda: episodes_from([signals(None, X=x, U=np.arange(11), first=5)], 1.0, "f"))
    assert [e.X[:, 0].tolist() for e in found] == [[0, 1], [3, 4, 5], [9, 10]]
    assert [e.U[:, 0].tolist() for e in found] == [[0], [3, 4], [9]]
    assert [e.W[:, 0].tolist() for e in found] == [[0], [3, 4], [9]]
    assert words == ["f: 2 gaps (after row 6, 10) cut 1 episode into 3; 4 of 11 rows are lost"]
    u = [0, 1, 2, np.nan, 4, 5, 6]  # the input of row 4 is unknown: it leads nowhere, and ends an episode
    found, words = said(lambda: episodes_from([signals(None, X=np.arange(7), U=u)], 1.0, "f"))
    assert [e.X[:, 0].tolist() for e in found] == [[0, 1, 2, 3], [4, 5, 6]]
    assert words == ["f: 1 gap (after row 4) cut 1 episode into 2; 0 of 7 rows are lost"]
    many = [signals(None, X=[0, 1, np.nan] * 4 + [0, 1])]
    assert (
        "4 gaps (after row 2, 5, 8, …) cut 1 episode into 5; 4 of 14 rows"
        in said(lambda: episodes_from(many, 1, "f"))[1][0]
    )
    found, words = said(lambda: episodes_from([signals(None, X=[1, 2]), signals(None, X=[3])], 1.0, "f"))
    assert words == ["f: 0 gaps cut 2 episodes into 1; 1 of 3 rows are lost"]
    assert not said(lambda: episodes_from([signals(None, X=[1, 2]), signals(None, X=[3, 4])], 1.0, "f"))[1]
    with pytest.raises(km.errors.DataError, match="f: no two rows in sequence hold all states and inputs"):
        episodes_from([signals(None, X=[1, np.nan, 2])], 1.0, "f")


@pytest.mark.parametrize(("step", "what"), [(1.019, "even"), (0.981, "even"), (1.021, "uneven"), (0.979, "uneven"), (1.49, "uneven"), (1.51, "gap")])  # fmt: skip
def test_a_step_may_be_off_by_two_percent_and_beyond_one_and_a_half_it_is_a_gap(step, what):
    time = np.concatenate([[0, 1, 2], 2 + step + np.arange(3)])
    if what == "uneven":
        with pytest.raises(
            km.errors.DataError, match=rf"1 of 5 steps differ from dt = 1 s .* at row 3, where it is {step:g} s"
        ):
            episodes_from([signals(time)], 1.0, "f")
    else:
        found, words = said(lambda: episodes_from([signals(time)], 1.0, "f"))
        assert len(found) == len(words) + 1 == (2 if what == "gap" else 1)


NAMES = {
    "time": ("t", "time [s]", "Timestamp", "sim_time (ms)", "elapsed", "seconds"),
    "episode": ("episode", "Run", "trial", "trajectory"),
    "inputs": ("u", "u0", "u_left", "force [N]", "Voltage", "command", "cmd_vel", "action 3", "steer_cmd", "duty.x", "torque1"),
    "disturbances": ("w", "w2", "w_wind", "disturbance", "disturbance load"),
    "states": ("theta", "user", "weight", "forced", "time_constant", "steps", "speed [m/s]", "tt", "running"),
}  # fmt: skip


@pytest.mark.parametrize(("role", "name"), [(role, name) for role, names in NAMES.items() for name in names])
def test_a_name_says_what_a_column_is(role, name):
    names = ["x", name]
    found = find_roles(names, names, TableSettings(), "f")
    held = getattr(found, role)
    assert held == name if role in ("time", "episode") else name in held
    others = {other for other in NAMES if other != role}
    assert not any(name == getattr(found, other) or name in (getattr(found, other) or ()) for other in others)
    assert is_label(name) == (role in ("time", "episode"))
    assert found.guessed
    assert found.values == found.states + found.inputs + found.disturbances


@pytest.mark.parametrize(
    ("unit", "scale"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("ns", 1e-9), ("min", 60.0)]
)
def test_a_unit_of_time_is_a_number_of_seconds(unit, scale):
    for name in (f"time [{unit}]", f"time( {unit} )"):
        assert find_roles(["x", name], ["x", name], TableSettings(), "f").scale == scale


def test_the_first_of_two_columns_of_time_counts_and_what_is_told_is_not_guessed():
    names = ["time", "t", "run", "trial", "x", "u", "w", "step", "note"]
    numbers = names[:-1]
    found = find_roles(names, numbers, TableSettings(), "f")
    assert (found.time, found.episode, found.step) == ("time", "run", "step")
    assert (found.states, found.inputs, found.disturbances) == (("t", "trial", "x"), ("u",), ("w",))
    found = find_roles(names, numbers, TableSettings(states=["x"], inputs=["u"]), "f")
    assert (found.states, found.inputs, found.disturbances, found.guessed) == (("x",), ("u",), (), False)
    found = find_roles(names, numbers, TableSettings(states=["time", "step", "run"]), "f")
    assert (found.time, found.episode, found.step) == ("t", "trial", None)
    assert (found.states, found.inputs, found.guessed) == (("time", "step", "run"), ("u",), True)
    found = find_roles(names, numbers, TableSettings(inputs=["w"]), "f")
    assert (found.inputs, found.disturbances) == (("w",), ())
    assert found.states == ("t", "trial", "x", "u")
    found = find_roles(names, numbers, TableSettings(disturbances=["u"], inputs=[]), "f")
    assert (found.inputs, found.disturbances, "u" in found.states) == ((), ("u",), False)


def test_two_columns_of_one_name_are_refused_where_they_would_be_guessed_from():
    names = ["x", "x", "v", "u"]
    with pytest.raises(km.errors.DataError, match="f has two columns 'x'; rename one"):
        find_roles(names, names, TableSettings(), "f")
    with pytest.raises(km.errors.DataError, match="f has two columns 'x'; its columns are x, x, v, u"):
        find_roles(names, names, TableSettings(states=["x"], inputs=["u"]), "f")
    assert find_roles(names, names, TableSettings(states=["v"], inputs=["u"]), "f").states == ("v",)
    with pytest.raises(km.errors.DataError, match="f has two columns 'x'; rename one"):
        find_roles(names, names, TableSettings(states=["v"]), "f")


@pytest.mark.parametrize(
    ("count", "largest", "refused"),
    [(100, 0.99e6, False), (100, -1.01e6, True), (99, 1.01e6, False), (200, 1.01e6, True)],
)
def test_a_cell_a_million_times_larger_than_usual_is_refused_with_its_row(count, largest, refused):
    column = np.ones(count)
    column[1::2] = -1.0
    column[17], column[3] = largest, np.nan
    column = np.append(column, 1.0)
    if refused:
        with pytest.raises(
            km.errors.DataError,
            match=re.escape(f"f: 'x' is {largest:g} in row 18, where 99 % of its cells are within 1; repair"),
        ):
            _plausible(column, "x", "f")
    else:
        _plausible(column, "x", "f")


def test_more_rows_than_memory_holds_are_refused_before_they_are_made(tmp_path, monkeypatch):
    (tmp_path / "log.csv").write_text("t,x,u\n0,1,1\n1,2,3\n9,3,2\n10,4,1\n0,5,6\n1,7,7\n")
    needed = 16 * 2 * (10 + 1) / 0.01  # bytes of two columns over eleven seconds
    for free, fits in ((1.01 * needed, True), (0.99 * needed, False), (None, True)):
        monkeypatch.setattr("koopmpc.base.disk.memory", lambda free=free: free)
        if fits:
            with pytest.warns(km.FitWarning, match=r"1 gap \(after line 3\) cut 2 episodes into 3; 0 of 6 rows"):
                assert len(km.load_episodes(tmp_path / "log.csv", resample=0.01)) == 3
        else:
            with pytest.raises(
                km.errors.DataError, match=r"resample=0.01 makes 1.1e\+03 rows of 2 columns, 3.52e-05 GB"
            ):
                km.load_episodes(tmp_path / "log.csv", resample=0.01)


def test_a_column_is_doubted_once_where_it_is_constant_or_repeats_an_earlier_one(tmp_path):
    (tmp_path / "log.csv").write_text("t,x,y,z,c,u\n0,1,1,1,,1\n1,2,2,2,4,3\n2,5,5,5,4,2\n")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        km.load_episodes(tmp_path / "log.csv", resample=1.0)
    words = [
        str(w.message).split(": ", 1)[1].split(";")[0]
        for w in caught
        if issubclass(w.category, km.errors.ColumnWarning)
    ]
    assert words == ["'y' repeats 'x'", "'z' repeats 'x'", "'z' repeats 'y'", "'c' is 4 throughout"]
    with warnings.catch_warnings():
        warnings.simplefilter("error", km.errors.ColumnWarning)
        with pytest.warns(km.FitWarning, match="gap"):
            km.load_episodes(tmp_path / "log.csv", states=["x", "y", "c"], inputs=["u"])  # told, not guessed


@pytest.mark.parametrize("seed", range(5))
def test_a_single_wild_reading_stays_in_one_row_of_the_grid(seed):
    rng = np.random.default_rng(seed)
    time, X = np.arange(60) + rng.uniform(-0.2, 0.2, 60), np.cumsum(rng.standard_normal(60))
    k = int(rng.integers(5, 55))
    wild, left_out = X.copy(), np.delete(np.arange(60), k)
    wild[k] = 999.0
    (part,) = on_grid(signals(time, X=wild), 1.0)
    without = np.interp(part.time, time[left_out], X[left_out])
    differ = np.flatnonzero(np.abs(part.X[:, 0] - without) > 1e-9)
    assert part.X[differ, 0].tolist() == [999.0]
    assert abs(part.time[differ[0]] - time[k]) <= 0.5 + 1e-9
    (coarse,) = on_grid(signals(time, X=wild), 7.3)
    assert np.isin(coarse.X[:, 0], [999.0]).sum() <= (np.abs(coarse.time - time[k]) < 1.4).sum()
    assert np.abs(coarse.X[coarse.X[:, 0] != 999.0]).max() <= np.abs(X).max()
