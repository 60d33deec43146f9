"""A user's own .parquet table is read as the episodes that it holds, and what it lacks is named."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.data.test_storage import random_episodes

TOLD = {"dt": 0.1, "states": ["x"], "inputs": ["u"]}


def written(file: Path, **columns: object) -> Path:
    pq.write_table(pa.table(columns), file)
    return file


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    lengths=st.lists(st.integers(1, 4), min_size=1, max_size=4),
    nu=st.integers(0, 2),
    last=st.sampled_from([None, 7.0]),
    shuffled=st.booleans(),
    text=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_table_is_its_episodes(
    tmp_path: Path, lengths: list[int], nu: int, last: float | None, shuffled: bool, text: bool, seed: int
) -> None:
    """Rows in any order where their steps are told; episodes in the order in which they first come."""
    data = random_episodes(lengths, 2, nu, seed)
    columns: dict[str, list] = {"note": [], "episode": [], "step": []}
    for name in (*data.states, *data.inputs):
        columns[name] = []
    for e, episode in enumerate(data):
        for k in range(len(episode) + 1):
            columns["note"].append("own")
            columns["episode"].append(f"run {9 - e}" if text else 9 - e)
            columns["step"].append(k + 5)
            for name, x in zip(data.states, episode.X[k], strict=True):
                columns[name].append(x)
            for i, name in enumerate(data.inputs):
                columns[name].append(episode.U[k, i] if k < len(episode) else last)
    order = np.arange(len(columns["step"]))
    if shuffled:
        order = np.random.default_rng(seed).permutation(order)
    else:
        del columns["step"]
    table = {name: pa.array(values).take(pa.array(order)) for name, values in columns.items()}
    file = written(tmp_path / "own.parquet", **table)
    first = list(dict.fromkeys(table["episode"].to_pylist()))
    expected = [data[9 - int(str(label).split()[-1])] for label in first]
    read = km.load_episodes(file, dt=data.dt, states=data.states, inputs=data.inputs)
    assert read == km.Episodes(expected, data.dt, data.states, data.inputs)


def test_without_a_column_episode_there_is_one(tmp_path: Path) -> None:
    file = written(tmp_path / "own.parquet", x=[1, 2, 3], u=[4, 5, None])
    expected = km.Episode(X=[[1.0], [2.0], [3.0]], U=[[4.0], [5.0]])
    assert km.load_episodes(file, **TOLD) == km.Episodes([expected], 0.1, ["x"], ["u"])
    assert km.load_episodes(file, file, **TOLD) == km.Episodes([expected] * 2, 0.1, ["x"], ["u"])
    alone = km.load_episodes(file, dt=0.1, states=["x"], inputs=[])
    assert alone == km.Episodes([km.Episode(X=[[1.0], [2.0], [3.0]])], 0.1, ["x"])


def test_a_state_may_be_named_step(tmp_path: Path) -> None:
    file = written(tmp_path / "own.parquet", step=[5.0, 0.0], u=[1.0, 0.0])
    assert km.load_episodes(file, dt=1.0, states=["step"], inputs=["u"])[0].X.tolist() == [[5.0], [0.0]]


@pytest.mark.parametrize(
    ("columns", "told", "text"),
    [
        ({}, {}, r"does not say its sample time: pass dt=, or add a column 'time \[s\]'; its columns are x, u"),
        ({}, {"resample": 0.1}, r"has no column of time to resample by; its columns are x, u"),
        ({}, {"dt": 0.1, "states": []}, r"has no column that could be a state: its columns are x, u; pass states="),
        ({"time [day]": [0, 1, 2]}, {}, r"the unit of 'time \[day\]' is not one of s, ms"),
        ({"time": [1, 1, 1]}, {"states": ["x"]}, r"time does not advance in any two rows; sort the rows by time"),
        ({"time": [2, 1, 0]}, {"states": ["x"], "dt": 1.0}, r"time does not advance in any two rows; sort the rows"),
        ({"time": [0, 0.1, 0.22]}, {"states": ["x"], "inputs": ["u"]},
         r"sampling is unequal: 2 of 2 steps differ from dt = 0\.11 s by more "
         r"than 2 %, the first at row 1, where it is 0\.1 s; pass resample=0\.11"),
        ({}, TOLD | {"states": "x"}, r"states is 'x'; pass a tuple of names"),
        ({}, TOLD | {"states": ["v"]}, r"own\.parquet has no column 'v'; its columns are x, u"),
        ({}, TOLD | {"dt": 0.0}, r"dt is 0 s; it must be above zero"),
        ({"x": [1.0, None, 2.0]}, TOLD, r"own\.parquet: no two rows in sequence hold all states and inputs"),
        ({"u": [None, None, None]}, TOLD, r"own\.parquet: u is not an array of numbers"),
        ({"x": ["a", "b", "c"]}, TOLD, r"own\.parquet: x is not an array of numbers"),
        ({"step": [0, 1, 3]}, TOLD, r"own\.parquet, episode 0: steps are missing or come twice"),
        ({"step": [0, 1, 1]}, TOLD, r"own\.parquet, episode 0: steps are missing or come twice"),
        ({"episode": ["a", "a", None]}, TOLD, r"has rows whose episode is null; give each row"),
        ({"x": pa.array([], pa.float64()), "u": pa.array([], pa.float64())}, TOLD, r"has columns and no row"),
    ],
)  # fmt: skip
def test_what_is_missing_is_named(tmp_path: Path, columns: dict, told: dict, text: str) -> None:
    file = written(tmp_path / "own.parquet", **{"x": [1.0, 2.0, 3.0], "u": [1.0, 2.0, 3.0]} | columns)
    with pytest.raises(km.errors.DataError, match=text):
        km.load_episodes(file, **told)


def test_a_file_of_koopmpc_is_told_nothing(tmp_path: Path) -> None:
    for name in ("data.npz", "data.parquet"):
        random_episodes([2], 1, 1, 0).save(tmp_path / name)
        with pytest.raises(
            km.errors.DataError, match=rf"{name} holds its own names and dt; leave out dt, states and inputs"
        ):
            km.load_episodes(tmp_path / name, dt=0.1)


@pytest.mark.parametrize("start", [0.0, 0.1, 0.3, 1e3, 1.7e6])
@pytest.mark.parametrize("dt", [0.1, 0.01, 1 / 3])
def test_a_log_on_the_grid_that_is_asked_for_is_resampled_to_itself(tmp_path: Path, start: float, dt: float) -> None:
    """Times are those of floating-point numbers: a little before or behind the grid is on it."""
    rows, rng = 200, np.random.default_rng(0)
    X, U = rng.standard_normal(rows), rng.standard_normal(rows)
    for time in (start + dt * np.arange(rows), start + np.cumsum(np.full(rows, dt))):
        lines = [f"{float(t)!r},{float(x)!r},{float(u)!r}" for t, x, u in zip(time, X, U, strict=True)]
        (tmp_path / "log.csv").write_text("\n".join(["time [s],x,u", *lines]) + "\n")
        (episode,) = km.load_episodes(tmp_path / "log.csv", resample=dt)
        assert episode.X.shape == (rows, 1)
        np.testing.assert_allclose(episode.X[:, 0], X, atol=1e-6)
        np.testing.assert_array_equal(episode.U[:, 0], U[:-1])
