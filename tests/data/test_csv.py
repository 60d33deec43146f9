"""Tables as text: what is told and what is guessed, gaps, unequal time, and files that are no tables."""

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import koopmpc as km


def text(file: Path, content: str, encoding: str = "utf-8") -> Path:
    file.write_bytes(content.encode(encoding))
    return file


def test_a_log_that_says_nothing_is_understood(tmp_path: Path) -> None:
    file = text(
        tmp_path / "log.csv",
        "time [s],theta [rad],omega,force [N],note\n0,1,2,5,a\n0.1,3,4,6,b\n0.2,5,6,,c\n",
    )
    with pytest.warns(km.FitWarning, match="'note' holds text, and no part of it is a state or an input"):
        read = km.load_episodes(file)
    assert (read.dt, read.states, read.inputs) == (0.1, ("theta [rad]", "omega"), ("force [N]",))
    assert read[0].X.tolist() == [[1, 2], [3, 4], [5, 6]]
    assert read[0].U.tolist() == [[5], [6]]


@pytest.mark.parametrize(
    "content",
    [
        "# by hand\n# twice\nt,x,u\n0,1.5,1\n1,2.5,2\n2,3.5,\n",
        "t;x;u\n0;1,5;1\n1;2,5;2\n2;3,5;\n",
        "t\tx\tu\n0\t1.5\t1\n1\t2.5\t2\n2\t3.5\tNaN\n",
        "\ufefft,x,u\r\n0,1.5,1\r\n1,2.5,2\r\n2,3.5,\r\n",
        "time [ms],x,u\n0,1.5,1\n1000,2.5,2\n2000,3.5,\n",
        "timestamp,x,u\n2026-01-01 00:00:00,1.5,1\n2026-01-01 00:00:01,2.5,2\n2026-01-01 00:00:02,3.5,\n",
    ],
)
def test_the_ways_in_which_programs_write_one_table(tmp_path: Path, content: str) -> None:
    read = km.load_episodes(text(tmp_path / "log.csv", content))
    assert (read.dt, read.states, read.inputs) == (1.0, ("x",), ("u",))
    assert (read[0].X.ravel().tolist(), read[0].U.ravel().tolist()) == ([1.5, 2.5, 3.5], [1.0, 2.0])


def test_letters_of_another_encoding(tmp_path: Path) -> None:
    read = km.load_episodes(text(tmp_path / "log.csv", "t,φ\n0,1\n1,2\n".replace("φ", "é"), "latin-1"), inputs=[])
    assert read.states == ("é",)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(5, 40), st.sets(st.integers(0, 39), max_size=6), st.sets(st.integers(0, 39), max_size=4))
def test_gaps_cut_and_no_pair_spans_one(tmp_path: Path, T: int, holes: set[int], late: set[int]) -> None:
    """Each pair of the result is a pair of whole rows, one dt apart, and none of these is lost."""
    t = np.arange(T) + np.array([sum(k > j for j in late) * 3 for k in range(T)])
    x = [np.nan if k in holes else float(k) for k in range(T)]
    rows = [f"{tk},{xk},{10 * k}" for k, (tk, xk) in enumerate(zip(t, x, strict=True))]
    file = text(tmp_path / "log.csv", "\n".join(["t,x,u", *rows]) + "\n")
    pairs = [k for k in range(T - 1) if k not in holes and k + 1 not in holes and t[k + 1] - t[k] == 1]
    if not pairs:
        with pytest.raises(km.errors.DataError, match="no two rows in sequence"):
            km.load_episodes(file, dt=1.0)
        return
    if len(pairs) == T - 1:
        read = km.load_episodes(file, dt=1.0)
    else:
        with pytest.warns(km.FitWarning, match=r"gaps? \(after line .*\) cut 1 episode into \d+; \d+ of \d+ rows"):
            read = km.load_episodes(file, dt=1.0)
    found = [int(x) for e in read for x in e.X[:-1, 0]]
    assert found == pairs
    assert all(np.array_equal(e.U, 10 * e.X[:-1]) for e in read)
    assert all((np.diff(e.X[:, 0]) == 1).all() for e in read)


def test_time_that_goes_back_starts_an_episode(tmp_path: Path) -> None:
    read = km.load_episodes(text(tmp_path / "log.csv", "t,x,u\n0,1,1\n1,2,1\n0,7,1\n1,8,2\n2,9,1\n"))
    assert [e.X.ravel().tolist() for e in read] == [[1, 2], [7, 8, 9]]


def test_unequal_time_is_named_and_resampled(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.08, 0.12, 60))
    rows = [f"{v!r},{2 * v - 1!r},{k}" for k, v in enumerate(t.tolist())]
    file = text(tmp_path / "log.csv", "\n".join(["t,x,u", *rows]))
    with pytest.raises(
        km.errors.DataError, match=r"steps differ from dt = .* by more than 2 %, the first at row 1, where it"
    ) as caught:
        km.load_episodes(file)
    assert caught.value.dt == pytest.approx(np.median(np.diff(t)), rel=1e-3)  # what to resample to
    said = r"log\.csv: sampling is unequal: .*the first at line 3, .*; interpolated to 0\.1 s"
    with pytest.warns(km.FitWarning, match=said):
        km.load_episodes(file, resample=0.1)
    (episode,) = read = km.load_episodes(file, resample=0.05)  # another step is a wish, and no repair
    grid = t[0] + 0.05 * np.arange(len(episode.X))
    assert read.dt == 0.05
    assert grid[-1] <= t[-1] < grid[-1] + 0.05
    assert np.allclose(episode.X[:, 0], 2 * grid - 1, atol=1e-12)  # a straight line is its own interpolation
    held = np.searchsorted(t, grid[:-1] + 1e-9, side="right") - 1
    assert episode.U[:, 0].tolist() == held.tolist()


def test_the_index_that_pandas_writes_is_no_state_and_a_clock_of_another_name_is_told(tmp_path: Path) -> None:
    rows = [f"{k},{0.1 * k:.1f},{k * k},{k % 3}" for k in range(20)]
    file = text(tmp_path / "pandas.csv", "\n".join([",time,x,u", *rows]) + "\n")
    with pytest.warns(km.FitWarning, match=r"'' numbers the rows and is left out"):
        assert km.load_episodes(file).states == ("x",)
    own = [row.partition(",")[2] for row in rows]
    file = text(tmp_path / "zeit.csv", "\n".join(["Zeit,x,u", *own]) + "\n")
    with pytest.warns(km.FitWarning, match="'Zeit' grows by the same in each row"):
        assert km.load_episodes(file, dt=0.1).states == ("Zeit", "x")
    with (
        pytest.warns(km.FitWarning),
        pytest.raises(km.errors.DataError, match="'Zeit' looks like it: rename it by columns=; its columns"),
    ):
        km.load_episodes(file)


def test_columns_that_hold_their_value_are_named_where_no_name_says_input(tmp_path: Path) -> None:
    rows = [f"{k},{k * k},{k // 5},{k // 7}" for k in range(40)]
    file = text(tmp_path / "tank.csv", "\n".join(["time [s],level [m],inflow [V],stroke (%)", *rows]) + "\n")
    with pytest.warns(km.FitWarning, match=r"of these inflow \[V\], stroke \(%\) hold their value .*: pass inputs="):
        assert km.load_episodes(file).nu == 0
    read = km.load_episodes(file, states=("Level",), inputs=("inflow", "stroke"))
    assert (read.states, read.inputs) == (("level [m]",), ("inflow [V]", "stroke (%)"))
    twins = text(tmp_path / "twins.csv", "t,x [m],x [mm],u\n0,1,2,0\n1,2,4,0\n2,4,9,1\n")
    with pytest.raises(km.errors.DataError, match="has no column 'x'"):
        km.load_episodes(twins, states=("x",))


@pytest.mark.parametrize(
    ("content", "error", "said"),
    [
        ("", km.errors.LogError, "it is no .csv file, or was cut"),
        ("\n\n", km.errors.LogError, "it is no .csv file"),
        ("t,x,u\n0,1,2\n1,2\n", km.errors.LogError, "can be read: CSV parse error: Expected 3 columns, got 2"),
        ("0,1,2\n1,2,3\n", km.errors.LogError, "has no line of names: its first row is 0, 1, 2; .* pass columns= with 3"),
        ("0,x,2\n1,2,3\n", km.errors.LogError, "has no line of names: its first row is 0, x, 2; write one above it"),
        ("t,x,x\n0,1,2\n1,2,3\n", km.errors.DataError, "has two columns 'x'; rename one"),
        ("t,u\n0,1\n1,2\n", km.errors.DataError, "has no column that could be a state: its columns are t, u"),
        ("t,x,u\n", km.errors.DataError, "has columns and no row in them; leave the file out"),
        ("x,u\n1,2\n2,3\n", km.errors.DataError, "does not say its sample time: pass dt="),
    ],
)  # fmt: skip
def test_what_is_no_table_is_refused(tmp_path: Path, content: str, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        km.load_episodes(text(tmp_path / "log.csv", content))


@pytest.mark.parametrize(
    ("names", "inputs"),
    [
        ("pump voltage [V],level", "pump voltage [V]"),
        ("valve [%],flow", "valve [%]"),
        ("heater power,T", "heater power"),
        ("motor current (A),speed", "motor current (A)"),
        ("motorVoltage,motor speed,motor current", "motorVoltage"),
        ("u,setpoint,y", "u"),
        ("set point,valve,level setpoint,level", "valve"),
        ("speed,speed_ref,u_speed_cmd", "u_speed_cmd"),
        ("valve position command,valve position", "valve position command"),
        ("force sensor,u0,u_left", "u0,u_left"),
        ("output voltage,duty", "duty"),
        ("steering angle,heading", "steering angle"),
        ("temperature setpoint,temperature", ""),
        ("reference,motor speed,valve temperature", ""),
    ],
)
@pytest.mark.filterwarnings("ignore::koopmpc.FitWarning")
def test_words_anywhere_in_a_name_tell_inputs_and_a_set_point_is_no_part_of_the_plant(
    tmp_path: Path, names: str, inputs: str
) -> None:
    given = names.split(",")
    rows = np.random.default_rng(0).normal(size=(9, len(given)))
    lines = ["sampling_time," + names, *(",".join(map(str, [k, *row])) for k, row in enumerate(rows))]
    read = km.load_episodes(text(tmp_path / "log.csv", "\n".join(lines)))
    assert read.dt == 1.0
    assert read.inputs == tuple(filter(None, inputs.split(",")))
    assert not any("setpoint" in name or "ref" in name or "set point" in name for name in read.states)


@pytest.mark.parametrize("separator", [" ", "\t", " \t ", ",", ";"])
@pytest.mark.parametrize("suffix", [".dat", ".txt", ".CSV"])
def test_a_file_without_a_line_of_names_is_read_by_names_or_by_numbers_of_columns(
    tmp_path: Path, separator: str, suffix: str
) -> None:
    X = np.random.default_rng(0).normal(size=(20, 2))
    lines = [separator.join(map(repr, [6.0 * k, *row])) for k, row in enumerate(X.tolist())]
    file = text(tmp_path / f"log{suffix}", "% of a plant\n" + "\n".join(lines) + "\n")
    read = km.load_episodes(file, columns=["time [min]", "u", "y"])
    assert (read.dt, read.states, read.inputs) == (360.0, ("y",), ("u",))
    assert np.array_equal(read[0].X, X[:, 1:])
    with pytest.warns(km.FitWarning, match="column 1 grows by the same in each row and is taken for the time in sec"):
        read = km.load_episodes(file, inputs=["2"])
    assert (read.dt, read.states, read.inputs) == (6.0, ("column 3",), ("column 2",))
    assert km.load_episodes(file, inputs=["2"], dt=1.0).states == ("column 3",)
    with pytest.raises(km.errors.DataError, match="has 3 columns, columns= gives 2 names; pass one for each"):
        km.load_episodes(file, columns=["u", "y"])


def test_a_saved_table_is_plain_and_keeps_names_roles_and_dt_whatever_the_names(tmp_path: Path) -> None:
    runs = [km.Episode(X=np.full((2, 2), k), U=[[k]], W=[[-k]]) for k in (0.1, 7.0)]
    data = km.Episodes(runs, 1 / 30, ["u1 [m]", "index"], ["position [m], left"], ["w [N]"])
    data.save(tmp_path / "own.csv")
    assert (tmp_path / "own.csv").read_text().splitlines()[:3] == [
        'episode,step,time [s],u1 [m],index,"position [m], left",w [N]',
        "0,0,0.0,0.1,0.1,0.1,-0.1",
        f"0,1,{1 / 30!r},0.1,0.1,,",
    ]
    assert km.load_episodes(tmp_path / "own.csv") == data


@pytest.mark.parametrize(
    "names",
    [
        {"states": ["step"]},
        {"states": ["time [s]"]},
        {"states": [" padded"]},
        {"states": ["1.5"]},
        {"disturbances": ["wind [N]"]},
        {"inputs": ["w1"]},
        {"states": ["sound", "step"]},
        {"states": ["sound", " padded"]},
        {"states": ["sound", "1.5"]},
    ],
)
def test_a_name_that_a_plain_table_would_not_keep_is_refused(tmp_path: Path, names: dict[str, list[str]]) -> None:
    ((*_, name),) = names.values()
    X = np.arange(2 * len(names.get("states", "x"))).reshape(2, -1)
    data = km.Episodes([km.Episode(X=X, U=[[0]], W=[[0]])], 0.1, **names)
    with pytest.raises(km.errors.DataError, match=rf"a \.csv file would not keep the name {re.escape(repr(name))}"):
        data.save(tmp_path / "own.csv")
    assert not any(tmp_path.iterdir())
    if name != "step":
        data.save(tmp_path / "own.parquet")
        assert km.load_episodes(tmp_path / "own.parquet") == data


def table(tmp_path: Path, cells: list[str], header: str = "t,x,v,u") -> Path:
    rows = [f"{0.1 * k},{cell},{k * k},{k % 3}" for k, cell in enumerate(cells)]
    return text(tmp_path / "log.csv", "\n".join([header, *rows, ""]))


@pytest.mark.parametrize("spoilt", ["oops", "0.3+0.1j", "-", " ", "n/a", '"1,5"', "1_000", "９", "١"])
def test_a_cell_that_is_no_number_costs_no_column_in_silence(tmp_path: Path, spoilt: str) -> None:
    file = table(tmp_path, ["1.5", "2.5", spoilt, "4.5", "6"])
    shown = re.escape(spoilt.strip('"'))
    said = rf"log\.csv: 'x' holds '{shown}' in row 3, which is not a real number; repair the cell"
    with pytest.raises(km.errors.DataError, match=said):
        km.load_episodes(file)
    with pytest.raises(km.errors.DataError, match=said):
        km.load_episodes(file, states=["x", "v"], inputs=["u"])
    assert km.load_episodes(file, states=["v"], inputs=["u"]).states == ("v",)


def test_a_column_of_labels_is_no_state(tmp_path: Path) -> None:
    file = table(tmp_path, ["walk", "walk", "2nd", "3", "run"])
    with pytest.warns(km.FitWarning, match="'x' holds text, and no part of it is a state or an input"):
        assert km.load_episodes(file).states == ("v",)


def test_truth_values_with_one_missing_cut_an_episode(tmp_path: Path) -> None:
    file = table(tmp_path, ["true", "false", "", "true", "false"])
    with pytest.warns(km.FitWarning, match="1 gap .* cut 1 episode into 2; 1 of 5 rows are lost"):
        read = km.load_episodes(file)
    assert [episode.X[:, 0].tolist() for episode in read] == [[1, 0], [1, 0]]


def test_files_of_one_name_keep_their_folders_in_a_warning_that_pickles(tmp_path: Path) -> None:
    rows, files = "".join(f"{t},{k},{k % 2}\n" for k, t in enumerate([0, 1, 2.1, 3, 4])), []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        files.append(text(tmp_path / name / "log.csv", f"time [s],level,pump\n{rows}"))
    with pytest.warns(km.FitWarning) as caught:
        km.load_episodes(*files, resample=1.0)
    (sentence,) = (str(one.message) for one in caught)
    assert all(f"{file} (2 of 4, from line 4)" in sentence for file in files)
    assert str(pickle.loads(pickle.dumps(caught[0].message))) == sentence


def test_a_gap_below_a_comment_behind_a_byte_order_mark_is_named_by_its_line(tmp_path: Path) -> None:
    file = text(tmp_path / "log.csv", "# a sheet\ntime [s],level,pump\n0,1,2\n1,3,1\n5,2,2\n6,1,1\n", "utf-8-sig")
    with pytest.warns(km.FitWarning, match=r"1 gap \(after line 4\)"):
        km.load_episodes(file)


def test_what_several_files_share_is_one_sentence_that_names_them(tmp_path: Path) -> None:
    t, files = np.arange(6) + np.array([0, 0, 0.1, 0, 0, 0]), []
    for i in range(12):
        rows = [f"{a:.2f},{i + k},{k},{3 * k % 5}" for k, a in enumerate(t)]
        files.append(
            text(tmp_path / f"run_{i:02d}.csv", "\n".join(["time [s],level,level setpoint,pump", *rows]) + "\n")
        )
    with pytest.warns(km.FitWarning) as caught:
        km.load_episodes(*files, resample=1.0)
    targets, unequal = (str(one.message) for one in caught)
    assert targets == (
        f"12 files ({files[0]} to run_11.csv): 'level setpoint' is a set point of a controller by its name, and left "
        "out; a fit with --goal follows it: --set-point"
    )
    assert unequal.startswith(
        "sampling is unequal in 12 files, interpolated to 1 s; steps that differ by more than 2 %"
    )
    assert all(f"run_{i:02d}.csv (2 of 5, from line 4)" in unequal for i in range(12))
    with pytest.warns(km.FitWarning) as caught, pytest.raises(km.errors.LogError):
        km.load_episodes(files[0], files[1], tmp_path / "none.csv", resample=1.0)  # what was found is said all the same
    assert len(caught) == 2


@pytest.mark.parametrize(("unit", "per_second"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("title", ["timestamp", "time [s]"])
def test_a_clock_of_fractions_of_a_second_since_1970_is_read_in_its_unit(tmp_path, unit, per_second, title) -> None:
    begin = 1_727_783_400
    rows = [f"{round((begin + 10 * k) * per_second)};{k}.5;{k % 2}" for k in range(6)]
    file = text(tmp_path / "log.csv", "\n".join([f"{title};x;u", *rows]) + "\n")
    with pytest.warns(km.FitWarning, match=rf"'{re.escape(title)}' is read in {unit} since 1970"):
        assert km.load_episodes(file).dt == 10.0


@pytest.mark.parametrize("begin", [0, 946_684_000_000, 1_727_783_400])
def test_a_clock_of_another_size_is_read_in_seconds(tmp_path, begin) -> None:
    file = text(tmp_path / "log.csv", "\n".join(["t,x,u", *(f"{begin + 10 * k},{k}.5,{k % 2}" for k in range(6))]))
    assert km.load_episodes(file).dt == 10.0
