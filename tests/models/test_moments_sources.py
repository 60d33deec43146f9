"""Moments of files, streams, processes and a cluster are the same to the bit; weights count pairs twice."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.cluster import two_workers
from tests.models.plants import brute_force, random_episodes
from tests.tasks import always_dying, by_first_state, dying_reader

LIFTING = km.Constant() + km.State() + km.Monomials(2)
USERS = km.State() + km.Expressions(lambda x: [x[0] * x[1]], ["x0 x1"])  # a lambda, which does not pickle


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    with two_workers() as address:
        yield address


@pytest.fixture
def sets() -> list[km.Episodes]:
    return [random_episodes(seed, [700, 40, 900], 2, 1) for seed in range(3)]


@pytest.fixture
def folder(tmp_path: Path, sets: list[km.Episodes], monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("koopmpc.data.files.folder._PART", 10)
    monkeypatch.setattr("koopmpc.data.source._PART", 10)
    for i, one in enumerate(sets):
        one.save(tmp_path / f"{i}.npz")
    return tmp_path


def gram(m: km.moments.Moments) -> np.ndarray:
    return m.sums if m.route == "gram" else m.sums.T @ m.sums


def close(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a - b).max() <= 1e-12 * max(np.abs(b).max(), 1))


@pytest.mark.parametrize(("lifting", "route"), [(LIFTING, "gram"), (USERS, "qr")], ids=["ours", "users"])
def test_here_on_processes_and_on_dask_the_moments_are_the_same_to_the_bit(
    folder: Path, sets: list[km.Episodes], route: str, lifting: km.State, scheduler: str
) -> None:
    source = km.data.Files(folder)
    here = km.moments.second_moments(source, lifting, route=route)
    told: list[tuple[int, int | None]] = []
    processes = km.moments.second_moments(
        source, lifting, route=route, workers=2, progress=lambda *now: told.append(now)
    )
    assert processes == here
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert km.moments.second_moments(source, lifting, route=route, scheduler=scheduler) == here
    assert km.moments.second_moments(km.data.Stream(iter(sets)), lifting, route=route, scheduler=scheduler) == here
    assert here.samples == sum(len(e) for one in sets for e in one)
    assert close(gram(here), gram(km.moments.second_moments(sets[0] + sets[1] + sets[2], lifting, route=route)))


def test_parts_are_merged_in_the_order_of_the_source(folder: Path, sets: list[km.Episodes]) -> None:
    one, two, three = (km.moments.second_moments(part, LIFTING, route="qr") for part in sets)
    assert km.moments.second_moments(km.data.Files(folder), LIFTING, route="qr") == one + two + three


def test_a_worker_that_dies_while_it_reads_changes_nothing(folder: Path, scheduler: str) -> None:
    here = km.moments.second_moments(km.data.Files(folder), LIFTING, route="gram")
    source = km.data.Files(folder, reader=dying_reader)
    assert km.moments.second_moments(source, LIFTING, route="gram", workers=2) == here
    (folder / "1.died").unlink()
    assert km.moments.second_moments(source, LIFTING, route="gram", scheduler=scheduler) == here
    assert (folder / "1.died").exists()


@pytest.mark.slow
def test_a_file_that_kills_each_worker_is_named(folder: Path) -> None:
    with pytest.raises(km.KoopmpcError, match=rf"task 1, {folder}/1\.npz: each worker that did it died"):
        km.moments.second_moments(km.data.Files(folder, reader=always_dying), LIFTING, route="gram", workers=2)


@pytest.mark.parametrize(("where", "route"), [({}, "gram"), ({"workers": 2}, "qr")], ids=["here", "processes"])
def test_an_observable_that_is_not_finite_is_named_with_its_file(where: dict, route: str, folder: Path) -> None:
    X = np.ones((4, 2))
    X[2, 0] = 0.0
    km.Episodes([km.Episode(X=X, U=np.zeros((3, 1)))], 0.1).save(folder / "1.npz")
    inverse = km.State() + km.Expressions(lambda x: [1 / x[0]], ["1/x"])
    with pytest.raises(km.errors.DataError, match=rf"'1/x' is NaN, infinite or above 1e154 in {folder}/1\.npz; drop"):
        km.moments.second_moments(km.data.Files(folder), inverse, route=route, **where)


def test_a_stream_that_is_read_once_is_summed_in_qr_unless_told(sets: list[km.Episodes]) -> None:
    assert km.moments.second_moments(km.data.Stream(iter(sets)), LIFTING).route == "qr"
    assert km.moments.second_moments(km.data.Stream(iter(sets)), LIFTING, route="gram").route == "gram"
    assert km.moments.second_moments(km.data.Stream(sets), LIFTING).route == "gram"
    spent = km.data.Stream(iter(sets))
    km.moments.second_moments(spent, LIFTING)
    with pytest.raises(km.errors.DataError, match="the stream was read already"):
        km.moments.second_moments(spent, LIFTING)


def test_a_folder_that_turns_out_worse_than_its_first_files_is_read_again_in_qr(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("koopmpc.data.files.folder._PART", 10)
    for i in range(8):
        data = random_episodes(i, [200], 2, 0)
        X = np.array(data[0].X)
        X[50] = [1e9, 1e9] if i == 6 else X[50]
        km.Episodes([km.Episode(X=X)], 0.1).save(tmp_path / f"{i}.npz")
    passes: list[int] = []
    total = km.moments.second_moments(km.data.Files(tmp_path), km.State(), progress=lambda done, _: passes.append(done))
    assert total.route == "qr"
    assert passes == [*range(9), *range(9)]
    assert total == km.moments.second_moments(km.data.Files(tmp_path), km.State(), route="qr")


class Counting:
    """An iterable that begins anew each time, and counts how many sets it has given."""

    def __init__(self, count: int) -> None:
        self.count, self.given = count, 0

    def __iter__(self) -> Iterator[km.Episodes]:
        for i in range(self.count):
            self.given += 1
            yield random_episodes(i, [50], 2, 1)


@pytest.mark.parametrize(("flat", "route", "most"), [(0, "gram", 1 + 20), (1, "qr", 1 + 5 + 20)])
def test_a_replayable_stream_is_judged_by_its_first_sets(
    flat: int, route: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("koopmpc.data.source._PART", 10)
    sets = Counting(20)
    parallel = km.Expressions(lambda x: [x[0] + 1e-9 * x[1]], ["again"])
    total = km.moments.second_moments(km.data.Stream(sets), LIFTING + parallel if flat else LIFTING)
    assert total.samples == 1000
    assert total.route == route
    assert sets.given <= most


def test_every_fit_takes_a_source(folder: Path, sets: list[km.Episodes]) -> None:
    whole = sets[0] + sets[1] + sets[2]
    for fit in (
        lambda data, **how: km.edmd(data, LIFTING, **how),
        lambda data, **how: km.bilinear_edmd(data, LIFTING, **how),
        lambda data, **how: km.dmdc(data, **how),
    ):
        a, b = fit(km.data.Files(folder), workers=2), fit(whole)
        assert np.allclose(a.A, b.A, rtol=0, atol=1e-10)
        assert np.allclose(a.B, b.B, rtol=0, atol=1e-10)
        assert (a.states, a.inputs, a.dt) == (b.states, b.inputs, b.dt)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6), st.integers(0, 999), st.sampled_from(["gram", "qr"]))
def test_a_whole_weight_counts_a_pair_so_many_times(lengths: list[int], seed: int, route: str) -> None:
    data = random_episodes(seed, lengths, 2, 1)
    rng = np.random.default_rng(seed)
    w = [rng.integers(0, 4, len(e)) for e in data]
    w[0][0] = 2
    m = km.moments.second_moments(data, LIFTING, route=route, weights=w)
    D = np.repeat(brute_force(data, LIFTING.bind(data.states)), np.concatenate(w), axis=0)
    assert m.weight == len(D)
    assert m.samples == np.count_nonzero(np.concatenate(w))
    assert close(gram(m), D.T @ D)


def test_weights_are_a_number_an_episode_one_a_step_or_a_function(sets: list[km.Episodes], folder: Path) -> None:
    data = sets[0] + sets[1] + sets[2]
    numbers = [by_first_state(e) for e in data]
    by_number = km.moments.second_moments(data, LIFTING, weights=numbers)
    assert (
        km.moments.second_moments(
            data, LIFTING, weights=[np.full(len(e), w) for e, w in zip(data, numbers, strict=True)]
        )
        == by_number
    )
    assert km.moments.second_moments(data, LIFTING, weights=by_first_state) == by_number
    files = km.moments.second_moments(km.data.Files(folder), LIFTING, weights=by_first_state, workers=2)
    assert close(files.sums, by_number.sums)
    assert files.weight == pytest.approx(by_number.weight)


def test_a_common_factor_of_the_weights_changes_nothing_of_a_fit_but_rounding() -> None:
    data = random_episodes(0, [200, 100], 2, 1)
    plain = km.edmd(data, LIFTING, ridge=1e-3)
    same = km.edmd(data, LIFTING, ridge=1e-3, weights=[7.0, 7.0])
    assert np.allclose(plain.A, same.A, rtol=0, atol=1e-12)
    assert np.allclose(plain.report.residual, same.report.residual, rtol=1e-12)


def test_weighted_coefficients_and_residuals_are_those_of_weighted_least_squares() -> None:
    data = random_episodes(1, [150, 60], 2, 1)
    rng = np.random.default_rng(0)
    w = [rng.uniform(0, 2, len(e)) for e in data]
    fitted = km.edmd(data, km.State(), weights=w)
    D, root = brute_force(data, km.State().bind(data.states)), np.sqrt(np.concatenate(w))[:, None]
    K = np.linalg.lstsq(root * D[:, :3], root * D[:, 3:], rcond=None)[0]
    assert np.allclose(np.hstack([fitted.A, fitted.B]), K.T, rtol=0, atol=1e-12)
    error = (D[:, 3:] - D[:, :3] @ K) ** 2
    size = np.sqrt(np.average(error, axis=0, weights=np.concatenate(w)))
    assert np.allclose(fitted.report.residual, size)


def test_listed_weights_go_with_the_pairs_that_an_embedding_and_disturbances_leave() -> None:
    rng = np.random.default_rng(4)
    lengths = [12, 2, 9]  # the second has no pair of ζ
    parts = [
        km.Episode(X=rng.normal(size=(n + 1, 2)), U=rng.normal(size=(n, 1)), W=rng.normal(size=(n, 1))) for n in lengths
    ]
    data, delay = km.Episodes(parts, 0.1), km.Delay(2)
    w = [rng.uniform(1, 2, n) for n in lengths]
    with pytest.warns(km.FitWarning, match="1 of 3 episodes have 2 steps or less"):
        listed = km.edmd(data, km.State(), embedding=delay, weights=w)
    whole = delay(km.Episodes([parts[0], parts[2]], 0.1)).driven()
    P = np.vstack([np.hstack([e.X[:-1], e.U]) for e in whole])
    T, root = np.vstack([e.X[1:] for e in whole]), np.sqrt(np.concatenate([w[0][2:], w[2][2:]]))[:, None]
    K = np.linalg.lstsq(P * root, T * root, rcond=None)[0]
    assert np.allclose(np.hstack([listed.A, listed.B, listed.E]), K.T, atol=1e-6)


def test_weights_that_do_not_fit_are_refused() -> None:
    data = random_episodes(0, [5, 4], 2, 1)
    with pytest.raises(
        km.errors.ShapeError, match="there are 1 weights and 2 episodes; give each episode a number, or"
    ):
        km.moments.second_moments(data, km.State(), weights=[1.0])
    with pytest.raises(
        km.errors.ShapeError, match=r"the weight of episode 1 has shape \(5,\), expected \(4,\) or a scalar"
    ):
        km.moments.second_moments(data, km.State(), weights=[1.0, np.ones(5)])
    with pytest.raises(km.errors.DataError, match=r"weights is array\(3\.\); pass one item an episode, or a function"):
        km.moments.second_moments(data, km.State(), weights=np.array(3.0))
    with pytest.raises(km.errors.DataError, match="the weight of episode 0 is -1; weights are 0 or above"):
        km.moments.second_moments(data, km.State(), weights=[-1.0, 1.0])
    with pytest.raises(km.errors.DataError, match="the weight of episode 1 holds 1 NaN or inf"):
        km.moments.second_moments(data, km.State(), weights=[1.0, np.nan])
    with pytest.raises(km.errors.DataError, match="all weights are 0; give some pair a weight above 0"):
        km.moments.second_moments(data, km.State(), weights=[0.0, 0.0])
    with pytest.raises(
        km.errors.DataError, match="weights are a list, which needs the order of Episodes; pass a function"
    ):
        km.moments.second_moments(km.data.Stream([data]), km.State(), weights=[1.0, 1.0])
