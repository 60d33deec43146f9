"""Sources of episodes in parts, those of Parquet row groups too: each pair once, in order."""

import tracemalloc
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.bare import shown
from tests.example_plants import brute_force, random_episodes


def sets(count: int = 4) -> list[km.Episodes]:
    return [random_episodes(seed, [30, 5], 2, 1) for seed in range(count)]


def folder_of(path: Path, given: list[km.Episodes], suffix: str = ".npz") -> Path:
    for i, one in enumerate(given):
        one.save(path / f"{i}{suffix}")
    return path


def read(source: km.data.Source) -> list[km.Episode]:
    return [episode for part in source.parts() for episode in part.load()]


@pytest.mark.parametrize("suffix", [".npz", ".parquet"])
def test_a_folder_holds_its_files_in_the_order_of_their_names(tmp_path: Path, suffix: str) -> None:
    given = sets()
    (tmp_path / "notes.txt").write_text("no data")
    source = km.data.Files(folder_of(tmp_path, given, suffix))
    assert read(source) == [episode for one in given for episode in one]
    assert (source.dt, source.states, source.inputs) == (0.1, ("x0", "x1"), ("u0",))
    backward = km.data.Files([tmp_path / f"{i}{suffix}" for i in (3, 0)])
    assert read(backward) == [*given[3], *given[0]]


def test_small_files_share_a_part_and_large_ones_do_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = km.data.Files(folder_of(tmp_path, sets()))
    assert [str(part) for part in source.parts()] == [f"{tmp_path}/0.npz and 3 files after it"]
    size = (tmp_path / "0.npz").stat().st_size
    monkeypatch.setattr("koopmpc.data.files.folder._PART", 2 * size)
    assert [len(part.load()) for part in source.parts()] == [4, 4]
    monkeypatch.setattr("koopmpc.data.files.folder._PART", 10)
    assert [str(part) for part in source.parts()] == [str(tmp_path / f"{i}.npz") for i in range(4)]


def test_a_stream_gives_each_set_once_and_a_list_again() -> None:
    given = sets()
    every = [episode for one in given for episode in one]
    once, again = km.data.Stream(iter(given)), km.data.Stream(given)
    assert not once.replayable
    assert again.replayable
    assert read(once) == every
    assert read(again) == read(again) == every
    with pytest.raises(
        km.errors.DataError, match=r"stream was read already.*make a new km\.data\.Stream, or pass Stream a list"
    ):
        once.parts()


def test_a_stream_reads_one_set_ahead_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("koopmpc.data.source._PART", 10)
    given, taken = sets(), []

    def generator() -> Iterator[km.Episodes]:
        for i, one in enumerate(given):
            taken.append(i)
            yield one

    parts = iter(km.data.Stream(generator()).parts())
    assert str(next(parts)) == "set 0 of the stream"
    assert taken == [0, 1]
    assert str(next(parts)) == "set 1 of the stream"


def test_measured_disturbances_come_behind_the_inputs() -> None:
    rng = np.random.default_rng(0)
    episode = km.Episode(X=rng.normal(size=(5, 1)), U=rng.normal(size=(4, 1)), W=rng.normal(size=(4, 2)))
    data = km.Episodes([episode], 0.1)
    driven = km.data.Stream([data]).driven()
    assert driven.inputs == ("u0", "w0", "w1")
    assert [part.load() for part in driven.parts()] == [data.driven()]


def test_the_path_must_be_there_and_hold_episodes(tmp_path: Path) -> None:
    with pytest.raises(km.errors.LogError, match="nowhere does not exist; pass a folder"):
        km.data.Files(tmp_path / "nowhere")
    with pytest.raises(km.errors.LogError, match=r"holds no .npz, .parquet, .csv, .* or .rrd file: it holds nothing"):
        km.data.Files(tmp_path)
    (tmp_path / "a.txt").touch()
    with pytest.raises(km.errors.LogError, match=r"it holds a\.txt"):
        km.data.Files(tmp_path)
    with pytest.raises(km.errors.LogError, match=r"b\.npz is not a file; pass files, or one folder"):
        km.data.Files([tmp_path / "b.npz"])
    with pytest.raises(km.errors.DataError, match="there is no path"):
        km.data.Files([])


def ragged(path: Path) -> km.Episodes:
    if path.name == "1.npz":
        raise km.errors.ShapeError("U has 3 rows and X 9")
    return km.load_episodes(path)


def test_what_a_reader_raises_is_told_with_the_file(tmp_path: Path) -> None:
    source = km.data.Files(folder_of(tmp_path, sets(2)), reader=ragged)
    with pytest.raises(km.errors.ShapeError, match=rf"{tmp_path}/1\.npz: U has 3 rows and X 9"):
        read(source)
    with pytest.raises(km.errors.DataError, match="reader of your own is given no dt; bind them with partial"):
        km.data.Files(tmp_path, reader=ragged, dt=0.1)


def test_a_file_of_another_plant_is_named(tmp_path: Path) -> None:
    first = sets(1)[0]
    for name, other, told in (
        ("a", km.Episodes(first.episodes, 0.2), r"a\.npz has dt = 0\.2 s, .*0\.npz has 0\.1 s; resample"),
        ("b", km.Episodes(first.episodes, 0.1, ["p", "x1"]), r"b\.npz names the states 'p', 'x1', .*'x0', 'x1'"),
        ("c", km.Episodes([km.Episode(X=e.X) for e in first], 0.1), r"c\.npz names the inputs none, .*0\.npz 'u0'"),
    ):
        folder = tmp_path / name
        folder_of(folder, [first])
        other.save(folder / f"{name}.npz")
        with pytest.raises(km.errors.DataError, match=told):
            read(km.data.Files(folder))
    with pytest.raises(km.errors.DataError, match=r"set 1 of the stream has dt = 0\.2 s, set 0 has 0\.1 s"):
        read(km.data.Stream([first, km.Episodes(first.episodes, 0.2)]))


def test_clocks_that_round_are_one_sample_time(tmp_path: Path) -> None:
    first = sets(1)[0]
    folder_of(tmp_path, [first, km.Episodes(first.episodes, 0.1 * (1 + 1e-9))])
    assert len(read(km.data.Files(tmp_path))) == 4


def test_plain_tables_are_read_as_they_are_told(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    for i in range(2):
        x = np.arange(6.0) + i
        pq.write_table(pa.table({"x [m]": x, "u [N]": -x}), tmp_path / f"{i}.parquet")
    how = {"dt": 0.1, "states": ["x [m]"], "inputs": ["u [N]"]}
    assert [e.X[0, 0] for e in read(km.data.Files(tmp_path, **how))] == [0.0, 1.0]
    assert read(km.data.Files(tmp_path, reader=partial(km.load_episodes, **how))) == read(
        km.data.Files(tmp_path, **how)
    )


def test_what_is_no_stream_of_episodes_is_refused() -> None:
    with pytest.raises(km.errors.DataError, match="the stream is empty"):
        km.data.Stream(iter([]))
    lines = shown("""
show(lambda: km.data.Stream(3))
show(lambda: km.data.Stream([1]))
show(lambda: list(km.data.Stream([km.Episodes([km.Episode(X=[[1], [2]])], 0.1), 1]).parts()))
show(lambda: km.edmd([1], km.State()))
""")
    assert lines == [
        "DataError the stream is an int; pass an iterable of Episodes",
        "DataError set 0 of the stream is an int; pass Episodes([Episode(X=…, U=…)], dt)",
        "DataError set 1 of the stream is an int; pass Episodes([Episode(X=…, U=…)], dt)",
        "DataError episodes is a list; pass Episodes([Episode(X=…, U=…), …], dt), what collect returns, "
        "km.data.Files(folder) or km.data.Stream(episodes)",
    ]


LENGTHS = st.lists(st.integers(1, 30), min_size=1, max_size=8)


def pairs(episodes: list[km.Episode], history: int = 0) -> np.ndarray:
    """Return the rows [x u x⁺ w] of all pairs but the first `history` of each episode."""
    rows = [np.hstack([e.X[:-1], e.U, e.X[1:], e.W])[history:] for e in episodes]
    return np.concatenate(rows)


@given(LENGTHS, st.integers(1, 20), st.integers(0, 3), st.integers(0, 99), st.booleans())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_row_groups_hold_each_pair_once_in_order(
    tmp_path: Path, lengths: list[int], rows: int, history: int, seed: int, disturbed: bool
) -> None:
    data = random_episodes(seed, [*lengths, 9], 2, 1)
    if disturbed:
        rng = np.random.default_rng(seed)
        data = km.Episodes([km.Episode(X=e.X, U=e.U, W=rng.normal(size=(len(e), 1))) for e in data], 0.1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("koopmpc.data.files.parquet._GROUP", 8 * rows * (5 + disturbed))
        data.save(tmp_path / "a.parquet")
        patch.setattr("koopmpc.data.files.parquet._LARGE", 0)
        parts = km.data.Files(tmp_path / "a.parquet").parts(history)
    loaded = [part.load() for part in parts]
    assert max(sum(map(len, part)) for part in loaded) <= rows + history + 1
    read = [episode for part in loaded for episode in part]
    assert np.array_equal(pairs(read, history), pairs(list(data), history))


def test_a_folder_cuts_its_large_files_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sets = [random_episodes(i, [n, n], 2, 1) for i, n in enumerate((20, 3000, 20))]
    monkeypatch.setattr("koopmpc.data.files.parquet._GROUP", 64_000)
    for i, one in enumerate(sets):
        one.save(tmp_path / f"{i}.parquet")
    monkeypatch.setattr("koopmpc.data.files.parquet._LARGE", 20_000)
    source = km.data.Files(tmp_path)
    parts = source.parts()
    assert ["(rows " in str(part) for part in parts] == [False, True, True, True, True, False]
    assert str(parts[1]) == f"{tmp_path}/1.parquet (rows 0 to 1599)"
    total = km.moments.second_moments(source, km.State(), route="qr")
    assert km.moments.second_moments(source, km.State(), route="qr", workers=2) == total
    D = np.concatenate([brute_force(one, km.State().bind(one.states)) for one in sets])
    assert np.allclose(total.sums.T @ total.sums, D.T @ D)
    assert total.samples == len(D)


def test_a_large_file_is_never_held(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    episode = km.Episode(X=rng.standard_normal((1_000_001, 4)), U=rng.standard_normal((1_000_000, 1)))
    km.Episodes([episode], 0.1).save(tmp_path / "a.parquet")  # 43 MB
    tracemalloc.start()
    total = km.moments.second_moments(km.data.Files(tmp_path), km.State(), route="gram")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert total.samples == 1_000_000
    assert peak < 45e6


def test_files_that_cannot_be_cut_are_read_whole_and_damage_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    data = random_episodes(0, [50], 2, 1)
    a, b, c, d, e = (tmp_path / f"{name}.parquet" for name in "abcde")
    data.save(a)
    monkeypatch.setattr("koopmpc.data.files.parquet._LARGE", 0)
    pq.write_table(pa.table({"time": [0.0, 0.1, 0.2], "x": [1.0, 2.0, 3.0], "u": [0.0, 1.0, 0.0]}), b)
    assert len(km.data.Files(b).parts()) == 1
    assert [len(one) for part in km.data.Files(b).parts() for one in part.load()] == [2]
    c.write_bytes(b"no table")
    with pytest.raises(km.errors.LogError, match=r"c\.parquet"):
        km.data.Files(c)
    km.Episodes(data.episodes, 0.2).save(d)
    with pytest.raises(km.errors.DataError, match=r"d\.parquet has dt = 0\.2 s, .*a\.parquet has 0\.1 s"):
        [part.load() for part in km.data.Files([a, d]).parts()]
    pq.write_table(pq.read_table(a).take([*range(20), *range(21, 51)]), e)
    with pytest.raises(km.errors.LogError, match=r"e\.parquet \(rows 0 to 49\) holds .*: rows are missing"):
        [part.load() for part in km.data.Files([a, e]).parts()]
    parts = km.data.Files(a).parts()
    a.write_bytes(b"")
    with pytest.raises(km.errors.LogError, match=r"a\.parquet \(rows 0 to 50\) holds no episodes that can be read"):
        parts[0].load()


@pytest.mark.parametrize("share", [0.9e-6, -0.9e-6, 1.1e-6, -1.1e-6])
def test_sample_times_agree_to_a_millionth(share: float) -> None:
    one = random_episodes(0, [5], 2, 1)
    other = km.Episodes(list(one), one.dt * (1 + share), one.states, one.inputs)
    if abs(share) < 1e-6:
        assert len(read(km.data.Stream([one, other]))) == 2
    else:
        with pytest.raises(km.errors.DataError, match=r"has dt = .*; resample one of them"):
            read(km.data.Stream([one, other]))


def test_a_row_group_that_was_changed_is_told_wherever_the_change_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each block of rows has its own checksum, and the last one may hold fewer rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    monkeypatch.setattr("koopmpc.data.files.parquet._GROUP", 8 * 5 * 16)  # sixteen rows of five columns
    monkeypatch.setattr("koopmpc.data.files.parquet._LARGE", 0)
    data = random_episodes(0, [20, 7, 12, 10], 2, 1)  # 53 rows: three blocks and five rows
    data.save(tmp_path / "whole.parquet")
    table = pq.read_table(tmp_path / "whole.parquet")
    assert km.load_episodes(tmp_path / "whole.parquet") == data
    for row in (0, 15, 16, 47, 48, 52):
        for name in (data.states[0], data.states[1], data.inputs[0]):
            column = table[name].to_numpy().copy()
            if np.isnan(column[row]):
                continue  # the input of the last row of an episode
            column[row] += 1e-9
            place = table.column_names.index(name)
            changed = table.set_column(place, table.schema.field(name), pa.array(column, mask=np.isnan(column)))
            pq.write_table(changed, tmp_path / "changed.parquet", row_group_size=16)
            with pytest.raises(km.errors.LogError, match="its numbers are not those that were written"):
                km.load_episodes(tmp_path / "changed.parquet")
            with pytest.raises(km.errors.LogError, match="its numbers are not those that were written"):
                km.dmdc(km.data.Files([tmp_path / "changed.parquet"]))
