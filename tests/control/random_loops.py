"""Random closed loops, from a seeded generator: their statuses, iterations and times in a table.

    python -m tests.control.random_loops --count 1000 --processes 2

A plant has 1 to 4 states and a spectral radius up to 1.3, a controller any of its options: limits of inputs, of their
changes and of states, hard or soft, weights of changes, blocked moves, latency, previews of the reference and of a
measured disturbance, an estimator, a model that is wrong by a few percent, and either solver. With --bilinear the
same loops are those of BilinearMPC, which plans on the same models; with --wild readings are missing or far off.
"""

import argparse
import collections
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import repeat

import numpy as np

import koopmpc as km
import koopmpc.plants.routines

STEPS = 40
FAR = 1e4  # a loop ends where the state of a plant that its inputs cannot hold is this many times its start


@dataclass
class Outcome:
    """What the steps of one loop were: counts of statuses, and for each step iterations, thread time [s], violation."""

    seed: int
    kind: str
    statuses: list[str] = field(default_factory=list)
    solvers: list[str] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    outside: float = 0.0
    hard_states: bool = False
    error: str = ""


def pair(rng, nx, nu):
    """Return A with a spectral radius from 0.3 to 1.3, and B."""
    A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
    return A * rng.uniform(0.3, 1.3) / max(np.abs(np.linalg.eigvals(A)).max(), 0.1), B


def limits_of(rng, nx, nu):
    """Return Limits on inputs, and at times on their changes and on states."""
    most = 10.0 ** rng.uniform(-1.5, 0.5, nu)
    ends = {"u_min": -most * rng.uniform(0.2, 1.0, nu), "u_max": most}
    if rng.random() < 0.05:
        ends["u_min"] = most.copy()  # no room
        ends["u_min"][rng.random(nu) < 0.5] = -np.inf  # one-sided
    if rng.random() < 0.35:
        ends["du_max"] = most * 10.0 ** rng.uniform(-1.5, 0.3, nu)
        if rng.random() < 0.3:
            ends["du_slack"] = (10.0 ** rng.uniform(0, 4), 10.0 ** rng.uniform(-1, 2))
    if rng.random() < 0.6:
        high = 10.0 ** rng.uniform(-0.5, 1, nx)
        high[rng.random(nx) < 0.3] = np.inf
        ends["x_max"] = high
        ends["x_min"] = np.where(rng.random(nx) < 0.2, -np.inf, -high * rng.uniform(0.5, 1, nx))
        draw = rng.random()
        if draw < 0.15:
            ends["slack"] = None
        elif draw < 0.4:
            ends["slack"] = (10.0 ** rng.uniform(-1, 4), 0.0 if rng.random() < 0.3 else 10.0 ** rng.uniform(-2, 3))
        elif draw < 0.5:
            ends["slack"] = (np.where(rng.random(nx) < 0.3, np.inf, 1e3), np.full(nx, 10.0))
    return km.Limits(**ends)


def lifted(rng, A, B, nz, given):
    """Return a model of nz observables of which nz − nx do no more than fade, driven a little by the state."""
    (nx, nu), more = B.shape, nz - len(A)
    lifting = km.State() + km.Gaussian(rng.normal(size=(more, nx)), 1.0)
    whole = np.block(
        [[A, np.zeros((nx, more))], [0.01 * rng.normal(size=(more, nx)), np.diag(rng.uniform(0.1, 0.9, more))]]
    )
    below = np.zeros((more, nu))
    C = np.hstack([np.eye(nx), np.zeros((nx, more))])
    names = tuple(f"x{i}" for i in range(nx)), tuple(f"u{i}" for i in range(nu))
    given = {**given, "E": np.vstack([given["E"], np.zeros((more, 1))])} if given else given
    return km.LinearPredictor(whole, np.vstack([B, below]), C, lifting, 0.1, *names, **given)


def nonlinear(model, cost, limits, horizon, *, solver, moves=None, **options):
    """Return a NonlinearMPC of a linear model, which has no solver to choose."""
    return km.NonlinearMPC(model, cost, limits, horizon, **options)


def loop(seed, solver=None, large=False, bilinear=False, build=None, wild=False):
    """Run the loop of a seed, with the controller that `build` makes of its parts, and return its Outcome.

    With `wild` one reading in twenty is missing or far off, at times five in a row, and half of the loops have an
    estimator.
    """
    rng, spoil = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    nx, nu, N = int(rng.integers(1, 5)), int(rng.integers(1, 3)), int(rng.integers(1, 31))
    if large:
        nx, nu, N = 4, 2, 50
    A, B = pair(rng, nx, nu)
    nw = int(rng.random() < 0.2)
    E = rng.normal(size=(nx, nw)) * 0.05 if nw else None
    names = tuple(f"x{i}" for i in range(nx)), tuple(f"u{i}" for i in range(nu))
    wrong = 0.0 if rng.random() < 0.5 else 0.05
    A_model, B_model = (M * (1 + wrong * rng.normal(size=M.shape)) for M in (A, B))
    given = {} if E is None else {"E": E, "disturbances": ("w",)}
    if large:
        model = lifted(rng, A_model, B_model, 100, given)
    else:
        model = km.LinearPredictor(A_model, B_model, np.eye(nx), km.State(), 0.1, *names, **given)
    weights = {"Q": np.diag(10.0 ** rng.uniform(-2, 1, nx)), "R": np.diag(10.0 ** rng.uniform(-3, 1, nu))}
    if rng.random() < 0.3:
        weights["R_delta"] = np.diag(10.0 ** rng.uniform(-2, 0, nu))
    if rng.random() < 0.4:
        weights["u_target"] = "zero"
    if rng.random() < 0.4:
        weights["Q_N"] = weights["Q"]
    limits = limits_of(rng, nx, nu)
    options = {"latency": int(rng.integers(1, 3))} if rng.random() < 0.2 else {}
    if rng.random() < 0.2:
        options["moves"] = int(rng.integers(1, N + 1))
    if rng.random() < 0.25:
        options["estimator"] = km.LiftedDisturbance(rng.uniform(0.1, 1.0))
    if wild and spoil.random() < 0.5:
        options["estimator"] = km.LiftedDisturbance()
    chosen = "osqp" if rng.random() < 0.75 else "daqp"
    options["solver"] = solver or chosen
    moving, preview = rng.random() < 0.3, rng.random() < 0.5
    bias, noise = 0.02 * rng.normal(size=nx) * (rng.random() < 0.3), 0.01 * (rng.random() < 0.3)
    x = 10.0 ** rng.uniform(-1, 0.7) * rng.normal(size=nx)
    goal = 0.3 * rng.normal(size=nx) * (rng.random() < 0.5)
    W = rng.normal(size=(STEPS + N + 3, nw))
    noises = rng.normal(size=(STEPS, nx))
    outcome = Outcome(seed, options["solver"])
    kept = limits.find_rows(nx, 0)
    outcome.hard_states = bool(np.isinf(kept.softness.linear).any())
    try:
        if bilinear:
            options.pop("solver")
        build = build or (km.BilinearMPC if bilinear else km.KoopmanMPC)
        mpc = build(model, km.Cost(**weights), limits, N, **options)
        path = goal * np.cos(0.2 * np.arange(STEPS + N + 3))[:, None] if moving else np.tile(goal, (STEPS + N + 3, 1))
        box, pending = limits.inputs(nu), [np.clip(np.zeros(nu), *limits.inputs(nu))] * options.get("latency", 0)
        most, burst = FAR * (1 + np.abs(x).max()), 0
        for k in range(STEPS):
            reference = path[k : k + mpc.horizon + 1] if preview else path[k]
            w = None if not nw else W[k : k + mpc.horizon] if preview else W[k]
            y = x + noise * noises[k]
            if wild:
                burst = max(burst - 1, int(spoil.choice([1, 5])) if spoil.random() < 0.05 else 0)
                if burst:
                    y[spoil.integers(nx)] = spoil.choice([np.nan, 50.0, -1e6, 1e29])
            start = time.thread_time()
            move = mpc(y, reference, w=w)
            outcome.seconds.append(time.thread_time() - start)
            outcome.statuses.append(move.status.name)
            outcome.solvers.append(getattr(move, "solver", ""))
            outcome.iterations.append(int(move.iterations))
            outcome.outside = max(outcome.outside, float(np.maximum(box.low - move.u, move.u - box.high).max()))
            pending.append(move.u)
            x = A @ x + B @ pending.pop(0) + bias + (E @ W[k] if nw else 0.0)
            if not np.abs(x).max() < most:
                break
    except Exception as error:
        outcome.error = f"{type(error).__name__}: {error}"
    return outcome


def table(outcomes):
    """Return the lines of the table: counts of statuses and solvers, quantiles of iterations and thread time."""
    statuses = collections.Counter(status for one in outcomes for status in one.statuses)
    solvers = collections.Counter(solver for one in outcomes for solver in one.solvers)
    total = sum(statuses.values())
    lines = [f"{len(outcomes)} loops, {total} steps"]
    lines += [f"{name:16s} {count}" for name, count in statuses.most_common()]
    lines.append("solvers " + ", ".join(f"{name or 'none'} {count}" for name, count in solvers.most_common()))
    bad = [one for one in outcomes if {"MAX_ITERATIONS", "FAILED"} & set(one.statuses)]
    lines.append(f"loops with a failed step {len(bad)}, seeds {[one.seed for one in bad][:12]}")
    false = [one.seed for one in outcomes if "INFEASIBLE" in one.statuses and not one.hard_states]
    steps = sum(one.statuses.count("INFEASIBLE") for one in outcomes if not one.hard_states)
    lines.append(f"INFEASIBLE though no state has a hard limit {steps}, seeds {false[:12]}")
    lines.append(f"outside input limits {max((one.outside for one in outcomes), default=0.0):.2g}")
    errors = collections.Counter(one.error[:110] for one in outcomes if one.error)
    lines += [f"{count} x {error}" for error, count in errors.most_common(8)]
    seeds = [one.seed for one in outcomes if one.error]
    lines.append(f"loops with an exception {len(seeds)}, seeds {seeds[:12]}")
    for what in ("iterations", "seconds"):
        values = np.concatenate([getattr(one, what) for one in outcomes if getattr(one, what)])
        halves = ", ".join(f"p{100 * q:g} {np.quantile(values, q):.4g}" for q in (0.5, 0.99, 0.999))
        lines.append(f"{what}: {halves}, max {values.max():.4g}")
    return lines


def outcomes_of(seeds, processes=1, solver=None, large=False, bilinear=False, build=None, wild=False):
    """Run the loops of some seeds."""
    asked = solver, large, bilinear, build, wild
    if processes == 1:
        return [loop(seed, *asked) for seed in seeds]
    with ProcessPoolExecutor(processes) as pool:
        return list(pool.map(loop, seeds, *map(repeat, asked), chunksize=20))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--solver", choices=("osqp", "daqp"))
    parser.add_argument("--large", action="store_true", help="N = 50, nu = 2, nz = 100, nx = 4")
    parser.add_argument(
        "--bilinear", action="store_true", help="BilinearMPC, interpreted: a loop ends before compiling"
    )
    parser.add_argument("--nonlinear", action="store_true", help="NonlinearMPC on the map of the model")
    parser.add_argument("--wild", action="store_true", help="readings that are missing or far off, more estimators")
    given = parser.parse_args()
    if given.bilinear:
        koopmpc.plants.routines.find_compiler = lambda: None
    seeds = range(given.first, given.first + given.count)
    build = nonlinear if given.nonlinear else None
    found = outcomes_of(seeds, given.processes, given.solver, given.large, given.bilinear, build, given.wild)
    sys.stdout.write("\n".join(table(found)) + "\n")
