"""edmd beside pykoop, pykoopman and datafold on the same pairs and observables; dmd beside PyDMD.

A peer that is not installed is left out. Seconds are of the processor, medians of runs that take turns.
"""

import time
import tracemalloc
import warnings

import numpy as np
import pytest

import koopmpc as km

pytestmark = pytest.mark.speed

PAIRS, NX = 100_000, 4
WIDTH = 0.5
_RNG = np.random.default_rng(0)
CENTERS = _RNG.uniform(-1, 1, (100, NX))


def cart_pole(episodes: int, pairs: int = PAIRS, seed: int = 0) -> km.Episodes:
    """Random pushes from random states, scaled to about one."""
    plant = km.load_problem("cart_pole")
    step_map = km.discretize(plant.dynamics, dt=0.02)
    size = np.array([1.0, 2.0, 1.0, 3.0])
    start = km.Uniform(-size, size)
    data = km.collect(step_map, start, km.Noise(-5, 5, hold=5), episodes=episodes, steps=pairs // episodes, rng=seed)
    return km.Episodes([km.Episode(X=np.clip(e.X / (3 * size), -3, 3), U=e.U / 5) for e in data], data.dt)


class Ours:
    def __init__(self, centers: np.ndarray) -> None:
        self.lifting = km.State() + km.Gaussian(centers, WIDTH)

    def fit(self, data: km.Episodes) -> None:
        self.model = km.edmd(data, self.lifting)

    def step(self, X: np.ndarray, U: np.ndarray) -> np.ndarray:
        return (self.model.lift(X) @ self.model.A.T + U @ self.model.B.T) @ self.model.C.T


class Pykoop:
    """Episodes in one array, with a column that numbers them."""

    def __init__(self, centers: np.ndarray) -> None:
        import pykoop

        bells = pykoop.RbfLiftingFn(
            rbf="gaussian",
            centers=pykoop.DataCenters(centers=centers),
            shape=1 / (np.sqrt(2) * WIDTH),
            offset=0,
        )
        split = pykoop.SplitPipeline(lifting_functions_state=[("psi", bells)], lifting_functions_input=None)
        self.peer = pykoop.KoopmanPipeline(lifting_functions=[("split", split)], regressor=pykoop.Edmd())

    def prepare(self, data: km.Episodes) -> np.ndarray:
        return np.vstack(
            [np.hstack([np.full((len(e.X), 1), i), e.X, np.vstack([e.U, e.U[-1:]])]) for i, e in enumerate(data)]
        )

    def fit(self, table: np.ndarray) -> None:
        self.peer.fit(table, n_inputs=1, episode_feature=True)

    def step(self, X: np.ndarray, U: np.ndarray) -> np.ndarray:
        lifted = self.peer.lift(np.hstack([X, U]), episode_feature=False)
        return (lifted @ self.peer.regressor_.coef_)[:, :NX]


class Pykoopman:
    """Pairs (x, x⁺, u)."""

    def __init__(self, centers: np.ndarray) -> None:
        import pykoopman

        bells = pykoopman.observables.RadialBasisFunction(
            rbf_type="gauss",
            n_centers=len(centers),
            centers=centers.T,
            kernel_width=1 / (np.sqrt(2) * WIDTH),
            include_state=True,
        )
        self.peer = pykoopman.Koopman(observables=bells, regressor=pykoopman.regression.EDMDc())

    def prepare(self, data: km.Episodes) -> tuple[np.ndarray, ...]:
        s = data.snapshots()
        return s.X, s.X_next, s.U

    def fit(self, pairs: tuple[np.ndarray, ...]) -> None:
        X, X_next, U = pairs
        self.peer.fit(X, y=X_next, u=U)

    def step(self, X: np.ndarray, U: np.ndarray) -> np.ndarray:
        return np.real(np.asarray(self.peer.predict(X, U)))


class Datafold:
    """Frames of series."""

    def __init__(self, centers: np.ndarray) -> None:
        self.centers = centers

    def prepare(self, data: km.Episodes):
        from datafold import TSCDataFrame

        X = TSCDataFrame.from_tensor(np.stack([e.X for e in data]), feature_names=list("abcd"))
        U = TSCDataFrame.from_tensor(np.stack([e.U for e in data]), feature_names=["u"])
        return X, U

    def fit(self, frames) -> None:  # a model cannot be fitted twice
        from datafold import EDMD, DMDControl
        from datafold.dynfold import TSCRadialBasis
        from datafold.pcfold import GaussianKernel

        X, U = frames
        bells = TSCRadialBasis(GaussianKernel(epsilon=WIDTH**2), center_type="fit_params")
        self.peer = EDMD(dict_steps=[("psi", bells)], dmd_model=DMDControl(), include_id_state=True)
        self.peer.fit(X, U=U, psi__centers=self.centers)

    def step(self, X: np.ndarray, U: np.ndarray) -> np.ndarray:
        from datafold import TSCDataFrame

        frame = TSCDataFrame.from_tensor(X[None], feature_names=list("abcd"))
        lifted, model = np.asarray(self.peer.transform(frame)), self.peer.dmd_model
        return (lifted @ model.sys_matrix_.T + U @ model.control_matrix_.T)[:, :NX]


PEERS = {"pykoop": Pykoop, "pykoopman": Pykoopman, "datafold": Datafold}


def timed(call) -> float:
    start = time.process_time()
    call()
    return time.process_time() - start


def peak(call) -> float:
    """Return the most memory [MB] that a call took at once, its data not counted."""
    tracemalloc.start()
    call()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most / 1e6


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", list(PEERS))
@pytest.mark.parametrize("observables", [34, 104])
def test_edmd_beside(benchmark, observables: int, name: str) -> None:
    pytest.importorskip(name, reason=f"{name} is not installed")
    data, other = cart_pole(500), cart_pole(50, 5000, seed=1)
    centers = CENTERS[: observables - NX]
    ours, theirs = Ours(centers), PEERS[name](centers)
    given = theirs.prepare(data)
    pairs: list[tuple[float, float]] = []
    benchmark.pedantic(
        lambda: pairs.append((timed(lambda: ours.fit(data)), timed(lambda: theirs.fit(given)))),
        rounds=3,
        warmup_rounds=1,
    )
    memory = peak(lambda: ours.fit(data)), peak(lambda: theirs.fit(given))
    s = other.snapshots()
    size = s.X_next.std(axis=0)
    error = [float(np.sqrt(np.mean(((m.step(s.X, s.U) - s.X_next) / size) ** 2))) for m in (ours, theirs)]
    a, b = np.median(pairs, axis=0)
    benchmark.extra_info |= {
        "ours [s]": round(float(a), 3),
        f"{name} [s]": round(float(b), 3),
        f"{name} / ours": round(float(np.median([y / x for x, y in pairs])), 1),
        "ours [MB]": round(memory[0], 1),
        f"{name} [MB]": round(memory[1], 1),
        "one-step error, ours": error[0],
        f"one-step error, {name}": error[1],
    }
    print(dict(benchmark.extra_info))  # noqa: T201
    assert error[0] <= error[1] * (1 + 1e-6)


def test_the_number_of_episodes_costs_little(benchmark) -> None:
    sets = {count: cart_pole(count) for count in (100, 1000, 5000)}
    ours, seconds = Ours(CENTERS[:30]), {count: [] for count in sets}

    def each() -> None:
        for count, data in sets.items():
            seconds[count].append(timed(lambda data=data: ours.fit(data)))

    benchmark.pedantic(each, rounds=5, warmup_rounds=1)
    benchmark.extra_info |= {f"{n} episodes [s]": round(float(np.median(t)), 4) for n, t in seconds.items()}
    print(dict(benchmark.extra_info))  # noqa: T201


@pytest.mark.parametrize("observables", [34, 100])
def test_a_step_of_a_rollout(benchmark, observables: int) -> None:
    rng = np.random.default_rng(0)
    A = rng.standard_normal((observables, observables))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    B, C = rng.standard_normal((observables, 1)), rng.standard_normal((NX, observables))
    lifting = km.State() + km.Gaussian(CENTERS[: observables - NX], WIDTH)
    model = km.LinearPredictor(A, B, C, lifting, 0.1, [f"x{i}" for i in range(NX)], ["u"])
    x, U, steps = np.ones(NX), rng.standard_normal((1000, 1)), []
    benchmark.pedantic(lambda: steps.append(1e3 * timed(lambda: model.rollout(x, U))), rounds=40)
    benchmark.extra_info["a step [µs] (≤ 2)"] = round(float(np.median(steps)), 2)
    print(dict(benchmark.extra_info))  # noqa: T201


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("rank", [None, 50])
def test_dmd_of_1000_by_1000_beside_pydmd(benchmark, rank: int | None) -> None:
    pydmd = pytest.importorskip("pydmd", reason="pydmd is not installed")
    X = np.random.default_rng(0).standard_normal((1001, 1000))
    data = km.Episodes([km.Episode(X=X)], 0.1)
    pairs: list[tuple[float, float]] = []

    def theirs() -> None:
        pydmd.DMD(svd_rank=-1 if rank is None else rank).fit(X.T)

    def ours() -> None:
        model = km.dmd(data, rank=rank)
        assert model.modes.shape[0] == 1000
        km.spectrum.amplitudes(model, X[0])  # PyDMD computes modes and amplitudes too

    benchmark.pedantic(lambda: pairs.append((timed(ours), timed(theirs))), rounds=3, warmup_rounds=1)
    a, b = np.median(pairs, axis=0)
    benchmark.extra_info |= {
        "ours [s]": round(float(a), 3),
        "pydmd [s]": round(float(b), 3),
        "ours / pydmd (≤ 1)": round(float(np.median([x / y for x, y in pairs])), 2),
    }
    print(dict(benchmark.extra_info))  # noqa: T201


def test_dmd_of_tall_data_in_memory_proportional_to_it(benchmark) -> None:
    shares: dict[str, float] = {}

    def measure() -> None:
        for nx in (25_000, 100_000):
            X = np.random.default_rng(0).standard_normal((201, nx))
            data = km.Episodes([km.Episode(X=X)], 0.1)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", km.FitWarning)
                most = peak(lambda data=data: km.dmd(data, rank=20))
            shares[f"peak / data of {nx} × 200"] = round(1e6 * most / X.nbytes, 2)

    benchmark.pedantic(measure, rounds=1)
    benchmark.extra_info |= shares
    print(dict(benchmark.extra_info))  # noqa: T201
    small, large = shares.values()
    assert large < 1.1 * small
