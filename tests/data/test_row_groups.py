"""A large .parquet file is read in groups of rows: each pair once, in order, and never the whole file."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.data.files.parquet import row_groups
from tests.example_plants import brute_force, random_episodes

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
    parts = row_groups(tmp_path / "a.parquet", history, None)
    assert parts is not None
    for part in parts:
        assert sum(map(len, part.load())) <= rows + history + 1
    read = [episode for part in parts for episode in part.load()]
    assert np.array_equal(pairs(read, history), pairs(list(data), history))


def test_a_folder_cuts_its_large_files_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sets = [random_episodes(i, [n, n], 2, 1) for i, n in enumerate((20, 3000, 20))]
    monkeypatch.setattr("koopmpc.data.files.parquet._GROUP", 64_000)
    for i, one in enumerate(sets):
        one.save(tmp_path / f"{i}.parquet")
    monkeypatch.setattr("koopmpc.data.files.storage._LARGE", 20_000)
    source = km.Files(tmp_path)
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
    total = km.moments.second_moments(km.Files(tmp_path), km.State(), route="gram")
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
    monkeypatch.setattr("koopmpc.data.files.storage._LARGE", 0)
    pq.write_table(pa.table({"time": [0.0, 0.1, 0.2], "x": [1.0, 2.0, 3.0], "u": [0.0, 1.0, 0.0]}), b)
    assert row_groups(b, 0, None) is None
    assert [len(one) for part in km.Files(b).parts() for one in part.load()] == [2]
    c.write_bytes(b"no table")
    with pytest.raises(km.errors.LogError, match=r"c\.parquet"):
        km.Files(c)
    km.Episodes(data.episodes, 0.2).save(d)
    with pytest.raises(km.errors.DataError, match=r"d\.parquet has dt = 0\.2 s, .*a\.parquet has 0\.1 s"):
        [part.load() for part in km.Files([a, d]).parts()]
    pq.write_table(pq.read_table(a).take([*range(20), *range(21, 51)]), e)
    with pytest.raises(km.errors.LogError, match=r"e\.parquet \(rows 0 to 49\) holds .*: rows are missing"):
        [part.load() for part in km.Files([a, e]).parts()]
    parts = km.Files(a).parts()
    a.write_bytes(b"")
    with pytest.raises(km.errors.LogError, match=r"a\.parquet \(rows 0 to 50\) holds no episodes that can be read"):
        parts[0].load()
