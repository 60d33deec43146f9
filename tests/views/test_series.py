"""Forecasts beside the truth, errors by horizon, and closed loops: what is drawn is what was computed."""

from itertools import pairwise

import numpy as np
import pytest

import koopmpc as km
from tests.views.models import DT, INPUTS, STATES, curve, episodes, turning
from tests.views.runs import make_run


def _filled(axes):
    """Return the lower and the upper edge of the band by x."""
    (path,) = axes.collections[0].get_paths()
    n = (len(path.vertices) - 3) // 2
    return path.vertices[1 : n + 1], path.vertices[n + 2 : -1][::-1]


def test_a_perfect_model_predicts_the_truth_and_inputs_are_steps() -> None:
    episode = episodes(1)[0]
    made = km.plot.rollout(turning(), episode, 20, start=5)
    for i, axes in enumerate(made.axes[:2]):
        t, truth = curve(axes, "truth")
        assert t == pytest.approx(np.arange(21) * DT)
        assert np.array_equal(truth, episode.X[5:26, i])
        assert curve(axes, "prediction")[1] == pytest.approx(truth)
    values, edges, _ = made.axes[2].patches[0].get_data()
    assert np.array_equal(values, episode.U[5:25, 0])
    assert edges == pytest.approx(np.arange(21) * DT)
    assert [axes.get_ylabel() for axes in made.axes] == [*STATES, *INPUTS]
    assert made.axes[-1].get_xlabel() == "time ahead [s]"


def test_bands_lie_around_the_prediction() -> None:
    data, model = episodes(16, noise=0.05), turning(0.9)
    held = km.validate.conformal(model, data, 10)
    scores = km.score(model, data, 10)
    width = np.linspace(0.1, 1, 20).reshape(10, 2)
    for bands, low, high in (
        (held, -held.width, held.width),
        (scores, scores.low, scores.high),
        (width, -width, width),
    ):
        axes = km.plot.rollout(model, data[0], 10, bands).axes[1]
        predicted = curve(axes, "prediction")[1]
        lower, upper = _filled(axes)
        assert lower[1:, 1] == pytest.approx(predicted[1:] + low[:, 1])
        assert upper[1:, 1] == pytest.approx(predicted[1:] + high[:, 1])
        assert lower[0, 1] == upper[0, 1] == predicted[0]


def test_an_infinite_band_is_said_not_drawn() -> None:
    data = episodes(4, noise=0.05)
    made = km.plot.rollout(turning(), data[0], 10, km.validate.conformal(turning(), data, 10))
    assert any("infinite: calibrate on 9 episodes" in t.get_text() for t in made.legends[0].get_texts())


def test_a_prediction_that_runs_away_leaves_the_picture_and_not_the_truth(tmp_path) -> None:
    episode = episodes(1)[0]
    made = km.plot.rollout(turning(1e12), episode, 30)
    low, high = made.axes[0].get_ylim()
    assert low < episode.X[:, 0].min() < episode.X[:, 0].max() < high
    assert high - low < 4 * np.ptp(episode.X[:, 0])
    assert np.isnan(km.validate.forecast(turning(1e12), episode, 30).predicted).any()
    km.plot.save(made, tmp_path / "a.png")


def test_relifted_forecasts_and_parts_of_the_state() -> None:
    episode, model = episodes(1)[0], turning(0.9)
    ahead = km.validate.forecast(model, episode, relift=True)
    assert ahead.predicted == pytest.approx(km.validate.forecast(model, episode).predicted)  # ψ(x) = x
    made = km.plot.rollout(model, episode, states="rate", width="two columns")
    assert [axes.get_ylabel() for axes in made.axes] == [STATES[1], *INPUTS]


def test_the_plotted_error_is_the_score() -> None:
    data = episodes(noise=0.05)
    scores = {"good": km.score(turning(), data, 12), "bad": km.score(turning(0.8), data, 9)}
    made = km.plot.error(scores)
    for i, axes in enumerate(made.axes):
        for name, one in scores.items():
            ahead, rmse = curve(axes, f"{name} RMSE")
            assert np.array_equal(ahead, np.arange(1, one.horizon + 1))
            assert np.array_equal(rmse, one.rmse[:, i])
        assert axes.get_ylabel() == f"error of\n{STATES[i]}"
        lower, upper = _filled(axes)
        assert lower[:, 1] == pytest.approx(scores["good"].low[:, i])
        assert upper[:, 1] == pytest.approx(scores["good"].high[:, i])
    assert made.axes[-1].get_xlabel() == "steps ahead"
    assert [t.get_text() for t in km.plot.error(scores["bad"]).legends[0].get_texts()] == ["5 to 95 %", "RMSE"]


def test_a_run_is_drawn_whole(tmp_path) -> None:
    run = make_run(nx=3, nu=2, T=25)
    made = km.plot.run(run)
    for i in range(3):
        assert np.array_equal(curve(made.axes[i], "state")[1], run.X[:, i])
        assert np.array_equal(curve(made.axes[i], "reference")[1], run.reference[:, i])
    for j in range(2):
        assert np.array_equal(made.axes[3 + j].patches[0].get_data()[0], run.U[:, j])
        assert curve(made.axes[3 + j], "limit")[1][0] == run.limits.inputs(2).high[j]
    assert [axes.get_ylabel() for axes in made.axes] == [*run.states, *run.inputs, ""]
    shown = [label.get_text() for label in made.axes[-1].get_yticklabels()]
    assert {name.upper().replace(" ", "_") for name in shown} == {status.name for status in run.status}
    assert sum(len(one.get_xdata()) for one in made.axes[-1].get_lines()) == run.steps
    km.plot.save(made, tmp_path / "run.svg")
    km.plot.save(km.plot.run(make_run(T=3, cost=False, limits=False)), tmp_path / "bare.png")


def test_a_model_with_a_memory_forecasts_from_the_first_known_past() -> None:
    data = km.Episodes([km.Episode(X=e.X[:, :1], U=e.U) for e in episodes(20)], DT, STATES[:1], INPUTS)
    model = km.edmd(data, km.State(), embedding=km.Delay(1))  # two angles and an input tell the rate
    for relift in (False, True):
        made = km.plot.rollout(model, data[0], 20, start=3, relift=relift)
        assert curve(made.axes[0], "truth")[1] == pytest.approx(data[0].X[4:25, 0])
        assert curve(made.axes[0], "prediction")[1] == pytest.approx(data[0].X[4:25, 0], abs=1e-6)
    axes = km.plot.eigenfunction_maps(model, 0, ("angle", 2), data, points=5).axes[0]
    assert axes.get_ylabel() == "angle[k-1] [rad]"


def test_a_bad_model_does_not_hide_the_good_one() -> None:
    data = episodes(noise=0.05)
    good = km.score(turning(), data, 10)
    for bad in (turning(3.0), turning(1e200)):
        for axes, rmse in zip(
            km.plot.error({"good": good, "bad": km.score(bad, data, 10)}).axes, good.rmse.T, strict=True
        ):
            assert rmse.max() < axes.get_ylim()[1] < 100 * rmse.max()


def find_hidden(drawing):
    """Return what is drawn outside its panel: curves, inputs, and limits that are near."""
    hidden = []
    for axes in drawing.axes:
        (left, right), (low, high) = sorted(axes.get_xlim()), sorted(axes.get_ylim())
        if not axes.get_visible() or axes.get_yscale() == "log":
            continue
        drawn = [(line.get_label(), line.get_xdata(), line.get_ydata()) for line in axes.get_lines()]
        drawn += [
            ("steps", each.get_data()[1], each.get_data()[0]) for each in axes.patches if hasattr(each, "get_data")
        ]
        for name, x, y in drawn:
            x, y = (np.asarray(each, dtype=float) for each in (x, y))
            far = name == "limit" and not 2 * low - high < y[0] < 2 * high - low
            if not far and not ((left <= x) & (x <= right)).all() | (name == "limit"):
                hidden.append((axes.get_ylabel(), name, "x"))
            if not far and not ((low <= y) & (y <= high)).all():
                hidden.append((axes.get_ylabel(), name, "y"))
    return hidden


def test_what_is_drawn_is_inside_its_panel() -> None:
    data, limits = episodes(4), km.Limits(-2.0, 2.5, x_min=[-1.0, -1.2], x_max=[1.0, 1.2])
    swing, grown = turning(0.99), turning(0.97)
    cost = km.Cost(Q=[1.0, 0.1], R=0.1)
    plant = km.black_box(lambda x, u: swing.A @ x + swing.B @ u, dt=DT, states=STATES, inputs=INPUTS)
    runs = {
        str(r): km.simulate(
            plant,
            km.KoopmanMPC(swing, cost, limits, 8),
            x0=[r, 0.8],
            reference=[0, 0],
            steps=30,
            cost=cost,
            limits=limits,
        )
        for r in (0.9, -0.8)
    }
    wide = [km.validate.forecast(grown, episode, 12) for episode in data]
    beyond = [each.predicted.min() < each.truth.min() for each in wide]
    beyond += [each.predicted.max() > each.truth.max() for each in wide]
    assert any(beyond)
    drawings = [km.plot.rollout(grown, episode, 12) for episode in data]
    drawings += [km.plot.error({"a": km.score(swing, data, 8), "b": km.score(grown, data, 8)})]
    drawings += [km.plot.run(runs["0.9"]), km.plot.runs({"": runs})]
    assert [find_hidden(drawing) for drawing in drawings] == [[]] * len(drawings)


def test_runs_show_the_reference_of_the_states_that_their_cost_tracks():
    plant = km.discretize(km.load_problem("two_tanks").dynamics, 4.0)
    cost = km.Cost(Q=1.0, R=0.1, of=km.State("lower"))
    loop = km.simulate(plant, lambda y, r: [3.0], x0=[5, 5], reference=[7.5], steps=4, cost=cost)
    upper, lower, _ = km.plot.runs({"": {"a": loop}}).axes
    drawn = [line.get_ydata() for line in lower.lines if line.get_label() == "reference"]
    np.testing.assert_array_equal(drawn, [np.full(5, 7.5)])
    assert not [line for line in upper.lines if line.get_label() == "reference"]


def test_long_names_of_signals_end_beside_their_panel_and_a_dollar_is_a_letter():
    names = ["temperature of the second heat exchanger, outlet [degC]", "cost_of_energy_$_per_hour_and_unit [$]"]
    X = np.random.default_rng(0).normal(size=(30, 2))
    model = km.LinearPredictor(
        np.eye(2), np.ones((2, 1)), np.eye(2), km.State(), 1.0, names, ["feed of the reactor [l/s]"]
    )
    episode = km.Episode(X=X, U=np.ones((29, 1)))
    drawing = km.plot.rollout(model, episode, 5)
    drawing.canvas.draw()
    for axes in drawing.axes:
        box, panel = axes.yaxis.label.get_window_extent(), axes.get_window_extent()
        assert box.height <= 1.12 * panel.height, axes.get_ylabel()


def test_names_beside_neighbouring_panels_of_a_run_do_not_touch():
    names = {"states": ["jacket temperature [degC]", "level of the lower tank [cm]"]}
    plant = km.black_box(lambda x, u: 0.9 * x + u, dt=0.1, inputs=["heater power [kW]", "pump voltage [V]"], **names)
    loop = km.simulate(plant, lambda y, r: [0.0, 0.1], x0=[1, 1], reference=[0, 0], steps=8)
    drawing = km.plot.run(loop)
    drawing.canvas.draw()
    boxes = [axes.yaxis.label.get_window_extent() for axes in drawing.axes[:4]]
    assert all(above.y0 > below.y1 for above, below in pairwise(boxes))
