"""NeighbourMap: a surrogate of the plant by the nearest rows of the data, a bootstrap of them for each loop."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from koopmpc.base.scene import Scene
from koopmpc.base.values import Value
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.synthesis.search.folds import usual_horizon
from koopmpc.synthesis.task import DesignTask, goal_box


@dataclass(frozen=True)
class NeighbourSettings:
    """How near rows are neighbours, and how the slope of a stand-in by rows is chosen."""

    most_rows: int = 6000  # rows that are kept
    near: int = 3  # neighbours for each coefficient say whether a row is inside the data
    least: int = 12  # neighbours at least
    # choices of the local slope: neighbours for each coefficient, and the ridge, as a share of the largest variance
    # among the columns of v
    slopes: tuple[tuple[int, float], ...] = ((3, 1e-4), (3, 1e-2), (3, 1.0), (20, 1e-4), (20, 1e-2), (20, 1.0))
    ahead: int = 10  # steps of the forecasts that choose among `slopes`
    begun: int = 400  # of these forecasts, at most
    groups: int = 8  # of episodes; each is forecast by the rows of the others
    alike: float = 1.05  # the first of `slopes` is taken whose error is at most this many times the least one
    known: float = 0.99  # share of the data's own rows that is inside the data
    room: float = 1.5  # a row is outside if its neighbours are this many times as far as those of `known`
    probes: int = 256  # points of the goal's range that are looked up in the data
    constant: float = 1e-9  # spread below which a column counts as constant


SETTINGS = NeighbourSettings()


@dataclass(frozen=True, eq=False)
class NeighbourMap(Value):
    """ζ⁺ = ζ + affine(v) + local slope of the k nearest rows around v, v = [ζ; u; w] over its spread.

    States that nothing depends on are left out of v, and of angles that make whole turns v holds sine and cosine. The
    affine part is fitted to all rows; the local slope corrects what it misses, by least squares with tricube
    weights (Cleveland & Devlin, "Locally weighted regression", J. Am. Stat. Assoc. 83, 1988). How local it is, and its
    ridge, are chosen by forecasts of unseen episodes: in logs that hold noise, or were made in closed loop, a few rows
    tell no slope. Where no rows are near, the slope of the nearest ones goes on.
    """

    rows: Float[np.ndarray, "M n"]  # (M, n) v of each row
    steps: Float[np.ndarray, "M nzeta"]  # (M, nzeta) ζ⁺ − ζ
    points: Float[np.ndarray, "M nx"]  # (M, nx) state of each row, without its past
    episode: Int[np.ndarray, " M"]  # (M,) number of the episode of each row, which a bootstrap draws as a whole
    scale: Float[np.ndarray, " n"]  # (n,) spread of v
    # ignored, turning: places in ζ of the states that nothing depends on, and of angles that make whole turns
    ignored: tuple[int, ...]
    turning: tuple[int, ...]
    # middle, w: (nu,) and (nw,) means of the inputs and of the measured disturbances
    middle: Float[np.ndarray, " nu"]
    w: Float[np.ndarray, " nw"]
    noise: Float[np.ndarray, " nx"]  # (nx,) standard deviation of the measurements
    embedding: Delay | None  # the delays of ζ, None where ζ is the state
    # states, inputs: names of the state without its past, and of the inputs
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    dt: float  # sampling time [s]
    # local, ridge: neighbours for each coefficient of the local slope, and its ridge
    local: int = SETTINGS.slopes[0][0]
    ridge: float = SETTINGS.slopes[0][1]
    feedthrough: bool = False  # as of a `Surrogate`

    @classmethod
    def of(
        cls,
        data: Episodes,
        embedding: Delay | None,
        noise: Float[np.ndarray, " nx"],
        ignored: Sequence[int] = (),
        turning: Sequence[int] = (),
        *,
        feedthrough: bool = False,
    ) -> "NeighbourMap":
        """Return the map of these data; of more than 6,000 rows every second, third … is kept."""
        points = data if embedding is None else embedding(data)
        if embedding is not None:  # the past of these states would have to go as well
            ignored, turning = (), ()
        V = np.concatenate([_regress(e.X[:-1], e.U, e.W, ignored, turning) for e in points])
        steps = np.concatenate([np.diff(e.X, axis=0) for e in points])
        number = np.repeat(np.arange(len(points)), [len(e) for e in points])
        spread = V.std(axis=0)
        scale = np.where(spread > SETTINGS.constant * (np.abs(V).max(axis=0) + 1e-300), spread, 1.0)
        apart = -(-len(V) // SETTINGS.most_rows)
        mean = np.concatenate([np.hstack([e.U, e.W]) for e in points]).mean(axis=0)
        found = cls(
            rows=np.ascontiguousarray((V / scale)[::apart]),
            steps=np.ascontiguousarray(steps[::apart]),
            points=np.concatenate([e.X[:-1, : data.nx] for e in points])[::apart],
            episode=number[::apart],
            scale=scale,
            ignored=tuple(ignored),
            turning=tuple(turning),
            middle=mean[: data.nu],
            w=mean[data.nu :],
            noise=noise,
            embedding=embedding,
            states=data.states,
            inputs=data.inputs,
            dt=data.dt,
            feedthrough=feedthrough,
        )
        local, ridge = _choose_slope(found, points)
        return replace(found, local=local, ridge=ridge)

    @cached_property
    def tree(self) -> KDTree:
        """The search tree of the rows."""
        return KDTree(self.rows)

    @property
    def near(self) -> int:
        """Number k of neighbours that say whether a row is inside the data."""
        return min(max(SETTINGS.near * (self.rows.shape[1] + 1), SETTINGS.least), len(self.rows))

    @cached_property
    def reach(self) -> float:
        """Distance to the k-th neighbour beyond which a row is outside the data."""
        apart = -(-len(self.rows) // 1000)
        distance, _ = self.tree.query(self.rows[::apart], self.near)
        return SETTINGS.room * float(np.quantile(np.reshape(distance, (-1, self.near))[:, -1], SETTINGS.known))

    def start(self, x0: Float[np.ndarray, " n"]) -> Float[np.ndarray, " nzeta"]:
        """Return ζ after a rest at x0; x0 itself if it is a ζ."""
        same = self.embedding is None or len(x0) == self.steps.shape[1]
        return x0 if same or self.embedding is None else self.embedding.repeat(x0, self.middle)

    @cached_property
    def pasts(self) -> Float[np.ndarray, "M nzeta"]:
        """ζ of the rows, states with the past that they had in the data; only where there is an embedding."""
        return self.rows[:, : self.steps.shape[1]] * self.scale[: self.steps.shape[1]]

    def scale_rows(
        self, Z: Float[np.ndarray, "T nzeta"], U: Float[np.ndarray, "T nu"], W: Float[np.ndarray, "T nw"] | None = None
    ) -> Float[np.ndarray, "T n"]:
        """Return v of each row over its spread; without W measured disturbances are as on average."""
        W = np.tile(self.w, (len(Z), 1)) if W is None else W
        return _regress(Z, U, W, self.ignored, self.turning) / self.scale

    def find_outside(self, Z: Float[np.ndarray, "T nzeta"], U: Float[np.ndarray, "T nu"]) -> Bool[np.ndarray, " T"]:
        """Return which rows [ζ; u] have no data around them."""
        return self._is_far(self.scale_rows(Z, U))

    def _is_far(self, V: Float[np.ndarray, "n v"]) -> Bool[np.ndarray, " n"]:
        V = np.where(np.isfinite(V), V, 1e6)
        distance, _ = self.tree.query(V, self.near)
        return np.reshape(distance, (len(V), -1))[:, -1] > self.reach

    def scale_states(self, X: Float[np.ndarray, "n nx"]) -> Float[np.ndarray, "n v"]:
        """Return v over its spread at rest in these states, with inputs as they are on average."""
        Z = X if self.embedding is None else np.array([self.start(x) for x in X]).reshape(len(X), self.steps.shape[1])
        return self.scale_rows(Z, np.tile(self.middle, (len(X), 1)))

    def find_outside_states(self, X: Float[np.ndarray, "n nx"]) -> Bool[np.ndarray, " n"]:
        """Return which of these states have no data around them, with inputs as they are on average."""
        return self._is_far(self.scale_states(X))

    @cached_property
    def triangles(self) -> Float[np.ndarray, "P r r"]:
        """For each episode the triangle of [v, 1, ζ⁺ − ζ], from which least squares on weighted episodes follow."""
        table = np.hstack([self.rows, np.ones((len(self.rows), 1)), self.steps])
        size = table.shape[1]
        found = np.zeros((int(self.episode.max()) + 1, size, size))
        for number, one in enumerate(found):
            R = np.linalg.qr(table[self.episode == number], mode="r")
            one[: len(R)] = R
        return found

    def draw(self, rng: np.random.Generator) -> "NeighbourPlant":
        """Return a plant of one bootstrap sample of the episodes."""
        return NeighbourPlant(self, self.draw_many([rng]))

    def draw_many(self, rngs: Sequence[np.random.Generator]) -> "NeighbourPlants":
        """Return a plant for each generator, each of one bootstrap sample of the episodes."""
        number = len(self.triangles)
        counts = np.array([np.bincount(rng.integers(number, size=number), minlength=number) for rng in rngs], float)
        sizes = np.bincount(self.episode, minlength=number)
        counts[((counts > 0) @ sizes) < self.near] = 1.0
        return NeighbourPlants(self, counts.reshape(-1, number))


def _choose_slope(map_: NeighbourMap, episodes: Episodes) -> tuple[int, float]:
    """Return the neighbours for each coefficient and the ridge of the local slope that forecast best."""
    number = len(map_.triangles)  # a last episode may have no row that is kept
    group = np.arange(number) % SETTINGS.groups
    counts = np.array([group != out for out in range(min(SETTINGS.groups, number))], dtype=np.float64)
    ahead = min(SETTINGS.ahead, usual_horizon(episodes)[0])
    apart = -(-sum(len(e) for e in episodes) // SETTINGS.begun)
    at = [(i, k) for i, e in enumerate(list(episodes)[:number]) for k in range(0, len(e) - ahead + 1, apart)]
    at = at[:: max(-(-len(at) // SETTINGS.begun), 1)]
    if number < 2 or (counts @ np.bincount(map_.episode, minlength=number)).min() < map_.near:
        return SETTINGS.slopes[0]
    which = np.array([group[i] for i, _ in at])
    parts = [episodes[i].cut(k, k + ahead) for i, k in at]
    X, U, W = (np.array([getattr(part, name) for part in parts]) for name in "XUW")
    begun, after = X[:, 0], X[:, -1]
    spread = np.maximum(np.concatenate([e.X for e in episodes]).std(axis=0), 1e-300)
    errors: list[float] = []
    plants = NeighbourPlants(map_, counts)
    for slope in SETTINGS.slopes:
        plants.slope, Z = slope, begun
        for k in range(ahead):
            Z = plants.step(Z, U[:, k], which, W[:, k])
        missed: Float[np.ndarray, "n nzeta"] = (Z - after) / spread
        error = float(np.sqrt(np.mean(missed**2)))
        errors.append(error if np.isfinite(error) else np.inf)
    return next(
        slope for slope, error in zip(SETTINGS.slopes, errors, strict=True) if error <= SETTINGS.alike * min(errors)
    )


def _regress(
    Z: Float[np.ndarray, "T nzeta"],
    U: Float[np.ndarray, "T nu"],
    W: Float[np.ndarray, "T nw"],
    ignored: Sequence[int],
    turning: Sequence[int],
) -> Float[np.ndarray, "T n"]:
    """Return v of each row."""
    kept = [i for i in range(Z.shape[1]) if i not in ignored and i not in turning]
    angles = Z[:, list(turning)]
    return np.hstack([Z[:, kept], np.sin(angles), np.cos(angles), U, W])


class NeighbourPlants:
    """x⁺ = F(x, u) of a NeighbourMap, for many loops at once, each with weights of the episodes (E, P) of its own."""

    def __init__(self, map_: NeighbourMap, counts: Float[np.ndarray, "E P"]) -> None:
        self._map, self._counts = map_, counts
        n = map_.rows.shape[1] + 1
        self.slope = map_.local, map_.ridge
        triangles = map_.triangles
        tables = [(np.sqrt(one)[:, None, None] * triangles).reshape(-1, triangles.shape[1]) for one in counts]
        fits: list[Any] = [np.linalg.lstsq(table[:, :n], table[:, n:], rcond=1e-10)[0] for table in tables]
        self._affine: Float[np.ndarray, "E n nzeta"] = np.array(fits, dtype=np.float64).reshape(len(counts), n, -1)

    def step(
        self,
        Z: Float[np.ndarray, "n nzeta"],
        U: Float[np.ndarray, "n nu"],
        which: Int[np.ndarray, " n"],
        W: Float[np.ndarray, "n nw"] | None = None,
    ) -> Float[np.ndarray, "n nzeta"]:
        """Return ζ⁺ of the plants `which`; NaN where ζ or u is not finite."""
        one, Z_next = self._map, np.full(Z.shape, np.nan)
        good = np.isfinite(Z).all(axis=1) & np.isfinite(U).all(axis=1)
        if not good.any():
            return Z_next
        Z, U, which = Z[good], U[good], which[good]
        V = one.scale_rows(Z, U, None if W is None else W[good])
        local, ridge = self.slope
        found = one.tree.query(
            V, min(2 * max(local * (V.shape[1] + 1), SETTINGS.least), len(one.rows))
        )  # a bootstrap has fewer
        distance, places = (np.reshape(part, (len(V), -1)) for part in found)
        affine, near = self._affine[which], one.rows[places]
        width = 1.0001 * np.maximum(distance[:, -1:], 1e-12)
        weight = self._counts[which[:, None], one.episode[places]] * (1 - (distance / width) ** 3) ** 3
        total = weight.sum(axis=1)
        share = weight / np.where(total > 0, total, 1.0)[:, None]
        missed = one.steps[places] - near @ affine[:, :-1] - affine[:, -1:]
        center, mean = (np.einsum("ek,eki->ei", share, rows) for rows in (near, missed))
        D = near - center[:, None]
        weighed = (D * share[..., None]).swapaxes(1, 2)
        S = weighed @ D
        tilt = ridge * np.einsum("eii->ei", S).max(axis=1) + 1e-300
        S = np.where((total > 0)[:, None, None], S + tilt[:, None, None] * np.eye(S.shape[1]), np.eye(S.shape[1]))
        slope = np.asarray(np.linalg.solve(S, weighed @ (missed - mean[:, None])), dtype=np.float64)
        change = np.einsum("ei,eij->ej", V, affine[:, :-1]) + affine[:, -1]
        Z_next[good] = Z + change + mean + np.einsum("ei,eij->ej", V - center, slope)
        return Z_next


class NeighbourPlant:
    """The first of `NeighbourPlants`, a Transition; with feedthrough its state ends with the last input."""

    scene: Scene | None = None

    def __init__(self, map_: NeighbourMap, plants: NeighbourPlants) -> None:
        self._plants, self._first = plants, np.zeros(1, dtype=np.int64)
        self.nx, self.dt, self.inputs, self.outputs = map_.steps.shape[1], map_.dt, map_.inputs, map_.states
        self.states = map_.states if map_.embedding is None else map_.embedding.names
        self._held = len(self.inputs) * map_.feedthrough
        if self._held:
            self.nx, self.states = self.nx + self._held, (*self.states, *(f"{name} before" for name in self.inputs))

    def measure(self, x: ArrayLike) -> Float[np.ndarray, " ny"]:
        """Return the state without its past; with feedthrough that of the next step under the input held."""
        point = np.array(x, dtype=np.float64)
        return (self._step(point, point[-self._held :]) if self._held else point)[: len(self.outputs)]

    def __call__(self, x: ArrayLike, u: ArrayLike) -> Float[np.ndarray, " nzeta"]:
        """x⁺ = F(x, u)."""
        driven = np.asarray(u, dtype=np.float64)
        after = self._step(np.asarray(x, dtype=np.float64), driven)
        return np.concatenate([after, driven]) if self._held else after

    def _step(self, x: Float[np.ndarray, " n"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nzeta"]:
        return self._plants.step(x[None, : len(x) - self._held], u[None], self._first)[0]


def probe_range(
    task: DesignTask, neighbours: NeighbourMap
) -> tuple[Float[np.ndarray, "probes nx"], Bool[np.ndarray, " probes"]]:
    """Return evenly spread points of the goal's range, and which of them have no data around them."""
    from scipy.stats.qmc import Halton  # slow to import

    low, high = goal_box(task)
    X = low + (high - low) * Halton(len(low), scramble=False).random(SETTINGS.probes)
    return X, neighbours.find_outside_states(X)


def choose_starts_to_record(task: DesignTask, neighbours: NeighbourMap, count: int) -> Float[np.ndarray, "n nx"]:
    """Return at most `count` points outside the data, each the farthest from the data and from those before it."""
    X, away = probe_range(task, neighbours)
    X = X[away]
    V = neighbours.scale_states(X)
    distance = np.asarray(neighbours.tree.query(V)[0]) if len(X) else np.zeros(0)
    chosen: list[int] = []
    while len(chosen) < min(count, len(X)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(V - V[chosen[-1]], axis=1))
    return X[chosen]
