"""Korteweg–de Vries: 128 points of a wave, lifted to 385 observables, moved by three forces."""

import numpy as np
from jaxtyping import Float

from koopmpc.bench.library import load_problem
from koopmpc.control.cost import Cost
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.move import Status
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.identify.fits.edmd import edmd
from koopmpc.loop.metrics import metrics
from koopmpc.loop.simulate import simulate
from koopmpc.papers.reconstruction import unwarned
from koopmpc.papers.registry import Claim, Tell, judged, show
from koopmpc.plants.step_map import discretize
from koopmpc.recording.page import Page

POINTS, DT, SECONDS, HORIZON = 128, 0.01, 50.0, 10
PLACE = 2 * np.pi * np.arange(POINTS) / POINTS - np.pi
WAVE = np.arange(POINTS // 2 + 1) * (np.arange(POINTS // 2 + 1) < POINTS // 2)  # the highest wave has no slope
FORCES = np.exp(-25.0 * (PLACE - np.array([[-np.pi / 2], [0.0], [np.pi / 2]])) ** 2)
SHAPES = np.stack([np.exp(-((PLACE - np.pi / 2) ** 2)), -(np.sin(PLACE / 2) ** 2), np.exp(-((PLACE + np.pi / 2) ** 2))])
LEVELS = (0.5, 0.0, 0.75)  # of the mean, from 0, T/4 and 2T/3 on


def work(page: Page, quick: bool, tell: Tell) -> list[Claim]:
    """Fit [y, 1, yᵢyᵢ₊₁, y²] to data, and move the wave along three levels."""
    tell("Korteweg–de Vries: data and model")
    problem = load_problem("kdv")
    plant = discretize(problem.dynamics, problem.dt, problem.integrator)
    data = _data(40 if quick else 1000, plant.states, plant.inputs)
    with unwarned():
        model = edmd(data, problem.lifting, ridge=1e-9)
    tell("Korteweg–de Vries: closed loop")
    steps = round((5.0 if quick else SECONDS) / DT)
    rows = np.searchsorted([1 / 4, 2 / 3], np.arange(steps + 1) / steps, side="right")
    reference = np.tile(np.array(LEVELS)[rows, None], (1, POINTS))
    cost = Cost(Q=np.ones(POINTS), R=np.zeros(3), tail=0, u_target="zero")
    mpc = KoopmanMPC(model, cost, problem.limits, HORIZON)
    run = simulate(plant, mpc, x0=SHAPES.mean(axis=0), reference=reference, steps=steps, preview=False, cost=cost)
    seen = metrics(run)
    mean, asked = run.X.mean(axis=1), reference[:, 0]
    bend = run.X.std(axis=1)
    late = [int(k) - 1 for k in np.flatnonzero(np.diff(rows))] + [steps]  # the last moment of each level
    off = [float(np.abs(mean[k] - asked[k])) for k in late]
    page.text(
        "## Korteweg–de Vries: a wave and three forces",
        f"""{len(data)} trajectories of 200 steps, {model.nz} observables. The wave starts as the mean of the three
        shapes that the data mix. Shown are the mean over the ring, and how far the wave is from flat.""",
    )
    page.table(
        ("level", "mean at its end", "standard deviation over the ring"),
        [(f"{asked[k]:g}", f"{mean[k]:.4f}", f"{bend[k]:.4f}") for k in late],
    )
    held = np.vstack([run.U, run.U[-1:]])
    none = np.full((steps + 1, 4), np.nan)
    curves = {
        "reference": np.column_stack([asked, none]),
        "Koopman MPC": np.column_stack([mean, bend, held]),
    }
    columns = ("mean of y", "standard deviation of y", *(f"u, {name.split(' [')[0]}" for name in plant.inputs))
    show(page, "kdv", "Korteweg–de Vries: three levels of the mean", DT, columns, curves)
    limited = np.array([status is not Status.UNCONSTRAINED for status in run.status])
    time, busy = 1e3 * seen.solve_time_p50, 1e3 * float(np.median(run.solve_time[limited]))
    return [
        judged(
            "KdV: levels",
            "the mean follows .5, 0 and .75",
            holds=max(off) < 0.02,
            why="off by " + ", ".join(f"{value:.4f}" for value in off) + " at the end of each",
            required=not quick,
        ),
        judged(
            "KdV: forces", "|u| ≤ 1 in all steps", holds=float(np.abs(run.U).max()) <= 1 + 1e-9, why=f"{steps} steps"
        ),
        judged(
            "KdV: time of a step",
            "0.28 ms",
            holds=max(time, busy) <= 0.28,
            why=f"median {time:.3f} ms; {busy:.3f} ms of the {limited.sum()} steps in which a limit is active",
        ),
    ]


def advanced(y: Float[np.ndarray, "E 128"], u: Float[np.ndarray, "E 3"]) -> Float[np.ndarray, "E 128"]:
    """Return y a step later: half a step of y_xxx, one of RK4 of u's forces less y y_x, half a step of y_xxx."""
    half, force = np.exp(0.5j * DT * WAVE**3), u @ FORCES

    def rest(y: Float[np.ndarray, "E 128"]) -> Float[np.ndarray, "E 128"]:
        return force - np.fft.irfft(1j * WAVE * np.fft.rfft(y**2 / 2), POINTS)

    y = np.fft.irfft(half * np.fft.rfft(y), POINTS)
    k1 = rest(y)
    k2 = rest(y + DT / 2 * k1)
    k3 = rest(y + DT / 2 * k2)
    y = y + DT / 6 * (k1 + 2 * k2 + 2 * k3 + rest(y + DT * k3))
    return np.fft.irfft(half * np.fft.rfft(y), POINTS)


def _data(episodes: int, states: tuple[str, ...], inputs: tuple[str, ...], steps: int = 200) -> Episodes:
    """Return trajectories from mixtures of the three shapes, under forces that are drawn anew at every step."""
    rng = np.random.default_rng(0)
    X, U = np.empty((steps + 1, episodes, POINTS)), rng.uniform(-1, 1, (steps, episodes, 3))
    X[0] = rng.dirichlet([1.0, 1.0, 1.0], episodes) @ SHAPES
    for k in range(steps):
        X[k + 1] = advanced(X[k], U[k])
    return Episodes([Episode(X=X[:, e], U=U[:, e]) for e in range(episodes)], DT, states, inputs)
