"""Calls of everything public with arguments of the wrong kind, drawn by a seed: each must end in a value or an error of ours."""

import inspect
import random
import signal
from abc import ABC
from collections import Counter
from collections.abc import Callable, Iterator
from enum import Enum
from typing import Any

import numpy as np

import koopmpc as km

ROOMS = (
    "identify",
    "validate",
    "data",
    "control",
    "plot",
    "supervise",
    "plants",
    "faults",
    "guarantees",
    "estimate",
    "predict",
)
# What opens a window, runs for minutes, or is given to a program of its own.
LEFT_OUT = (
    "view",
    "serve",
    "cluster",
    "realtime",
    "sweep",
    "export",
    "compiled",
    "video",
    "record",
    "FMUPlant",
    "FMUStep",
)
SECONDS = 10
BAD: list[Any] = [
    *(None, 7, -1, 0, 1e308, float("nan"), float("inf"), 10**30, "", "x", "\x00", b"x", [], {}, object(), [1, 2]),
    *([[1], [2, 3]], np.full((2, 2), np.nan), {1: 2}, len, 1j, np.array([1j, 0]), True, lambda *_: None),
    *(np.zeros((0, 2)), np.array(["a"]), range(3), slice(1)),
]


def public() -> dict[str, Callable[..., Any]]:
    """Return every function and class of the front door and of its rooms that can be called."""
    found: dict[str, Callable[..., Any]] = {}
    for place in (km, *(getattr(km, name) for name in ROOMS)):
        for name in dir(place):
            each = getattr(place, name)
            ours = callable(each) and str(getattr(each, "__module__", "")).startswith("koopmpc")
            if not ours or name.startswith("_") or any(word in name for word in LEFT_OUT):
                continue
            kind = each if isinstance(each, type) else None
            if kind and (issubclass(kind, BaseException | Enum) or ABC in kind.__bases__ or inspect.isabstract(kind)):
                continue
            if kind is None or not getattr(kind, "_is_protocol", False):
                found[f"{place.__name__}.{name}"] = each
    return found


def good() -> list[Any]:
    """Return things of the right kind, for other arguments than those that they are drawn for."""
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, 0.05)
    data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-8, 8), episodes=4, steps=10)
    linear, bilinear = km.edmd(data, km.State() + km.Constant()), km.bilinear_edmd(data, km.State() + km.Constant())
    lqr = km.LQR(linear, problem.cost)
    run = km.simulate(plant, lqr, x0=[0.1, 0], reference=[0, 0], steps=5, cost=problem.cost)
    things = [problem, problem.dynamics, problem.cost, problem.limits, plant, data, linear, bilinear, lqr, run]
    mpc = km.KoopmanMPC(linear, problem.cost, problem.limits, 5)
    return [*things, mpc, km.State(), km.LiftedDisturbance(), 3, 0.05, [0.0, 0.0], [[0.0, 0.0]], "x", ("a", "b")]


def draw(rng: random.Random, function: Callable[..., Any], right: list[Any]) -> tuple[list[Any], dict[str, Any]]:
    """Return arguments for one call."""
    arguments, options = [], {}
    for each in inspect.signature(function).parameters.values():
        if each.kind in (each.VAR_KEYWORD, each.VAR_POSITIONAL):
            continue
        if each.default is not each.empty and rng.random() < 0.6:
            if each.kind is each.POSITIONAL_ONLY:
                break
            continue
        value = rng.choice(BAD if rng.random() < 0.5 else right)
        if each.kind is each.POSITIONAL_ONLY:
            arguments.append(value)
        else:
            options[each.name] = value
    return arguments, options


def _stop(*_: object) -> None:
    raise TimeoutError


def foreign(seed: int, calls: int) -> Iterator[str]:
    """Yield a line for each call that ends in a foreign error, or not within seconds."""
    rng, right, functions = random.Random(seed), good(), public()
    names, before = sorted(functions), signal.signal(signal.SIGALRM, _stop)
    try:
        for _ in range(calls):
            name = rng.choice(names)
            arguments, options = draw(rng, functions[name], right)
            signal.alarm(SECONDS)
            try:
                functions[name](*arguments, **options)
            except km.KoopmpcError:
                continue
            except Exception as error:
                given = {key: f"{value!r:.40}" for key, value in options.items()}
                yield f"{name}: {type(error).__name__}: {error!s:.90} from {[f'{a!r:.40}' for a in arguments]} {given}"
            finally:
                signal.alarm(0)
    finally:
        signal.signal(signal.SIGALRM, before)


if __name__ == "__main__":
    import argparse
    import os
    import sys
    import tempfile
    import warnings

    parser = argparse.ArgumentParser()
    parser.add_argument("--calls", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    os.chdir(tempfile.mkdtemp())
    lines = list(foreign(asked.seed, asked.calls))
    for line, count in Counter(line.split(" from ")[0] for line in lines).most_common():
        example = next(each for each in lines if each.startswith(line))
        sys.stdout.write(f"{count} × {example}\n")
    sys.stdout.write(f"{asked.calls} calls of {len(public())} names, seed {asked.seed}: {len(lines)} foreign\n")
    sys.exit(bool(lines))
