"""The part of the report with the figures of DMDc in the appendix of Snyder & Song (2021)."""

import numpy as np

from koopmpc.bench.reproduce import snyder_words as words
from koopmpc.bench.reproduce.page import Page, percent
from koopmpc.bench.reproduce.plants import Pendulum, inputs_of, trajectories
from koopmpc.bench.reproduce.reconstruction import relative, unwarned
from koopmpc.bench.reproduce.scenes import Scene
from koopmpc.bench.reproduce.snyder_scenes import gains
from koopmpc.bench.reproduce.snyder_text import draw
from koopmpc.data.collect import collect
from koopmpc.data.excitation import Noise
from koopmpc.identify.dmd import dmd, dmdc
from koopmpc.plant.integrators import RK4
from koopmpc.plant.step_map import discretize


def appendix_dmdc(page: Page, free: Scene, driven: Scene) -> None:
    """Add DMDc of the pendulum, where the input is the feedback's and where it excites."""
    K = gains()["pendulum"]
    plant = discretize(Pendulum(), driven.dt, RK4(8))
    held = trajectories(driven.dynamics, driven.x0, dt=driven.dt, steps=driven.steps, K=K, held=True)
    fed = inputs_of(held, plant.inputs, K)
    rich = collect(plant, driven.x0, Noise(-1.0, 1.0, hold=20), episodes=1, steps=driven.steps)
    other = collect(plant, driven.x0, Noise(-1.0, 1.0, hold=20), episodes=1, steps=driven.steps, rng=1)
    B = plant.linearize([0.0, 0.0], [0.0]).B
    page.text("### Appendix: DMDc of the pendulum", words.DMDC)
    with unwarned():
        models = {
            "DMD, uncontrolled": (dmd(free.trajectory), free.trajectory),
            "DMDc, LQR data": (dmdc(fed), fed),
            "DMDc, LQR data, B known": (dmdc(fed, B=B), fed),
            "DMDc, exciting input": (dmdc(rich), rich),
        }
    rows: list[tuple[object, ...]] = []
    curves: dict[str, np.ndarray] = {}
    for name, (model, data) in models.items():
        episode, report = data[0], model.report
        assert report is not None
        curves[name] = model.rollout(episode.X[0], episode.U[:, : model.nu])
        elsewhere = model.rollout(other[0].X[0], other[0].U) if model.nu else None
        rows.append(
            (
                name,
                f"{report.rank} of {report.columns}",
                percent(relative(curves[name], episode.X)),
                "–" if elsewhere is None else percent(relative(elsewhere, other[0].X)),
                "–" if not model.nu else f"{float(model.B[1, 0] / B[1, 0]):.4g}",
            )
        )
    page.table(
        ("model and data", "rank of [X; U]", "error [%]", "under another input [%]", "B, of the true one"),
        rows,
    )
    cases = {
        "LQR data": (held[0].X, {n: curves[n] for n in ("DMDc, LQR data", "DMDc, LQR data, B known")}),
        "Exciting input": (rich[0].X, {"DMDc, exciting input": curves["DMDc, exciting input"]}),
    }
    draw(page, "appendix-pendulum-dmdc", "Pendulum: DMDc (appendix)", cases, driven)
