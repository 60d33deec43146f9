"""The pictures of the site, drawn by the library: `python docs/tools/pictures.py [NAME…]` writes docs/pictures/."""

import json
import re
import sys
from collections.abc import Callable, Iterable
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from drawn import stamp

import koopmpc as km
from koopmpc.apps.bench.controllers import Prepared
from koopmpc.apps.bench.single import run_closed_loop
from koopmpc.apps.bench.store import RunRow
from koopmpc.views.figures.style import LIMIT, REFERENCE, TRUTH, draw_legend, line_style, make_figure, styled
from koopmpc.views.recording.video import export_video

DOCS = Path(__file__).parents[1]


def pendulum(episodes: int = 120) -> tuple[Any, Any, km.Episodes]:
    """Return the problem `pendulum`, its plant, and data under a stabilising feedback with noise."""
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, dt=0.05)
    pd = km.Feedback([[40, 15]], km.Noise(-20, 20), u_min=-25, u_max=25)
    return problem, plant, km.collect(plant, km.Uniform([-1, -1], [1, 1]), pd, episodes=episodes, steps=60)


def start() -> Any:
    """The run of the start page: the pendulum swings up."""
    names: dict[str, Any] = {"__name__": "page"}
    for source in re.findall(r"```python\n(.*?)```", (DOCS / "start.md").read_text(), re.DOTALL):
        exec(compile(source.partition("km.plot.save")[0], "start.md", "exec"), names)
        if "run" in names:
            break
    return km.plot.run(names["run"], width="two columns")


def house() -> Any:
    """What each station of the house makes of a pendulum: data, a model, a forecast, a closed loop."""
    _, plant, data = pendulum()
    train, held_out = data.split(0.8, rng=0)
    model = km.edmd(train, km.State() + km.Fourier(2, states="theta"))
    cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    mpc = km.KoopmanMPC(model, cost, limits, horizon=40)
    run = km.simulate(plant, mpc, x0=[0.8, 0], reference=[0, 0], steps=60, cost=cost, limits=limits)
    made, axes = make_figure(1, 4, width="two columns", height=2.0)
    plane, disk, ahead, loop = axes[0]
    for episode in train[:40]:
        plane.plot(*episode.X.T, color="#0072b2", linewidth=0.4, alpha=0.6)
    plane.set(title="Episodes", xlabel="theta [rad]", ylabel="omega [rad/s]")
    around = np.exp(1j * np.linspace(0, 2 * np.pi, 200))
    disk.plot(around.real, around.imag, **REFERENCE)
    disk.plot(model.eigenvalues.real, model.eigenvalues.imag, "o", markersize=3, color="#d55e00")
    disk.set(title="its model", xlabel="Re λ", ylabel="Im λ", aspect="equal", xlim=(0.6, 1.2), ylim=(-0.3, 0.3))
    episode = held_out[0]
    foretold = model.rollout(episode.X[0], episode.U[:20])
    time = 0.05 * np.arange(21)
    ahead.plot(time, episode.X[:21, 0], **TRUTH)
    ahead.plot(time, foretold[:, 0], **line_style(1))
    ahead.set(title="its forecast", xlabel="time [s]", ylabel="theta [rad]")
    loop.plot(0.05 * np.arange(len(run.X)), run.X[:, 0], **line_style(0))
    loop.axhline(0, **REFERENCE)
    loop.set(title="Run", xlabel="time [s]", ylabel="theta [rad]")
    return made


def moments() -> Any:
    """The error of a regression from sums of products and from a triangular factor, over the condition number."""
    rng = np.random.default_rng(0)
    conditions = 10.0 ** np.arange(1, 13)
    errors: dict[str, list[float]] = {"sums of products": [], "triangular factor": []}
    for condition in conditions:
        U, V = np.linalg.qr(rng.normal(size=(2000, 8)))[0], np.linalg.qr(rng.normal(size=(8, 8)))[0]
        Z, A = (U * condition ** -np.linspace(0, 1, 8)) @ V.T, rng.normal(size=(8, 8))
        Y = Z @ A
        found = (np.linalg.solve(Z.T @ Z, Z.T @ Y), np.linalg.lstsq(Z, Y, rcond=0)[0])
        for name, solved in zip(errors, found, strict=True):
            errors[name].append(float(np.linalg.norm(Z @ solved - Y) / np.linalg.norm(Y)))
    made, axes = make_figure(1, 1, width="two columns", height=2.6)
    (axis,) = axes[0]
    for i, (name, found) in enumerate(errors.items()):
        axis.loglog(conditions, found, label=name, **line_style(i, len(conditions)))
    axis.axvline(1e6, **LIMIT)
    axis.text(1.3e6, 1e-9, "the fit changes\nits route here", fontsize=8)
    axis.set(xlabel="condition number of the scaled observables", ylabel="residual beyond the optimum, relative")
    draw_legend(made, [axis], 2)
    return made


def riccati_first() -> Any:
    """Why the QP is not for the inputs: its condition number over the horizon; and how often there is no QP at all."""
    problem, plant, data = pendulum()
    local = km.LinearPredictor.local(plant, *problem.equilibrium)
    A, B = local.A[:2, :2], local.B[:2]
    gain = km.dlqr(A, B, [10, 1], [0.1])
    horizons = range(5, 121, 5)
    plain = []
    for N in horizons:
        powers = [np.eye(2)]
        for _ in range(N):
            powers.append(A @ powers[-1])
        G = np.block([[powers[i - j] @ B if j <= i else np.zeros((2, 1)) for j in range(N)] for i in range(N)])
        weights = np.kron(np.eye(N), np.diag([10.0, 1.0]))
        weights[-2:, -2:] = gain.P
        plain.append(np.linalg.cond(G.T @ weights @ G + 0.1 * np.eye(N)))
    model = km.edmd(data, km.State() + km.Fourier(2, states="theta"))
    cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    run = km.simulate(
        plant, km.KoopmanMPC(model, cost, limits, horizon=40), x0=[0.8, 0], reference=[0, 0], steps=60, limits=limits
    )
    made, axes = make_figure(1, 2, width="two columns", height=2.6)
    left, right = axes[0]
    left.semilogy(horizons, plain, label="for the inputs", **line_style(1))
    left.semilogy(horizons, np.ones(len(plain)), label="for the deviation from the Riccati plan", **line_style(0))
    left.set(xlabel="horizon [steps]", ylabel="condition number of the QP")
    solved = np.array([status is not km.Status.UNCONSTRAINED for status in run.status])
    steps = np.arange(len(run.U))
    right.step(steps, run.U[:, 0], where="post", color="#000000", linewidth=0.8)
    right.plot(steps[solved], run.U[solved, 0], "o", markersize=4, color="#d55e00", label="a QP was solved")
    right.plot(steps[~solved], run.U[~solved, 0], ".", markersize=3, color="#0072b2", label="one product of matrices")
    right.axhline(-25, **LIMIT)
    right.set(xlabel="step", ylabel="torque [N m]")
    left.legend(fontsize=7)
    right.legend(fontsize=7)
    return made


def terminal_cost() -> Any:
    """Closed-loop cost over the horizon, with the default tail behind it and without one."""
    _, plant, data = pendulum()
    model = km.edmd(data, km.State() + km.Fourier(2, states="theta"))
    limits = km.Limits(u_min=-25, u_max=25)
    judged = km.Cost(Q=[10, 1], R=0.1)
    horizons = [2, 4, 6, 8, 10, 14, 20, 30, 40]
    best = None
    made, axes = make_figure(1, 1, width="two columns", height=2.6)
    (axis,) = axes[0]
    for i, (name, tail) in enumerate({"with its tail, the default": None, "Q_N = Q: no tail": 0}.items()):
        costs = []
        for N in horizons:
            mpc = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1, tail=tail), limits, N)
            run = km.simulate(plant, mpc, x0=[0.6, 0], reference=[0, 0], steps=150, cost=judged, limits=limits)
            costs.append(km.metrics(run).cost)
        best = best or min(costs)
        axis.semilogy(horizons, np.array(costs) / best, label=name, **line_style(i, len(horizons)))
    axis.set(xlabel="horizon [steps]", ylabel="cost in closed loop,\nover the least")
    draw_legend(made, [axis], 2)
    return made


def one_step_errors() -> Any:
    """Two models of one pendulum, other observables, other data: the better one on its own data forecasts worse."""
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, dt=0.05)
    swings = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=120, steps=40)
    train, held_out = swings.split(0.5)
    timid = km.collect(plant, km.Uniform([-0.2, -0.2], [0.2, 0.2]), km.Noise(-1, 1), episodes=60, steps=40)
    circle = km.Fourier(2, states=["theta"])
    good = km.edmd(train, km.State() + circle + circle * km.State(["omega"]))
    bad = km.edmd(timid, km.State() + km.Monomials(5))
    made, axes = make_figure(1, 2, width="two columns", height=2.6)
    bars, curves = axes[0]
    for i, (name, model) in enumerate({"sines and cosines, wide data": good, "monomials, timid data": bad}.items()):
        bars.bar(i, model.report.residual[1], color=line_style(i)["color"], width=0.6)
        score = km.score(model, held_out, horizon=12)
        curves.semilogy(np.arange(1, 13), score.rmse[:, 1], label=name, **line_style(i, 12))
    bars.set(ylabel="error after one step,\nits own data [rad/s]", xticks=[0, 1])
    bars.set_xticklabels(["sines and cosines,\nwide data", "monomials to 5,\ntimid data"])
    curves.set(xticks=range(0, 13, 3), xlabel="steps ahead", ylabel="error, held-out data [rad/s]")
    draw_legend(made, [curves], 2)
    return made


def choosing_by_closed_loop() -> Any:
    """What models forecast, and what controllers on them cost: forecasts alone do not choose."""
    problem = km.load_problem("cart_pole")
    plant, training = km.discretize(problem.dynamics, problem.dt), problem.training
    data = km.collect(plant, training.x0, training.excitation, episodes=60, steps=training.steps)
    train, held_out = data.split(0.7, rng=0)
    cost, limits = problem.cost, problem.limits
    starts = [[0.0, 0.0, np.pi - 0.45, 0.0], [0.0, 0.0, np.pi + 0.3, 0.5], [-1.0, 0.0, np.pi, 0.0]]
    best = sum(
        _cost(plant, km.NonlinearMPC(plant, cost, limits, 40, solver="fatrop"), x0, cost, limits) for x0 in starts
    )
    waves = km.Fourier(1, states="theta")
    families = {
        "plain": [km.State(), km.State() + km.Constant()],
        "monomials": [km.State() + km.Monomials(d) + km.Constant() for d in (2, 3)],
        "sines": [km.State() + km.Fourier(h, states="theta") + km.Constant() for h in (1, 2, 3)],
        "sines × states": [km.State() + waves + waves * km.State() + km.Constant()],
        "radial": [km.State() + km.ThinPlate(_centers(train, c)) + km.Constant() for c in (20, 60)],
    }
    made, axes = make_figure(1, 1, width="two columns", height=3.0)
    (axis,) = axes[0]
    for i, (name, liftings) in enumerate(families.items()):
        points = []
        for lifting in liftings:
            for ridge in (0.0, 1e-8, 1e-5, 1e-3):
                model = km.edmd(train, lifting, ridge=ridge)
                error = float(km.score(model, held_out, horizon=20).rmse[-1, 2])
                mpc = km.KoopmanMPC(model, cost, limits, 40)
                loops = sum(_cost(plant, mpc, x0, cost, limits) for x0 in starts)
                points.append((error, min(loops / best, 100)))
        axis.loglog(
            *np.array(points).T,
            linestyle="none",
            marker=line_style(i, 8)["marker"],
            color=line_style(i)["color"],
            label=name,
        )
    axis.set(xlabel="error of θ 20 steps ahead, held-out data [rad]", ylabel="cost in closed loop,\nover nonlinear MPC")
    draw_legend(made, [axis], 5)
    return made


def _cost(plant: Any, mpc: Any, x0: list[float], cost: km.Cost, limits: km.Limits) -> float:
    """Return the cost of a run of the cart-pole to upright."""
    mpc.reset()
    return km.metrics(
        km.simulate(plant, mpc, x0=x0, reference=[0, 0, np.pi, 0], steps=150, cost=cost, limits=limits)
    ).cost


def _centers(data: km.Episodes, count: int) -> np.ndarray:
    """Return states of the data, drawn at random."""
    X = data.snapshots().X
    return X[np.random.default_rng(0).choice(len(X), count, replace=False)]


def what_trust_means() -> Any:
    """A forecast inside its band; and how many forecasts stay inside, of data like those and in closed loop."""
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, dt=0.05)
    swings = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=120, steps=40)
    train, held_out = swings.split(0.5)
    circle = km.Fourier(2, states=["theta"])
    model = km.edmd(train, km.State() + circle + circle * km.State(["omega"]))
    band = km.validate.conformal(model, held_out[:40], horizon=12)
    mpc = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-5, u_max=5), horizon=12)
    runs = [
        km.simulate(plant, mpc, x0=x0, reference=[0.5, 0], steps=40)
        for x0 in np.random.default_rng(0).uniform(-1, 1, (20, 2))
    ]
    loop = held_out.with_episodes([km.Episode(X=run.X, U=run.U) for run in runs])
    time = 0.05 * np.arange(1, 13)
    made, axes = make_figure(1, 2, width="two columns", height=2.6, sharey=True)
    for axis, (title, episodes) in zip(
        axes[0], {"inputs as in the data": held_out[40:], "in closed loop": loop}.items(), strict=True
    ):
        share = []
        for episode in episodes:
            for k in range(0, 28, 9):
                off = episode.X[k + 1 : k + 13] - model.rollout(episode.X[k], episode.U[k : k + 12])[1:]
                inside = (np.abs(off) <= band.width).all()
                share.append(inside)
                axis.plot(
                    time, off[:, 0], linewidth=0.5, color="#0072b2" if inside else "#d55e00", zorder=2 + (not inside)
                )
        axis.fill_between(time, -band.width[:, 0], band.width[:, 0], color="#000000", alpha=0.12)
        axis.set(title=f"{title}: {np.mean(share):.0%} inside", xlabel="time ahead [s]")
    axes[0][0].set(ylabel="error of theta [rad]")
    return made


def guarantees() -> Any:
    """The certified region of two tanks, its data, and loops that start on its edge."""
    plant, model, data, limits, x, u = _tanks()
    certified = km.certify(model, data, limits, x=x, u=u)
    edge = certified.sample(4000)
    edge = edge[np.argsort(certified.value(edge))[-200:]][:: 200 // 8]
    runs = [km.simulate(plant, certified.controller(), x0=x0, reference=x, steps=60) for x0 in edge]
    return km.plot.certificate(certified, data, runs)


def coverage() -> Any:
    """Runs on true plants that kept their limits, and what the margin costs, a point for each stored plant."""
    rows = json.loads((DOCS.parent / "tests" / "guarantees" / "coverage" / "table.json").read_text()).values()
    made, axes = make_figure(1, 2, width="two columns", height=2.6)
    kept, price = axes[0]
    for i, (holds, label) in enumerate(((True, "with a promise"), (False, "without one"))):
        shares = sorted(row["kept"] / row["runs"] for row in rows if row["holds"] is holds)
        before = i * sum(row["holds"] for row in rows)
        kept.plot(before + np.arange(len(shares)), shares, ".", color=line_style(i)["color"], label=label)
        touched = sorted(row["over_plain"] for row in rows if row["touches"] is holds)
        start = i * sum(row["touches"] for row in rows)
        words = "optimum at a limit" if holds else "elsewhere"
        price.plot(start + np.arange(len(touched)), touched, ".", color=line_style(i + 2)["color"], label=words)
    kept.axhline(0.95, **REFERENCE, label="promised")
    kept.set(xlabel="plants", ylabel="share of runs that keep limits", ylim=(-0.05, 1.05))
    price.axhline(1.1, **LIMIT, label="1.10")
    price.set(xlabel="plants", ylabel="cost with margin over without")
    draw_legend(made, [kept, price], 3)
    return made


def failure_rate() -> Any:
    """The exact bound of the failure rate over the number of runs, for few failures."""
    made, axes = make_figure(1, 1, width="one column", height=2.8)
    panel, runs = axes[0, 0], np.unique(np.geomspace(10, 3000, 120).astype(int))
    for failures in range(4):
        bounds = [km.validate.bound_failure_rate(failures, int(n)) for n in runs]
        panel.plot(runs, bounds, label=f"{failures} failure{'s' * (failures != 1)}", **line_style(failures))
    panel.plot(59, km.validate.bound_failure_rate(0, 59), "o", color="black", markersize=4, label="59 runs, 5 %")
    panel.set(xscale="log", yscale="log", xlabel="runs", ylabel="failure rate, at most")
    draw_legend(made, [panel], 2)
    return made


def step_iterations() -> Any:
    """Iterations of cold steps over the states of a double integrator, beside their proved bound."""
    import scipy.signal

    cart = scipy.signal.dlti([[1.0, 0.3], [0.0, 1.0]], [[0.0], [0.3]], np.eye(2), np.zeros((2, 1)), dt=0.3)
    model, limits = km.LinearPredictor.from_state_space(cart), km.Limits(u_min=-1, u_max=1, x_max=[2.0, 0.6])
    mpc = km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), limits, 3, settings={"cold_start": True})
    bound = km.guarantees.bound_iterations(mpc, (-3, 3), (0, 0))
    line = np.linspace(-3, 3, 121)
    counts = np.array([[mpc([x, v], [0.0, 0.0]).iterations for x in line] for v in line])
    made, axes = make_figure(1, 1, width="one column", height=3.2)
    levels = np.arange(-0.5, bound.most + 1.5)
    drawn = axes[0, 0].contourf(line, line, counts, levels=levels, cmap="viridis")
    made.colorbar(drawn, ax=axes[0, 0], ticks=range(bound.most + 1), label=f"iterations, proved: at most {bound.most}")
    axes[0, 0].plot(*bound.x, "o", color="#d55e00", markersize=5)
    axes[0, 0].set(xlabel="position", ylabel="speed")
    return made


def terminal_sets() -> Any:
    """Plans of the page's cart that end in its polytope, beside the ellipsoid of the same feedback."""
    names: dict[str, Any] = {"__name__": "page"}
    source = re.findall(r"```python\n(.*?)```", (DOCS / "why/guarantees.md").read_text(), re.DOTALL)[1]
    names |= {"km": km, "np": np}
    exec(compile(source, "guarantees.md", "exec"), names)
    mpc, model, cost, box = (names[name] for name in ("mpc", "model", "cost", "box"))
    inner = km.guarantees.find_terminal_set(model, cost, km.Limits(**box), [0.0, 0.0], kind="ellipsoid")
    made, axes = make_figure(1, 1, width="one column", height=3.2)
    panel = axes[0][0]
    x, v = np.meshgrid(np.linspace(-1.2, 1.6, 561), np.linspace(-1.5, 0.8, 461))
    points = np.stack([x, v], axis=-1).reshape(-1, 2)
    for i, (found, label) in enumerate(((names["end"], "polytope"), (inner, "ellipsoid"))):
        color = line_style(i)["color"]
        gauge = found.measure(points).reshape(x.shape)
        panel.contour(x, v, gauge, levels=[1.0], colors=[color], linewidths=1.4)
        panel.contourf(x, v, gauge, levels=[0.0, 1.0], colors=[color], alpha=0.15)
        panel.plot([], [], color=color, label=label)
    for x0 in ([-1.0, 0.0], [1.0, 0.0], [-0.9, -0.4], [0.9, 0.4], [-0.6, 0.5], [0.6, -0.5]):
        mpc.reset()
        mpc(x0, [0.0, 0.0])
        X = mpc.plan().X
        panel.plot(*X.T, color="black", linewidth=0.9)
        panel.plot(*X[0], "o", color="black", markersize=3)
        panel.plot(*X[-1], "s", color="black", markersize=3.5)
    panel.axvline(1.0, **LIMIT)
    panel.axhline(0.5, **LIMIT, label="limits")
    panel.plot([], [], color="black", marker="s", markersize=3.5, linewidth=0.9, label="plans and their ends")
    panel.set(xlabel="position", ylabel="speed")
    draw_legend(made, [panel], 2)
    return made


def manual_automatic() -> Any:
    """The run of the page on manual and automatic control."""
    return _run_of("how/manual_automatic.md")


def from_pid() -> Any:
    """The loops of the page on the way from a PID, on its twin."""
    names: dict[str, Any] = {"__name__": "page"}
    with TemporaryDirectory() as folder, chdir(folder):
        for source in re.findall(r"```python\n(.*?)```", (DOCS / "how/from_pid.md").read_text(), re.DOTALL)[:-1]:
            exec(compile(source, "from_pid.md", "exec"), names)
    return km.plot.runs({"two tanks": names["runs"]})


def measured_disturbances() -> Any:
    """The run of the page on measured disturbances."""
    return _run_of("how/measured_disturbances.md")


def prices() -> Any:
    """The run of the page on prices."""
    return _run_of("how/prices.md")


def stage_cost() -> Any:
    """The run of the page on a stage cost of one's own."""
    return _run_of("how/stage_cost.md")


def limits_in_time() -> Any:
    """The run of the page on limits in time."""
    return _run_of("how/limits_in_time.md")


def on_off() -> Any:
    """The run of the page on inputs with levels."""
    return _run_of("how/on_off.md")


def cart_pole() -> Any:
    """The cart-pole recovers from 0.5 rad, and stands in the wind, as `koopmpc run cart_pole` runs it."""
    prepared = Prepared(km.load_problem("cart_pole"))
    tasks = {}
    for case in ("recover", "wind"):
        x0 = tuple(prepared.problem.cases[case].x0)
        rows = [RunRow("cart_pole", case, name, x0=x0) for name in ("koopman-mpc", "bilinear-offset", "nonlinear-mpc")]
        tasks[f"cart_pole:{case}"] = {row.controller: run_closed_loop(prepared, row, plans=False) for row in rows}
    return km.plot.runs(tasks)


def swing_up(path: Path) -> None:
    """Write the animation of the front page: a cart-pole swings up under a model of random pushes."""
    prepared = Prepared(km.load_problem("cart_pole_swing"))
    x0 = tuple(prepared.problem.cases["hang"].x0)
    run = run_closed_loop(prepared, RunRow("cart_pole_swing", "hang", "bilinear-mpc", x0=x0), plans=True)
    with TemporaryDirectory() as folder:
        log = Path(folder) / "run.rrd"
        km.record(run, log)
        export_video(log, path, width=640, fps=16, until=4.0, speed=0.8)


def periodic() -> Any:
    """The run of the page on periodic disturbances."""
    return _run_of("how/periodic.md")


def priorities() -> Any:
    """Both runs of the page on priorities of soft limits."""
    names: dict[str, Any] = {"__name__": "page"}
    text = (DOCS / "how/priorities.md").read_text()
    exec(compile(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0], "page", "exec"), names)
    return km.plot.runs({"two_tanks": names["runs"]})


def unequal_rates() -> Any:
    """A log with a slow sensor, and the forecast of the model that was fitted to it."""
    names: dict[str, Any] = {"__name__": "page"}
    text = (DOCS / "how/unequal_rates.md").read_text()
    exec(compile(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0], "page", "exec"), names)
    logs, model, data = names["logs"], names["model"], names["data"]
    ahead = model.rollout(logs[0].X[0], logs[0].U)
    made, axes = make_figure(1, 2, width="two columns", height=2.4)
    time = logs.dt * np.arange(len(ahead))
    for i, axis in enumerate(axes[0]):
        axis.plot(time, data.X[0][:, i], "o", markersize=2.5, color="#0072b2", label="measured")
        axis.plot(time, ahead[:, i], **line_style(1), label="forecast from row 0")
        axis.set(xlabel="time [s]", ylabel=logs.states[i])
    draw_legend(made, axes[0], 2)
    return made


def own_blocks() -> Any:
    """The run of the page on blocks of held inputs."""
    return _run_of("how/own_blocks.md")


def speed() -> Any:
    """Time of a step and memory over the horizon, of several methods, as measured."""
    found = json.loads((DOCS.parent / "tests/speed/figures/growth.json").read_text())
    drawing, axes = make_figure(1, 2, width="two columns", height=2.6)
    for i, (method, rows) in enumerate(found.items()):
        horizons = [int(N) for N in rows]
        axes[0, 0].loglog(horizons, [1e3 * row["next"] for row in rows.values()], **line_style(i), label=method)
        axes[0, 1].loglog(horizons, [row["MB"] for row in rows.values()], **line_style(i))
    axes[0, 0].axhline(10, **LIMIT, label="asked at N 500")
    for axis, label in zip(axes[0], ("CPU time of a step [ms]", "memory [MB]"), strict=True):
        axis.set(xlabel="horizon N", ylabel=label)
    draw_legend(drawing, axes[0, :1], 3)
    return drawing


def calibration() -> Any:
    """What designs promise and what happens on their plants: costs over the median of fresh loops, by task and seed."""
    table = json.loads((DOCS.parent / "tests" / "closed_loop" / "calibration.json").read_text())
    made, axes = make_figure(1, 1, width="two columns", height=3.4)
    axis, most = axes[0, 0], 100.0
    for place, key in enumerate(sorted(table)):
        row = table[key]
        low, high, costs = (np.array(row[name]) / row["median"] for name in ("low", "high", "cost"))
        axis.fill_between([place - 0.35, place + 0.35], low, min(high, most), color="#56b4e9", alpha=0.5, linewidth=0)
        shown = np.clip(np.where(np.isfinite(costs), costs, most), 1 / most, most)
        inside = (costs >= low) & (costs <= high)
        across = place + np.linspace(-0.25, 0.25, len(costs))
        axis.plot(across[inside], shown[inside], ".", markersize=3, color="#000000")
        axis.plot(across[~inside], shown[~inside], ".", markersize=4, color="#d55e00")
    axis.set(yscale="log", ylim=(1 / most, most), ylabel="cost over the median promised", xlim=(-0.6, len(table) - 0.4))
    axis.set_xticks(range(len(table)), sorted(table), rotation=90, fontsize=5)
    return made


def _run_page(page: str) -> dict[str, Any]:
    """Run all blocks of a page in a folder of its own, and return the names that they leave."""
    names: dict[str, Any] = {"__name__": "page"}
    with TemporaryDirectory() as folder, chdir(folder):
        for source in re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL):
            exec(compile(source, page, "exec"), names)
    return names


def _run_of(page: str) -> Any:
    """Return a picture of the run that the first block of a page makes."""
    names: dict[str, Any] = {"__name__": "page"}
    exec(compile(re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)[0], page, "exec"), names)
    return km.plot.run(names["run"], width="two columns")


def _tanks() -> tuple[Any, ...]:
    """Return the page's tanks: plant, model, fresh pairs, limits and set point."""
    names: dict[str, Any] = {"__name__": "page"}
    source = re.findall(r"```python\n(.*?)```", (DOCS / "why/guarantees.md").read_text(), re.DOTALL)[0]
    exec(compile(source.partition("certified =")[0], "guarantees.md", "exec"), names)
    return tuple(names[name] for name in ("plant", "model", "data", "limits", "x", "u"))


PICTURES: dict[str, Callable[[], Any]] = {
    made.__name__: styled(made)
    for made in (
        start,
        house,
        moments,
        riccati_first,
        terminal_cost,
        one_step_errors,
        choosing_by_closed_loop,
        what_trust_means,
        guarantees,
        coverage,
        failure_rate,
        step_iterations,
        terminal_sets,
        limits_in_time,
        prices,
        stage_cost,
        measured_disturbances,
        on_off,
        own_blocks,
        speed,
        unequal_rates,
        priorities,
        periodic,
        manual_automatic,
        from_pid,
        calibration,
        cart_pole,
    )
}
ANIMATIONS: dict[str, Callable[[Path], None]] = {"swing_up": swing_up}


def write(names: Iterable[str]) -> None:
    """Write the pictures and animations with these names, and say that they are new."""
    for name in names:
        if name in ANIMATIONS:
            file = f"pictures/{name}.gif"
            ANIMATIONS[name](DOCS / file)
        else:
            file = f"pictures/{name}.png"
            PICTURES[name]().savefig(DOCS / file, dpi=130, metadata={"Software": None})
        stamp([file])


if __name__ == "__main__":
    write(sys.argv[1:] or [*PICTURES, *ANIMATIONS])
