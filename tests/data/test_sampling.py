"""Rows of a table and their times: gaps, restarts, resampling, counted by hand; and what a column's name says."""

import re
import warnings

import numpy as np
import pandas as pd
import pytest

import koopmpc as km


def read(*, time=None, x=None, u=None, **how):
    """Return the episodes of a table with one state and one input, and the sentences that reading it warns with."""
    x = np.arange(len(time), dtype=float) if x is None else np.asarray(x, dtype=float)
    columns = {"x": x, "u": 10 * x + np.sin(x) if u is None else u}
    frame = pd.DataFrame(({} if time is None else {"t": time}) | columns)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        data = km.Episodes.from_frame(frame, states=["x"], inputs=["u"], **how)
    return [e.X[:, 0].tolist() for e in data], [str(w.message).partition(": ")[2] for w in caught], data


def test_resampling_leaves_missing_rows_out_and_cuts_at_gaps():
    """A gap is more than 1.5 times the median step, and more than 1.5 times dt."""
    time = [0, 1, 2, 3.4, 4.4, 6.0, 7.0, 8.0, 20.0, 30.0, 31.0]
    assert [e[0] for e in read(time=time, resample=0.5)[0]] == [0, 5, 9]  # a row alone is no episode
    assert [e[0] for e in read(time=time, resample=1.2)[0]] == [0]
    holes = read(time=[0, 1, 2, 3, 4], x=[0, 1, np.nan, 3, 4], resample=2.0)  # 2 is no gap for a dt of 2
    np.testing.assert_allclose(holes[0], [[0, 2, 4]])
    late = read(time=[0, 1, np.nan, 3, 4], resample=1.0)
    assert [e[-1] for e in late[0]] == [1, 4]


def test_what_resampling_cuts_and_leaves_out_is_told():
    def words(time, x=None, dt=1.0):
        return read(time=time, x=x, resample=dt)[1]

    assert words(np.arange(6.0)) == []
    uneven = [0, 1, 2.2, 3.1, 4, 4.9]
    (said,) = words(uneven)
    assert "2 of 5 steps differ from dt = 0.9 s by more than 2 %, the first at row 2, where it is 1 s" in said
    assert words(uneven, dt=2.0) == []  # a wish, and no repair
    said_of_steps, said_of_gaps = words([0, 1, 2, 3.9, 5, 6, 0, 1, 2, 3])
    assert "1 of 8 steps differ from dt = 1 s by more than 2 %, the first at row 5" in said_of_steps
    assert said_of_gaps.startswith("1 gap (after row 3) cut 2 episodes into 3; 0 of 10 rows are lost")
    empty = [0, 1, np.nan, 3, 4, 5]
    assert words(np.arange(6.0), empty)[0].startswith("1 gap (after row 2) cut 1 episode into 2; 1 of 6 rows are lost")
    left_out = "1 of 6 rows have an empty cell or repeat a time; they were left out before resampling"
    assert words(np.arange(6.0), empty, dt=2.0) == [left_out]  # a step of 2 is no gap for a dt of 2
    assert words([0, 1, 2, 2, 3, 4]) == [left_out]


def test_episodes_end_at_gaps_and_what_is_lost_is_counted():
    x = [0, 1, np.nan, 3, 4, 5, np.nan, 7, np.nan, 9, 10]
    found, words, data = read(x=x, u=np.arange(11.0), dt=1.0)
    assert found == [[0, 1], [3, 4, 5], [9, 10]]
    assert [e.U[:, 0].tolist() for e in data] == [[0], [3, 4], [9]]
    assert words == ["2 gaps (after row 2, 6) cut 1 episode into 3; 4 of 11 rows are lost"]
    u = [0, 1, 2, np.nan, 4, 5, 6]  # the input of row 4 is unknown: it leads nowhere, and ends an episode
    found, words, _ = read(x=np.arange(7), u=u, dt=1.0)
    assert found == [[0, 1, 2, 3], [4, 5, 6]]
    assert words == ["1 gap (after row 4) cut 1 episode into 2; 0 of 7 rows are lost"]
    many = read(x=[0, 1, np.nan] * 4 + [0, 1], dt=1.0)[1]
    assert many == ["4 gaps (after row 2, 5, 8, …) cut 1 episode into 5; 4 of 14 rows are lost"]
    with pytest.raises(km.errors.DataError, match="no two rows in sequence hold all states and inputs"):
        read(x=[1, np.nan, 2], dt=1.0)


@pytest.mark.parametrize(("step", "what"), [(1.019, "even"), (0.981, "even"), (1.021, "uneven"), (0.979, "uneven"), (1.49, "uneven"), (1.51, "gap")])  # fmt: skip
def test_a_step_may_be_off_by_two_percent_and_beyond_one_and_a_half_it_is_a_gap(step, what):
    time = np.concatenate([[0, 1, 2], 2 + step + np.arange(3)])
    if what == "uneven":
        told = rf"1 of 5 steps differ from dt = 1 s .* at row 3, where it is {step:g} s"
        with pytest.raises(km.errors.DataError, match=told):
            read(time=time, dt=1.0)
    else:
        found, words, _ = read(time=time, dt=1.0)
        assert len(found) == len(words) + 1 == (2 if what == "gap" else 1)


NAMES = {
    "time": ("t", "time [s]", "Timestamp", "sim_time (ms)", "elapsed", "seconds"),
    "episode": ("episode", "Run", "trial", "trajectory"),
    "inputs": ("u", "u0", "u_left", "force [N]", "Voltage", "command", "cmd_vel", "action 3", "steer_cmd", "duty.x", "torque1"),
    "disturbances": ("w", "w2", "w_wind", "disturbance", "disturbance load"),
    "states": ("theta", "user", "weight", "forced", "time_constant", "steps", "speed [m/s]", "tt", "running"),
}  # fmt: skip
CELLS = np.random.default_rng(0).normal(size=(12, 9))


@pytest.mark.parametrize(("role", "name"), [(role, name) for role, names in NAMES.items() for name in names])
@pytest.mark.filterwarnings("ignore::koopmpc.FitWarning")
def test_a_name_says_what_a_column_is(role, name):
    column = {"time": np.arange(12.0), "episode": np.repeat([0, 1], 6)}.get(role, CELLS[:, 1])
    data = km.Episodes.from_frame(pd.DataFrame({"x": CELLS[:, 0], name: column}), dt=None if role == "time" else 1.0)
    assert len(data) == (2 if role == "episode" else 1)
    for other in ("states", "inputs", "disturbances"):
        assert (name in getattr(data, other)) == (other == role)


@pytest.mark.parametrize(
    ("unit", "scale"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("ns", 1e-9), ("min", 60.0)]
)
def test_a_unit_of_time_is_a_number_of_seconds(unit, scale):
    for name in (f"time [{unit}]", f"time( {unit} )"):
        frame = pd.DataFrame({name: np.arange(12.0), "x": CELLS[:, 0], "u": CELLS[:, 1]})
        assert km.Episodes.from_frame(frame).dt == pytest.approx(scale, rel=1e-9)


@pytest.mark.filterwarnings("ignore::koopmpc.FitWarning")
def test_the_first_of_two_columns_of_time_counts_and_what_is_told_is_not_guessed():
    frame = pd.DataFrame(CELLS[:, :8], columns=["time", "t", "run", "trial", "x", "u", "w", "step"])
    frame["time"] = frame["t"] = frame["step"] = np.arange(12.0)
    frame["run"], frame["trial"], frame["note"] = 0, CELLS[:, 8], "text"

    def roles(**told):
        data = km.Episodes.from_frame(frame, **told)
        return data.states, data.inputs, data.disturbances

    assert roles() == (("t", "trial", "x"), ("u",), ("w",))
    assert roles(states=["x"], inputs=["u"]) == (("x",), ("u",), ())
    assert roles(states=["time", "step"]) == (("time", "step"), ("u",), ())
    assert roles(inputs=["w"]) == (("t", "trial", "x", "u"), ("w",), ())
    assert roles(inputs=[], disturbances=["u"]) == (("t", "trial", "x", "w"), (), ("u",))


def test_two_columns_of_one_name_are_refused_where_they_would_be_guessed_from(tmp_path):
    file = tmp_path / "f.csv"
    file.write_text("x,x,v,u\n0,1,2,3\n1,3,3,1\n2,2,2,4\n")
    for told, message in (
        ({}, "has two columns 'x'; rename one"),
        ({"states": ["x"], "inputs": ["u"]}, "has two columns 'x'; its columns are x, x, v, u"),
        ({"states": ["v"]}, "has two columns 'x'; rename one"),
    ):
        with pytest.raises(km.errors.DataError, match=message):
            km.load_episodes(file, dt=1.0, **told)
    assert km.load_episodes(file, dt=1.0, states=["v"], inputs=["u"]).states == ("v",)


@pytest.mark.parametrize(
    ("count", "largest", "refused"),
    [(100, 0.99e6, False), (100, -1.01e6, True), (99, 1.01e6, False), (200, 1.01e6, True)],
)
@pytest.mark.filterwarnings("ignore::koopmpc.FitWarning")
def test_a_cell_a_million_times_larger_than_usual_is_refused_with_its_row(count, largest, refused):
    column = np.ones(count)
    column[1::2] = -1.0
    column[17], column[3] = largest, np.nan
    column = np.append(column, 1.0)
    if refused:
        told = re.escape(f"'x' is {largest:g} in row 18, where 99 % of its cells are within 1; repair")
        with pytest.raises(km.errors.DataError, match=told):
            read(x=column, dt=1.0, u=np.ones(len(column)))
    else:
        read(x=column, dt=1.0, u=np.ones(len(column)))


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
    doubts = [w for w in caught if issubclass(w.category, km.errors.ColumnWarning)]
    words = [str(w.message).split(": ", 1)[1].split(";")[0] for w in doubts]
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
    (rows,) = read(time=time, x=wild, resample=1.0)[0]
    grid = time[0] + np.arange(len(rows))
    differ = np.flatnonzero(np.abs(rows - np.interp(grid, time[left_out], X[left_out])) > 1e-9)
    assert [rows[i] for i in differ] == [999.0]
    assert abs(grid[differ[0]] - time[k]) <= 0.5 + 1e-9
    coarse = np.array(read(time=time, x=wild, resample=7.3)[0][0])
    at = time[0] + 7.3 * np.arange(len(coarse))
    assert np.isin(coarse, [999.0]).sum() <= (np.abs(at - time[k]) < 1.4).sum()
    assert np.abs(coarse[coarse != 999.0]).max() <= np.abs(X).max()
