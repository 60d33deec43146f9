"""ExperimentPlan: inputs or set points of the next experiment, its band, its abort rules, and what it will teach."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc import checks, disk
from koopmpc.control.limits import Interval
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.data.excitation import Excitation, Policy
from koopmpc.errors import DataError, ShapeError
from koopmpc.experiment.candidates import InputLimiter
from koopmpc.terminal import label_lines, render_text
from koopmpc.text import to_percent, with_unit
from koopmpc.values import Value

WORTH = (
    0.02  # an experiment that lowers the variance of one-step errors by less than this share is not worth its length
)
_PATIENCE = 3  # rows in sequence outside the band that end an experiment


@dataclass(frozen=True, eq=False)
class PlanReview(Value):
    """What logs say of the plan that they were recorded under.

    Attributes
    ----------
    held
        For each episode whether all states stayed inside the planned band.
    steps
        Steps of each log.
    sentences
        What was found, an aborted experiment among it.
    """

    held: tuple[bool, ...]
    steps: tuple[int, ...]
    sentences: tuple[str, ...]

    def __str__(self) -> str:
        """Return the sentences."""
        return "\n".join(self.sentences)


@dataclass(frozen=True, eq=False)
class ExperimentPlan(Excitation):
    """Episodes of the next experiment: u_k = U_k − K (ζ_k − ζ̂_k), or set points for a controller that stands.

    `collect(plant, plan.starts, plan, episodes=plan.episodes, steps=plan.steps)` records it on a plant that can be
    set to a start, `realtime(plan, plant, …)` and `simulate` run one episode; `plan.choose_episode(i)` is the i-th.

    Attributes
    ----------
    U
        (E, T, nu) planned inputs; of a standing controller, those that the model expects.
    X
        (E, T+1, nx) expected states, from the starts on.
    low, high
        (E, T+1, nx) band of the states: a whole episode stays inside with probability `level`.
    K
        (nu, n) gain on the deviation of the point ζ, zero where the plant needs no feedback.
    embedding
        Makes ζ of the state and its past; None without delays.
    box, rates
        Limits of the inputs and of their changes in a step.
    x_low, x_high
        (nx,) limits of the states.
    set_points
        (E, T+1, nr) for `controller`; None where the inputs themselves are planned.
    controller
        The standing controller; None without one.
    dt, states, inputs
        Sampling time [s] and names.
    level
        Probability of the band.
    before, after
        Variance of the model's one-step prediction where the designed loop works, in units of the variance of its
        residuals, with the data as they are and with the planned rows.
    information
        D-optimal gain: by how many nats the log-determinant of the information grows, halved.
    kinds
        What each episode is.
    teaches
        Sentences: what the experiment will teach.
    notes
        Sentences on model, data and starts.
    """

    U: Float[np.ndarray, "E T nu"]
    X: Float[np.ndarray, "E T1 nx"]
    low: Float[np.ndarray, "E T1 nx"]
    high: Float[np.ndarray, "E T1 nx"]
    K: Float[np.ndarray, "nu n"]
    embedding: Delay | None
    box: Interval
    rates: Interval
    x_low: Float[np.ndarray, " nx"]
    x_high: Float[np.ndarray, " nx"]
    set_points: Float[np.ndarray, "E T1 nr"] | None
    controller: Any
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    level: float
    before: float
    after: float
    information: float
    kinds: tuple[str, ...]
    teaches: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.U.shape[2]

    @property
    def steps(self) -> int:
        """Steps of an episode."""
        return self.U.shape[1]

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return self.U.shape[0]

    @property
    def starts(self) -> Float[np.ndarray, "E nx"]:
        """(E, nx) states from which the episodes begin."""
        return self.X[:, 0]

    @property
    def gain(self) -> float:
        """Share by which the variance of one-step errors is expected to fall where the designed loop works."""
        return 1.0 - (1.0 + self.after) / (1.0 + self.before)

    @property
    def is_worth_it(self) -> bool:
        """Whether the experiment is worth its length: False where the gain is below 2 %."""
        return self.gain >= WORTH

    @property
    def verdict(self) -> str:
        """A sentence on whether the experiment is worth its length."""
        share, duration = to_percent(max(self.gain, 0.0)), self.steps * self.episodes * self.dt
        if self.is_worth_it:
            return f"the experiment of {duration:g} s is expected to lower the variance of one-step errors by {share}"
        left = self.before / (1 + self.before)  # what no experiment, however long, could exceed
        end = "nothing is left that this model could learn where the controller works"
        if left >= WORTH:
            end = f"{to_percent(left)} is left to learn, so a longer one may be worth it; else stop here"
        return (
            f"another experiment is not worth its length: {duration:g} s are expected to lower the variance of "
            f"one-step errors by {share}; {end}"
        )

    @property
    def abort_rules(self) -> str:
        """When to stop, in sentences that an operator can follow."""
        rules: list[str] = []
        for name, low, high in zip(self.states, self.x_low, self.x_high, strict=True):
            ends = [f"below {low:.4g}"] * bool(np.isfinite(low)) + [f"above {high:.4g}"] * bool(np.isfinite(high))
            if ends:
                rules.append(with_unit(name, f"is {' or '.join(ends)}"))
        at_once = f"Stop at once if {'; '.join(rules)}. " if rules else ""
        return (
            f"{at_once}Stop if any state is outside its planned band for {_PATIENCE} steps in sequence, or if a sensor "
            "shows no new value for as long. After a stop go back to the usual operation and keep the log: it counts."
        )

    def choose_episode(self, number: int) -> "ExperimentPlan":
        """Return the plan of one episode; numbers beyond the last begin with the first again."""
        i = checks.count(number, "number", least=0) % self.episodes
        cut = slice(i, i + 1)
        points = None if self.set_points is None else self.set_points[cut]
        return replace(
            self,
            U=self.U[cut],
            X=self.X[cut],
            low=self.low[cut],
            high=self.high[cut],
            set_points=points,
            kinds=self.kinds[cut],
        )

    def start(self, steps: int, dt: float, rng: np.random.Generator) -> Policy:
        """Return the policy of the first episode; beyond its end it holds the last input, or the last set point.

        Raises
        ------
        DataError
            The plant has another dt.
        """
        if abs(dt - self.dt) > 1e-9 * self.dt:
            raise DataError(f"the plan has dt = {self.dt:g} s, the plant {dt:g} s; plan again for this sampling time")
        return self._follow_set_points() if self.controller is not None else self._follow_inputs()

    def _follow_set_points(self) -> Policy:
        assert self.set_points is not None
        rows, controller = self.set_points[0], self.controller
        ahead, last = range(controller.horizon + 1), len(self.set_points[0]) - 1

        def policy(k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " nu"]:
            if k == 0:
                controller.reset(y.copy() if np.isfinite(y).all() else None)
            return np.asarray(controller(y, rows[[min(k + i, last) for i in ahead]]).u, dtype=np.float64)

        return policy

    def _follow_inputs(self) -> Policy:
        U, X, K = self.U[0], self.X[0], self.K
        limit, last = InputLimiter(self.box, self.rates), len(self.U[0]) - 1
        deviation = np.zeros(K.shape[1])
        off = np.zeros(X.shape[1])
        moved = np.zeros(self.nu)  # by how much the last input differed from the planned one

        def policy(k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " nu"]:
            nonlocal deviation, moved, off
            at = min(k, last)
            if not K.any():
                return limit(U[at])
            if y.shape != X[0].shape:
                raise ShapeError(f"the plan is for {X.shape[1]} measured states, the plant gives {len(y)}")
            off = np.where(np.isfinite(y), y - X[min(k, last + 1)], off)  # what is not measured stays where it was
            deviation = off if self.embedding is None else self.embedding.shift(deviation, moved, off)
            u = limit(U[at] - K @ deviation)
            moved = u - U[at]
            return u

        return policy

    def save(self, path: str | PathLike[str]) -> None:
        """Write the plan as .csv: a row a step, with inputs, set points, expected states and their band.

        Raises
        ------
        DataError
            The path does not end with .csv.
        LogError
            The path cannot be written.
        """
        if disk.path_of(path).suffix.lower() != ".csv":
            raise DataError(f"{path} does not end with .csv; a plan is a table of text")
        E, T = self.episodes, self.steps
        steps = np.tile(np.arange(T + 1), E)
        held = np.concatenate([self.U, self.U[:, -1:]], axis=1)  # the last row repeats the last input
        columns = [("episode", np.repeat(np.arange(E), T + 1)), ("time [s]", steps * self.dt)]
        if self.set_points is not None:
            rows = self.set_points.reshape(E * (T + 1), -1)
            columns += [(f"set point {i}", rows[:, i]) for i in range(rows.shape[1])]
        expected = "expected " * (self.set_points is not None)
        columns += [(f"{expected}{name}", held[:, :, j].ravel()) for j, name in enumerate(self.inputs)]
        for i, name in enumerate(self.states):
            for what, values in (("expected", self.X), ("low", self.low), ("high", self.high)):
                columns.append((f"{what} {name}", values[:, :, i].ravel()))
        lines = [f"# {line}" for line in str(self).splitlines()]
        lines += [",".join(_quote(name) for name, _ in columns)]
        lines += [",".join(f"{value:.10g}" for value in row) for row in zip(*(v for _, v in columns), strict=True)]
        with disk.writing(path) as file:
            file.write(("\n".join(lines) + "\n").encode())

    def review(self, logs: Episodes) -> PlanReview:
        """Compare logs of this plan with its bands, the i-th log with the i-th episode.

        Raises
        ------
        ShapeError
            The logs have other states.
        """
        logs = episodes_of(logs)
        if logs.nx != len(self.states):
            raise ShapeError(f"the logs have {logs.nx} states, the plan {len(self.states)}; pass logs of this plan")
        held: list[bool] = []
        steps: list[int] = []
        sentences: list[str] = []
        for i, log in enumerate(logs):
            e, n = i % self.episodes, min(len(log), self.steps)
            rows = slice(0, n + 1)
            outside = (log.X[rows] < self.low[e, rows]) | (log.X[rows] > self.high[e, rows])
            held.append(not bool(outside.any()))
            steps.append(n)
            if n < self.steps:
                sentences.append(
                    f"log {i} ends after {n} of {self.steps} steps: the experiment was aborted; these rows count, and "
                    "a new plan from all logs says whether the rest is still worth its time"
                )
            if outside.any():
                k, j = (int(place[0]) for place in np.nonzero(outside))
                reading = with_unit(self.states[j], f"= {log.X[k, j]:.4g}")
                sentences.append(
                    f"log {i} leaves the band at step {k}: {reading}, planned "
                    f"{self.low[e, k, j]:.4g} to {self.high[e, k, j]:.4g}"
                )
            else:
                sentences.append(f"log {i} stays inside the band")
        return PlanReview(tuple(held), tuple(steps), tuple(sentences))

    def __str__(self) -> str:
        """Return the plan in words: verdict, episodes, what it teaches, abort rules."""
        kinds = "; ".join(f"{self.kinds.count(kind)} × {kind}" for kind in dict.fromkeys(self.kinds))
        size = f"{self.episodes} of {self.steps} steps = {self.steps * self.dt:g} s"
        how = "set points for the standing controller" if self.controller is not None else "inputs"
        if self.K.any():
            how = "inputs, with feedback of the deviation from the expected states"
        pairs = [
            ("experiment", self.verdict),
            ("episodes", f"{size}: {kinds}"),
            ("plan of", how),
            ("band", f"holds a whole episode with probability {self.level:g}; inside the limits throughout"),
            *(("teaches", sentence) for sentence in self.teaches),
            ("abort", self.abort_rules),
            *(("note", sentence) for sentence in self.notes),
        ]
        return render_text(label_lines(pairs))


def _quote(name: str) -> str:
    return f'"{name}"' if "," in name else name


def describe_gain(names: Sequence[str], falls: Float[np.ndarray, " p"]) -> tuple[str, ...]:
    """Return a sentence with the names of the terms whose uncertainty falls most, and their shares."""
    together: dict[str, float] = {}
    for name, fall in zip(names, np.maximum(falls, 0.0), strict=True):
        together[name] = together.get(name, 0.0) + float(fall)
    total = sum(together.values())
    ranked = sorted(together, key=lambda name: -together[name])[:3]
    shown = [f"{name} ({to_percent(together[name] / total)})" for name in ranked if together[name] > 0.05 * total]
    return (f"how the next state depends on {', '.join(shown)}",) if shown else ()
