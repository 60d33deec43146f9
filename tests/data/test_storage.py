"""Files give back what was saved, to the bit, and refuse what they cannot read."""

import pickle
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import koopmpc as km

SUFFIXES = (".npz", ".parquet", ".csv")


def random_episodes(lengths: list[int], nx: int, nu: int, seed: int, dt: float = 0.05) -> km.Episodes:
    """Any finite float64, subnormal and negative zero too: random bits."""
    rng = np.random.default_rng(seed)

    def floats(*shape: int) -> np.ndarray:
        values = rng.integers(0, 2**64, shape, dtype=np.uint64).view(np.float64)
        return np.where(np.isfinite(values), values, -0.0)

    runs = [km.Episode(X=floats(steps + 1, nx), U=floats(steps, nu)) for steps in lengths]
    return km.Episodes(runs, dt, [f"x{i} [m/s²]" for i in range(nx)], [f"u{i} [N m]" for i in range(nu)])


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    lengths=st.lists(st.integers(1, 5), min_size=1, max_size=5),
    nx=st.integers(1, 3),
    nu=st.integers(0, 2),
    seed=st.integers(0, 2**32 - 1),
    dt=st.floats(1e-9, 1e3),
)
def test_round_trip(tmp_path: Path, suffix: str, lengths: list[int], nx: int, nu: int, seed: int, dt: float) -> None:
    data = random_episodes(lengths, nx, nu, seed, dt)
    data.save(tmp_path / f"data{suffix}")
    assert km.load_episodes(tmp_path / f"data{suffix}") == data


def test_several_files_are_one_set(tmp_path: Path) -> None:
    data = random_episodes([2, 3, 1], 2, 1, 0)
    data[:1].save(tmp_path / "a.npz")
    data[1:].save(str(tmp_path / "b.parquet"))
    assert km.load_episodes(tmp_path / "a.npz", tmp_path / "b.parquet") == data


def test_files_of_unequal_dt_are_refused(tmp_path: Path) -> None:
    for name, dt in (("a.npz", 0.05), ("b.npz", 0.1)):
        random_episodes([2], 2, 1, 0, dt).save(tmp_path / name)
    with pytest.raises(km.errors.DataError, match=r"has dt = 0.1 s, .* has 0.05 s; resample one of them"):
        km.load_episodes(tmp_path / "a.npz", tmp_path / "b.npz")


def test_a_parquet_file_is_a_table_for_other_tools(tmp_path: Path) -> None:
    data = random_episodes([2, 1], 1, 1, 3)
    data.save(tmp_path / "data.parquet")
    table = pq.read_table(tmp_path / "data.parquet")
    assert table.column_names == ["episode", "step", "x0 [m/s²]", "u0 [N m]"]
    assert table["episode"].to_pylist() == [0, 0, 0, 1, 1]
    assert table["step"].to_pylist() == [0, 1, 2, 0, 1]
    assert table["x0 [m/s²]"].to_pylist() == [x for run in data for x in run.X[:, 0].tolist()]
    assert table["u0 [N m]"].to_pylist() == [u for run in data for u in [*run.U[:, 0].tolist(), None]]


@pytest.mark.parametrize("suffix", SUFFIXES[:2])
def test_a_cut_file_is_refused(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"data{suffix}"
    random_episodes([5, 5], 2, 1, 0).save(file)
    whole = file.read_bytes()
    for kept in range(0, len(whole), max(1, len(whole) // 40)):
        file.write_bytes(whole[:kept])
        with pytest.raises(km.errors.LogError, match=f"data{suffix} holds no episodes that can be read"):
            km.load_episodes(file)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_file_of_episodes_is_refused(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"data{suffix}"
    with pytest.raises(km.errors.LogError, match=r"does not exist; pass a file that Episodes\.save wrote"):
        km.load_episodes(file)
    contents = [b"", b"theta, omega\n1, 2\n", pickle.dumps([1])]
    for content in contents[:1] if suffix == ".csv" else contents:  # the second one is a table
        file.write_bytes(content)
        told = rf"holds no episodes that can be read: it is no {suffix} file, or was cut; pass a file that Episodes"
        with pytest.raises(km.errors.LogError, match=told) as caught:
            km.load_episodes(file)
        assert "pickle" not in str(caught.value)
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(km.errors.LogError, match=rf"folder{suffix} is a folder; pass a file that Episodes\.save wrote"):
        km.load_episodes(tmp_path / f"folder{suffix}")


def test_foreign_contents_are_refused(tmp_path: Path) -> None:
    stale = tmp_path / "rows.parquet"
    random_episodes([3, 2], 1, 1, 0).save(stale)
    held = pq.read_table(stale)
    pq.write_table(held.take([0, 1, 3, 4, 5, 6]), stale)
    with pytest.raises(km.errors.LogError, match="rows are missing or out of order"):
        km.load_episodes(stale)
    np.savez(tmp_path / "other.npz", X=np.zeros((3, 1)))
    with pytest.raises(km.errors.LogError, match="it is of another program: it holds X, and lacks U, steps, about"):
        km.load_episodes(tmp_path / "other.npz")


def test_no_pickle_is_opened(tmp_path: Path) -> None:
    pickled = np.array([{"a": 1}], dtype=object)
    np.savez(tmp_path / "evil.npz", X=pickled, U=pickled, steps=pickled, about=pickled)
    with pytest.raises(
        km.errors.LogError, match="it is damaged, or holds something other than arrays of numbers; pass a file"
    ):
        km.load_episodes(tmp_path / "evil.npz")


def test_other_suffixes_and_taken_names_are_refused(tmp_path: Path) -> None:
    data = random_episodes([2], 1, 1, 0)
    with pytest.raises(km.errors.DataError, match=r"in .npz, .parquet, .csv files, not in 'data.xyz'; rename it"):
        data.save(tmp_path / "data.xyz")
    with pytest.raises(km.errors.DataError, match=r"in .npz, .parquet, .csv, .* files, not in 'data.xyz'; rename it"):
        km.load_episodes(tmp_path / "data.xyz")
    taken = km.Episodes(data.episodes, data.dt, states=["step"])
    with pytest.raises(km.errors.DataError, match=r"has a column 'step' of its own; rename the state, or save as .npz"):
        taken.save(tmp_path / "data.parquet")
    taken.save(tmp_path / "data.npz")
    assert km.load_episodes(tmp_path / "data.npz") == taken


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_folders_are_made_and_what_cannot_be_written_is_told(tmp_path: Path, suffix: str) -> None:
    data, file = random_episodes([2], 1, 1, 0), tmp_path / "new" / "er" / f"data{suffix}"
    data.save(file)
    assert km.load_episodes(file) == data
    with pytest.raises(
        km.errors.LogError, match=rf"data{suffix}/data{suffix} cannot be written: .+; pass another path"
    ):
        data.save(file / file.name)
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(km.errors.LogError, match=rf"folder{suffix} is a folder; pass the path of a file in it"):
        data.save(tmp_path / f"folder{suffix}")
