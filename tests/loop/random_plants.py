"""Random closed loops with all that real plants ask for, from a seeded generator: what went wrong in them, in a table.

    python -m tests.loop.random_plants --count 1000 --processes 2

Each task has its own mix: levels and dwell times, rows of limits in time, measured disturbances with and without a
preview, a periodic disturbance and its estimator, prices, rows of weights, a stage cost, priorities, blocks of each input,
a PID, an LQR or a function that stands by in a Station, hand values and switches, missed readings, and failing solvers.
"""

import argparse
import collections
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field

import numpy as np

import koopmpc as km
import koopmpc.plants.routines

STEPS = 30
KINDS = (km.KoopmanMPC, km.BilinearMPC, km.NonlinearMPC)


@dataclass
class Outcome:
    """What one loop was: its features, counts of statuses, and what must be zero."""

    seed: int
    features: list[str] = field(default_factory=list)
    statuses: collections.Counter = field(default_factory=collections.Counter)
    outside: float = 0.0
    off_levels: int = 0
    early: int = 0
    infinite: int = 0
    error: str = ""


def make_models(rng, nx, nu, nw, *, bilinear):
    """Return a model, and the map of the plant, which is a few percent apart from it."""
    A, B, E = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu)), 0.1 * rng.normal(size=(nx, nw))
    A *= rng.uniform(0.3, 1.02) / np.abs(np.linalg.eigvals(A)).max()
    N, S, M = (0.03 * rng.normal(size=shape) for shape in ((nu, nx, nx), (nw, nx, nx), (nw, nx, nu)))
    names = tuple(f"x{i}" for i in range(nx)), tuple(f"u{i}" for i in range(nu))
    weather = tuple(f"w{i}" for i in range(nw))
    about = np.eye(nx), km.State(), 0.1, *names
    model = km.LinearPredictor(A, B, *about, E=E, disturbances=weather)
    off = 1 + 0.03 * rng.normal(size=A.shape)
    plant = km.BilinearPredictor(A * off, B, N, *about, E=E, S=S, M=M, disturbances=weather)
    if bilinear:
        model = km.BilinearPredictor(A, B, N, *about, E=E, S=S, M=M, disturbances=weather)
    return model, plant.step_map()


def draw_limits(rng, kind, nx, nu, found):
    """Return limits of one task, and note what they hold."""
    most = rng.uniform(0.5, 3.0, nu)
    ends = {"u_min": -most, "u_max": most.copy()}
    if rng.random() < 0.5:
        levels = [np.linspace(-m, m, int(rng.integers(2, 5))).tolist() if rng.random() < 0.7 else None for m in most]
        if any(levels):
            found.append("levels")
            ends["levels"] = levels
            if rng.random() < 0.6:
                found.append("dwell")
                ends["dwell"] = [
                    None if row is None else (2, 3) if len(row) == 2 else int(rng.integers(1, 4)) for row in levels
                ]
    elif rng.random() < 0.4:
        found.append("rates")
        ends["du_max"] = most * rng.uniform(0.1, 1.0)
    if rng.random() < 0.6:
        found.append("states")
        ends["x_max"], ends["x_min"] = rng.uniform(0.3, 3.0, nx), -rng.uniform(0.3, 3.0, nx)
        if kind is km.KoopmanMPC and "levels" not in ends and rng.random() < 0.5:
            found.append("priority")
            ends["priority"] = rng.integers(0, 3, nx)
    if rng.random() < 0.5:
        found.append("rows in time")
        if "levels" in ends:
            if "x_max" in ends:
                ends["x_max"] = ends["x_max"] * rng.uniform(0.5, 1.0, (STEPS + 1, nx))
        else:
            ends["u_max"] = most * np.repeat(rng.uniform(0.2, 1.0, (STEPS // 5 + 1, nu)), 5, axis=0)
    return km.Limits(**ends)


def draw_cost(rng, kind, nx, nu, found):
    """Return the cost of one task, and note what it holds."""
    weights = {"Q": rng.uniform(0.1, 2.0, nx), "R": 10.0 ** rng.uniform(-2, 0, nu)}
    if rng.random() < 0.4:
        weights["R_delta"] = 10.0 ** rng.uniform(-2, 0, nu)
    if rng.random() < 0.3:
        found.append("price")
        weights["price"] = 0.3 * rng.normal(size=(STEPS, nu))
    elif rng.random() < 0.4:
        found.append("rows of weights")
        weights["Q_rows"] = rng.uniform(0.1, 2.0, (STEPS, nx))
    if "Q_rows" not in weights and rng.random() < 0.3:
        found.append("output price")
        weights["output_price"] = 0.3 * rng.normal(size=nx)
    if kind is not km.KoopmanMPC and rng.random() < 0.3:
        found.append("stage")
        weights["stage"] = _charge
    return km.Cost(**weights)


def _charge(x, u):
    return 0.05 * u[0] ** 4 + 0.02 * x[0] ** 2


def draw_controller(rng, kind, model, plant, found):
    """Return the controller of one task, its cost and its limits."""
    nx, nu, N = model.nx, model.nu, int(rng.integers(2, 8))
    limits, cost = draw_limits(rng, kind, nx, nu, found), draw_cost(rng, kind, nx, nu, found)
    options = {}
    if rng.random() < 0.4:
        found.append("periodic")
        options["estimator"] = km.LiftedDisturbance(period=1.7)
    elif rng.random() < 0.3:
        options["estimator"] = km.LiftedDisturbance()
    if rng.random() < 0.2:
        options["latency"] = 1
    if rng.random() < 0.3 and not (limits.in_time and kind is not km.KoopmanMPC):
        found.append("own blocks")
        own = kind is not km.BilinearMPC and "levels" not in found
        options["moves"] = {"u0": max(N // 2, 1)} if own else max(N // 2, 1)
    if rng.random() < 0.15:
        found.append("time limit")
        options["time_limit"] = float(10.0 ** rng.uniform(-5, -3))
    elif kind is not km.KoopmanMPC and "levels" in found:  # else the search may take hours
        options["time_limit"] = 0.05
    if kind is km.NonlinearMPC and rng.random() < 0.5:
        model = plant
    return kind(model, cost, limits, N, **options), cost, limits


def stand_by(rng, mpc, model, cost, limits, found):
    """Return the controller in a station with somebody who stands by, or alone."""
    if rng.random() < 0.4:
        return mpc
    found.append("station")
    nu, hand = model.nu, 3 * rng.normal(size=model.nu)
    plain = km.Limits(u_min=limits.u_min, u_max=limits.u_max)
    draw = rng.random()
    if draw < 0.4:
        standby = km.control.PID(kp=0.3, ki=0.1, dt=model.dt) if nu == 1 and model.nx == 1 else None
    elif draw < 0.7 and isinstance(model, km.LinearPredictor):
        standby = km.LQR(model, km.Cost(Q=cost.Q, R=cost.R), plain)
    else:

        def standby(y, r):
            return -hand

    own = km.Limits(u_min=limits.u_min, u_max=limits.u_max, levels=limits.levels, dwell=limits.dwell)
    return km.supervise.Station(mpc, standby, limits=own, hand=hand, patience=int(rng.integers(1, 4)))


def loop(seed):
    """Run the loop of a seed."""
    rng, outcome = np.random.default_rng([31, seed]), Outcome(seed)
    found = outcome.features
    kind = KINDS[int(rng.choice(3, p=[0.6, 0.3, 0.1]))]
    found.append(kind.__name__)
    nx, nu, nw = int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.random() < 0.5)
    model, plant = make_models(rng, nx, nu, nw, bilinear=kind is not km.KoopmanMPC and rng.random() < 0.6)
    try:
        mpc, cost, limits = draw_controller(rng, kind, model, plant, found)
        acting = stand_by(rng, mpc, model, cost, limits, found)
        switches = {int(k): str(rng.choice(["manual", "automatic", "standby"])) for k in rng.integers(0, STEPS, 3)}
        broken = set(rng.integers(0, STEPS, 3).tolist()) if rng.random() < 0.3 else set()
        missed = set(rng.integers(1, STEPS, 2).tolist()) if rng.random() < 0.4 else set()
        found += ["W"] * nw + ["broken solver"] * bool(broken) + ["missed readings"] * bool(missed)
        _drive(rng, outcome, (acting, mpc), plant, limits, switches, broken, missed)
    except Exception as error:
        outcome.error = f"{type(error).__name__}: {error}"
    return outcome


def _drive(rng, outcome, controllers, plant, limits, switches, broken, missed):
    """Drive the plant, and count what must be zero."""
    (acting, mpc), nx, nu, nw = controllers, len(plant.states), len(plant.inputs), len(plant.disturbances)
    x, goal, preview = rng.normal(size=nx), 0.3 * rng.normal(size=nx), rng.random() < 0.5
    W = np.cumsum(0.3 * rng.normal(size=(STEPS + acting.horizon, nw)), axis=0)
    wave, U = 0.05 * rng.normal(size=nx), []
    late = mpc.latency  # an input acts so many steps later, and keeps the limits of that step
    sent = [np.zeros(nu)] * late
    for k in range(STEPS):
        mpc.solver_fails = k in broken
        if isinstance(acting, km.supervise.Station) and k in switches:
            acting.switch(switches[k])
        y = np.where(rng.random(nx) < 0.7, np.nan, x) if k in missed else x
        w = None if not nw else W[k : k + acting.horizon] if preview else W[k]
        move = acting(y, goal, w=w)
        outcome.statuses[move.status.name] += 1
        row = limits.input_rows(nu, k + late, 1) if limits.in_time else limits.inputs(nu)
        low, high = (np.atleast_2d(end)[0] for end in row)
        outcome.outside = max(outcome.outside, float(np.maximum(low - move.u, move.u - high).max()))
        outcome.infinite += not np.isfinite(move.u).all()
        U.append(move.u)
        sent.append(move.u)
        u = sent.pop(0)
        x = np.asarray(plant(x, u, W[k]) if nw else plant(x, u)) + wave * np.sin(2 * np.pi * k / 17)
        if not np.abs(x).max() < 1e4:
            break
    levels = limits.input_levels(nu)
    if levels is not None:
        outcome.off_levels, early = levels.count_broken(np.array(U))
        outcome.early = early


def table(outcomes):
    """Return the lines of the table."""
    steps = sum(sum(each.statuses.values()) for each in outcomes)
    lines = [f"{len(outcomes)} loops, {steps} steps"]
    features = collections.Counter(name for each in outcomes for name in each.features)
    lines.append("features " + ", ".join(f"{name} {count}" for name, count in features.most_common()))
    statuses = sum((each.statuses for each in outcomes), collections.Counter())
    lines.append("statuses " + ", ".join(f"{name} {count}" for name, count in statuses.most_common()))
    for name in ("error", "outside", "off_levels", "early", "infinite"):
        bad = [each for each in outcomes if (getattr(each, name) if name == "error" else getattr(each, name) > 1e-9)]
        lines.append(f"loops with {name}: {len(bad)}, seeds {[each.seed for each in bad][:10]}")
    errors = collections.Counter(each.error[:150] for each in outcomes if each.error)
    return lines + [f"  {count} x {error}" for error, count in errors.most_common(10)]


def interpret():
    """Leave models to the interpreter: a loop is shorter than its compilation."""
    koopmpc.plants.routines.find_compiler = lambda: None


def run_loops(seeds, processes=1):
    """Run the loops of these seeds."""
    if processes == 1:
        return [*map(loop, seeds)]
    with ProcessPoolExecutor(processes, initializer=interpret) as pool:
        return list(pool.map(loop, seeds, chunksize=10))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    given = parser.parse_args()
    interpret()
    asked = range(given.first, given.first + given.count)
    sys.stdout.write("\n".join(table(run_loops(asked, given.processes))) + "\n")
