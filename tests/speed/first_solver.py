"""Which QP solver should be asked first when the user names none: steps of the same loops with either, in a table.

    OPENBLAS_NUM_THREADS=1 python -m tests.speed.first_solver

Each loop is run once and recorded. Then controllers that ask OSQP or DAQP first replay its steps in turns, three times
each; the least thread time of a step counts. The table has a row for each family of loops, with the time of steps with
a QP where OSQP is asked first over the time where DAQP is, and the share of loops where `solver="auto"` asks the faster
one. `koopmpc/control/solvers/order.py` holds the rule.
"""

import argparse
import contextlib
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

import koopmpc as km
from tests.closed_loop.controllers import CONTROLLERS, Parts
from tests.closed_loop.tasks import TASKS
from tests.control import random_loops

NAMES = ("osqp", "daqp")
TURNS = 3  # replays of a loop by each controller


@dataclass(frozen=True)
class Timing:
    """One loop: its family, the size of its QP, and the thread time [s] of its steps with a QP by each solver.

    `seconds` is the total, `worst` the longest step, `lost` the number of steps without a plan.
    """

    family: str
    title: str
    variables: int
    rows: int
    auto: str
    steps: int
    seconds: dict[str, float]
    worst: dict[str, float]
    lost: dict[str, int]


def time_loop(family: str, title: str, controllers: dict[str, Any], calls: list[tuple[Any, ...]]) -> Timing | None:
    """Replay recorded calls by each controller, in turns; None where no step has a QP."""
    shape = len(calls)
    least = {name: np.full(shape, np.inf) for name in NAMES}
    solved = np.zeros(shape, dtype=bool)
    lost = dict.fromkeys(NAMES, 0)
    for turn in range(TURNS):
        for name in NAMES if turn % 2 else NAMES[::-1]:
            mpc, lost[name] = controllers[name], 0
            mpc.reset()
            for k, (y, reference, w) in enumerate(calls):
                start = time.thread_time()
                move = mpc(y, reference, w=w)
                least[name][k] = min(least[name][k], time.thread_time() - start)
                solved[k] |= bool(move.solver)
                lost[name] += move.status not in (km.Status.UNCONSTRAINED, km.Status.OPTIMAL, km.Status.SOFTENED)
    if not solved.any():
        return None
    rows, variables = controllers["daqp"]._step.solver.qps.qp.A.shape
    auto = controllers["auto"].solver
    times = {name: least[name][solved] for name in NAMES}
    return Timing(
        family,
        title,
        variables,
        rows,
        auto,
        int(solved.sum()),
        {name: float(each.sum()) for name, each in times.items()},
        {name: float(each.max()) for name, each in times.items()},
        lost,
    )


@dataclass(frozen=True)
class LongTiming:
    """One loop of long plans: N, nu and nz, states at their limit, first and mean later step [s], plans apart."""

    size: tuple[int, int, int]
    active: int
    seconds: dict[str, tuple[float, float]]
    apart: float


class Recorded:
    """A controller that keeps the arguments of its calls."""

    def __init__(self, controller: Any, calls: list[tuple[Any, ...]]) -> None:
        self._controller, self._calls = controller, calls

    def __call__(self, y: Any, reference: Any, applied: Any = None, w: Any = None) -> Any:
        self._calls.append((np.array(y), np.array(reference), None if w is None else np.array(w)))
        return self._controller(y, reference, applied, w)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._controller, name)


def build_all(predictor: Any, cost: Any, limits: Any, horizon: int, **options: Any) -> dict[str, Any]:
    """Return a controller for each solver, and the one that a user gets who names none."""
    build = km.KoopmanMPC
    return {name: build(predictor, cost, limits, horizon, **{**options, "solver": name}) for name in (*NAMES, "auto")}


def random_timings(count: int, large: bool) -> Iterator[Timing | None]:
    """Time the random closed loops of seeds 0 … count − 1."""
    family = "random loops, N 50, nu 2, nz 100" if large else "random loops, N ≤ 30, nu ≤ 2"
    for seed in range(count):
        calls: list[tuple[Any, ...]] = []
        built: dict[str, Any] = {}

        def build(*args: Any, calls: Any = calls, built: Any = built, **options: Any) -> Any:
            built |= build_all(*args, **options)
            return Recorded(built["daqp"], calls)

        random_loops.loop(seed, "daqp", large, build=build)
        if calls:
            yield time_loop(family, str(seed), built, calls)


def task_timings() -> Iterator[Timing | None]:
    """Time the ten tasks of tests/closed_loop with a linearisation or a textbook model."""
    for task in TASKS.values():
        parts = Parts(task, 0)
        for kind in ("linear-mpc", "edmd"):
            if not task.measured and kind == "linear-mpc":
                continue
            mpc = CONTROLLERS[kind](parts)
            made = build_all(mpc.predictor, mpc.cost, mpc.limits, mpc.horizon)
            calls: list[tuple[Any, ...]] = []
            recorded = Recorded(made["daqp"], calls)
            with contextlib.suppress(km.KoopmpcError):  # a loop may be lost: its steps until then count
                km.simulate(task.plant, recorded, x0=task.starts[0], reference=task.rows, steps=task.steps)
            yield time_loop("ten tasks", f"{task.name}, {kind}", made, calls[:200])


def draw_model(rng: np.random.Generator, nx: int, nu: int, radius: float) -> km.LinearPredictor:
    """Return a random model with this spectral radius."""
    A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    names = tuple(f"x{i}" for i in range(nx)), tuple(f"u{i}" for i in range(nu))
    return km.LinearPredictor(A, B, np.eye(nx), km.State(), 0.1, *names)


def size_timings(horizons: tuple[int, ...]) -> Iterator[Timing | None]:
    """Time loops with long horizons, up to four inputs, and limits of different structure."""
    rng = np.random.default_rng(0)
    nx = 8
    for N, nu, radius, kind in product(horizons, (1, 4), (0.95, 1.05), ("inputs", "rates", "soft", "hard")):
        for far in (0.5, 4.0):
            model = draw_model(rng, nx, nu, radius)
            end = np.full(nx, np.inf)
            end[:2] = 2.0
            more: dict[str, Any] = {
                "inputs": {},
                "rates": {"du_max": 0.5},
                "soft": {"x_min": -end, "x_max": end},
                "hard": {"x_min": -3 * end, "x_max": 3 * end, "slack": None},
            }[kind]
            cost, limits = km.Cost(np.ones(nx), 0.1 * np.ones(nu)), km.Limits(-1, 1, **more)
            made = build_all(model, cost, limits, N)
            calls: list[tuple[Any, ...]] = []
            mpc, x = Recorded(made["daqp"], calls), far * rng.normal(size=nx)
            begin = time.thread_time()
            for _ in range(20):
                x = model.A @ x + model.B @ mpc(x, np.zeros(nx)).u + 0.05 * far * rng.normal(size=nx)
                if np.abs(x).max() > 1e3 or time.thread_time() - begin > 5.0:
                    break
            title = f"{kind}, radius {radius}, start {far}"
            yield time_loop(f"nx 8, N {N}, nu {nu}", title, made, calls)


def saturated_timings(horizons: tuple[int, ...]) -> Iterator[Timing | None]:
    """Time loops of a stable plant whose reference wanders out of reach, so that most planned inputs are at a limit."""
    rng = np.random.default_rng(2)
    nx = 8
    for N, nu, room, kind in product(horizons, (1, 4), (0.3, 0.1, 0.02), ("inputs", "rates", "soft")):
        model = draw_model(rng, nx, nu, 0.9)
        end = np.full(nx, np.inf)
        end[:2] = 2.0
        more: dict[str, Any] = {
            "inputs": {},
            "rates": {"du_max": room / 2},
            "soft": {"x_min": -end, "x_max": end},
        }[kind]
        made = build_all(model, km.Cost(np.ones(nx), np.ones(nu)), km.Limits(-room, room, **more), N)
        calls: list[tuple[Any, ...]] = []
        mpc, x = Recorded(made["daqp"], calls), 2 * rng.normal(size=nx)
        path = 0.15 * np.cumsum(rng.normal(size=(N + 20, nx)), axis=0)
        begin = time.thread_time()
        for k in range(20):
            x = model.A @ x + model.B @ mpc(x, path[k : k + N + 1]).u + 0.05 * rng.normal(size=nx)
            if time.thread_time() - begin > 5.0:
                break
        yield time_loop(f"saturated, {kind}, n {N * nu}", f"room {room}", made, calls)


def long_timings(horizons: tuple[int, ...]) -> Iterator[LongTiming]:
    """Time long plans with a hard limit of a state at each step, most of which act: DAQP, PIQP, and who names none."""
    rng = np.random.default_rng(3)
    for N, nu, nx in product(horizons, (1, 2), (4, 8, 12)):
        A = np.diag(np.linspace(1.0, 0.6, nx)) + np.diag(0.1 * np.ones(nx - 1), 1)
        names = tuple(f"x{i}" for i in range(nx)), tuple(f"u{i}" for i in range(nu))
        B = 0.1 * rng.uniform(0.5, 1.0, (nx, nu)) * (np.arange(nx) > 0)[:, None]
        model = km.LinearPredictor(A, B, np.eye(nx), km.State(), 0.1, *names)
        end = np.where(np.arange(nx) == 1, 0.5, np.inf)
        limits = km.Limits(-1, 1, x_min=-end, x_max=end, slack=None)
        made = {
            name: km.KoopmanMPC(model, km.Cost(np.ones(nx), 0.1 * np.ones(nu)), limits, N, solver=name)
            for name in ("daqp", "piqp", "auto")
        }
        x, spent = np.where(np.arange(nx) == 0, 0.05 * N, 0.0), dict[str, list[float]]()
        apart = 0.0
        for _ in range(6):
            moves = {}
            for name, mpc in made.items():
                start = time.thread_time()
                moves[name] = mpc(x, np.zeros(nx))
                spent.setdefault(name, []).append(time.thread_time() - start)
            plans = [mpc.plan().U for mpc in made.values()]
            apart = max(apart, max(float(np.abs(plan - plans[0]).max()) for plan in plans))
            x = A @ x + B @ moves["daqp"].u
        active = float((np.abs(made["daqp"].plan().X[1:, 1]) > 0.5 - 1e-6).sum())
        yield LongTiming((N, nu, nx), int(active), {n: (s[0], float(np.mean(s[1:]))) for n, s in spent.items()}, apart)


def print_long(timings: Iterable[LongTiming]) -> None:
    """Print first and mean later steps [ms] of each solver."""
    head = ("N, nu, nz", "states at their limit", "DAQP: first, next", "PIQP", "named by nobody", "plans apart")
    sys.stdout.write("| " + " | ".join(head) + " |\n|" + " --- |" * len(head) + "\n")
    for row in timings:
        times = [f"{1e3 * first:.2g}, {1e3 * later:.2g} ms" for first, later in row.seconds.values()]
        cells = [", ".join(map(str, row.size)), str(row.active), *times, f"{row.apart:.0e}"]
        sys.stdout.write("| " + " | ".join(cells) + " |\n")
        sys.stdout.flush()


def print_table(timings: list[Timing]) -> None:
    """Print a row for each family: ratios OSQP over DAQP, the longest step, and how often the rule is right."""
    families: dict[str, list[Timing]] = defaultdict(list)
    for timing in timings:
        families[timing.family].append(timing)
    head = ("family", "loops", "steps", "total", "median", "least", "most", "worst step", "rule right")
    sys.stdout.write("| " + " | ".join(head) + " |\n|" + " --- |" * len(head) + "\n")
    for family, rows in families.items():
        ratios = np.array([row.seconds["osqp"] / row.seconds["daqp"] for row in rows])
        total = sum(row.seconds["osqp"] for row in rows) / sum(row.seconds["daqp"] for row in rows)
        worst = max(row.worst["osqp"] for row in rows) / max(row.worst["daqp"] for row in rows)
        right = np.mean([min(row.seconds, key=row.seconds.__getitem__) == row.auto for row in rows])
        figures = (total, float(np.median(ratios)), float(ratios.min()), float(ratios.max()), worst)
        cells = [family, str(len(rows)), str(sum(row.steps for row in rows)), *(f"{each:.2g}" for each in figures)]
        sys.stdout.write("| " + " | ".join([*cells, f"{right:.0%}"]) + " |\n")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--loops", type=int, default=150, help="random loops; a tenth of it large ones")
    parser.add_argument("--horizons", type=int, nargs="*", default=(20, 50, 100, 200))
    sources = {
        "random": lambda: random_timings(given.loops, large=False),
        "large": lambda: random_timings(given.loops // 10, large=True),
        "tasks": task_timings,
        "sizes": lambda: size_timings(tuple(given.horizons)),
        "saturated": lambda: saturated_timings(tuple(given.horizons)),
    }
    parser.add_argument("--parts", nargs="*", default=tuple(sources), choices=(*sources, "long"))
    given = parser.parse_args()
    if "long" in given.parts:
        print_long(long_timings(tuple(given.horizons)))
        return
    print_table([timing for part in given.parts for timing in sources[part]() if timing is not None])


if __name__ == "__main__":
    main()
