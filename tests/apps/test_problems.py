"""The library of problems: each file is self-contained, and each of its controllers runs within hard limits."""

import ast
import json
import re
import sys
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from tests import tiers
from tests.commands import koopmpc

sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "tools"))
from standings import (
    PATH,
    Standing,
    compute_standings,
    find_best_learned,
    find_frugal,
    format_goals,
    format_standings,
)

STANDINGS = {
    problem: {name: Standing(*values) for name, values in each.items()}
    for problem, each in json.loads(PATH.read_text("utf-8")).items()
}
FILES = {path.stem: path for path in km.bench.shipped()}
SMALL = ("bilinear_motor", "cart_pole", "duffing", "heat_pump", "pendulum", "pendulum_swing", "van_der_pol")
USUAL = tuple(name for name, entry in km.bench.CONTROLLERS.items() if not entry.on_request)
MOST_LINES = 120
STEPS = 4


@pytest.fixture(params=sorted(FILES))
def path(request: pytest.FixtureRequest) -> Path:
    return FILES[request.param]


@cache
def few(path: Path) -> km.bench.Prepared:
    """Return the parts of the problem in this file, with little data to learn from."""
    problem = km.load_problem(path)
    training = problem.training
    x0 = training.x0 if isinstance(training.x0, km.Uniform) else np.asarray(training.x0)[:40]
    return km.bench.Prepared(
        replace(problem, training=replace(training, x0=x0, episodes=40, steps=min(training.steps, 25)))
    )


def test_the_library_holds_what_its_page_lists():
    assert set(STANDINGS) <= set(FILES)
    named = Path(__file__).parents[2].joinpath("docs", "library.md").read_text("utf-8")
    assert [name for name in FILES if f"`{name}`" not in named] == []
    assert format_standings(STANDINGS) in named
    assert format_goals(STANDINGS) in named
    pages = Path(__file__).parents[2] / "docs" / "problems"
    for name, path in FILES.items():
        text = (pages / f"{name}.md").read_text("utf-8")
        lines = len(path.read_text("utf-8").splitlines())
        assert f"`problems/{path.name}`, {lines} lines" in text, f"{name}: run docs/tools/gallery.py --pages"
        assert f'--8<-- "problems/{path.name}"' in text  # which the site replaces by the file
        for picture in ("run.png", "run.gif"):
            assert f"({name}/{picture})" in text
            assert (pages / name / picture).stat().st_size <= 200_000


def test_on_a_dozen_problems_a_learned_controller_is_as_good_as_nonlinear_mpc_and_much_faster():
    assert sum(find_frugal(found) is not None for found in STANDINGS.values() if "nonlinear-mpc" in found) >= 12


def test_a_problem_is_one_short_file_that_imports_numpy_casadi_and_koopmpc_alone(path: Path):
    text = path.read_text("utf-8")
    assert len(text.splitlines()) <= MOST_LINES
    found = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {
        name
        for node in found
        for name in ([node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names])
    }
    assert {str(name).split(".")[0] for name in names} <= {"casadi", "dataclasses", "koopmpc", "numpy"}


@pytest.mark.parametrize("path", tiers.few(sorted(FILES), *SMALL), indirect=True)
@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_each_controller_runs_on_each_problem_and_keeps_its_hard_limits(path: Path, every: bool):
    """Every one on every problem, or each on a third of the problems."""
    parts = few(path)
    problem = parts.problem
    large = problem.dynamics.nx > 20
    first = next(iter(problem.cases))
    for name, case in problem.cases.items():
        if large and not every and name != first:
            continue
        limits = problem.limits_of(name)
        low, high = limits.inputs(problem.dynamics.nu)
        reference, W = np.asarray(case.reference), problem.measured_of(name)
        all_of_them = ("lqr", "linear-mpc") if large else (problem.controllers or USUAL)
        if not every and not large:
            all_of_them = [each for i, each in enumerate(all_of_them) if (i + sorted(FILES).index(path.stem)) % 3 == 0]
        for controller in all_of_them if name == first else ("lqr",) if large else ("koopman-mpc",):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", km.FitWarning)  # of models that were fitted to less than they need
                built = km.bench.CONTROLLERS[controller].build(parts, limits)
            run = km.simulate(
                parts.truth_of(name),
                built,
                x0=case.x0,
                reference=reference[: STEPS + 1] if reference.ndim == 2 else reference,
                steps=STEPS,
                cost=problem.cost,
                limits=limits,
                options=km.loop.LoopOptions(noise=case.noise, faults=case.faults),
                measured=None if W is None else W[:STEPS],
            )
            assert np.isfinite(run.U).all(), (name, controller)
            assert np.array_equal(np.clip(run.U, low, high), run.U), (name, controller)
            assert np.isfinite(km.metrics(run).cost), (name, controller)


@pytest.mark.parametrize("path", tiers.few(sorted(FILES), *(name for name in FILES if name != "kdv")), indirect=True)
def test_each_problem_draws_the_same_shapes_wherever_it_is(path: Path):
    problem = few(path).problem
    scene = problem.scene or problem.dynamics.scene
    rng = np.random.default_rng(0)
    low, high = problem.limits.inputs(problem.dynamics.nu)
    drawn = []
    for case in problem.cases.values():
        for spread in (0.0, 0.3):
            shapes = scene(
                np.asarray(case.x0) + spread * rng.standard_normal(problem.dynamics.nx), rng.uniform(low, high)
            )
            drawn.append([shape.name for shape in shapes])
            assert all(isinstance(shape, km.scene.Line | km.scene.Box | km.scene.Disk) for shape in shapes)
    assert len(drawn[0]) > 1
    assert not any(sign.isspace() for name in drawn[0] for sign in name)  # the viewer would warn of it
    assert all(names == drawn[0] for names in drawn)


def test_each_problem_says_where_it_is_from_and_rests_where_it_says(path: Path):
    parts = few(path)
    problem = parts.problem
    assert problem.title.count(":") == 1
    x, *driving = (np.asarray(part) for part in problem.equilibrium)
    x_next = parts.step_map(x, *driving)
    np.testing.assert_allclose(x_next, x, atol=1e-3 * (1 + np.abs(x).max()))


def test_a_case_has_noise_and_broken_parts_of_its_own(tmp_path: Path):
    problem = km.load_problem("pendulum:upright")
    case = replace(problem.cases["upright"], steps=6)
    broken = replace(case, noise=[0.1, 0.1], faults=[km.faults.ActuatorDelay(1)])
    problem = replace(problem, cases={"plain": case, "broken": broken}, scene=lambda x, u: [])
    km.sweep([problem], ["lqr"], folder=tmp_path)
    plain, run = (km.load_run(tmp_path / f"pendulum-{name}-lqr.rrd") for name in ("plain", "broken"))
    np.testing.assert_array_equal(plain.Y, plain.X)
    assert (run.Y != run.X).all()
    np.testing.assert_allclose(
        run.X[1], km.bench.Prepared(problem).step_map(run.X[0], [0.0])
    )  # nothing has come through yet


def test_a_problem_with_measured_disturbances_is_learned_told_recorded_and_replayed(tmp_path: Path):
    problem = km.load_problem("heat_pump:front")
    case = problem.cases["front"]
    forecast = replace(case, steps=20, measured=np.repeat([[2.0], [-8.0]], 10, axis=0))
    cases = {"front": forecast, "still": replace(case, steps=20, measured=[2.0])}
    parts = km.bench.Prepared(replace(problem, training=replace(problem.training, episodes=8), cases=cases))
    assert parts.model.nw == parts.bilinear.nw == parts.local_model.nw == 1
    assert parts.bilinear.is_scheduled
    rows = km.sweep([parts.problem], ["linear-mpc"], folder=tmp_path)
    runs = {row.case: km.load_run(row.log) for row in rows}
    assert np.array_equal(runs["front"].metadata["measured"], forecast.measured)
    assert runs["front"].U[8] > runs["still"].U[8] + 0.01  # the cold is known before it comes
    mpc = parts.controller("linear-mpc", "front")
    again = km.bench.replay_log(rows[0].log, plant=parts.step_map, controller=mpc)
    assert again.differences == ()


def test_a_design_that_was_written_before_is_read_for_its_limits_and_no_other(tmp_path: Path):
    problem = km.load_problem("pendulum")
    case = next(iter(problem.cases))
    limits = problem.limits_of(case)
    local = km.LinearPredictor.local(km.discretize(problem.dynamics, problem.dt), *problem.equilibrium)
    km.LQR(local, problem.cost).save(tmp_path / f"pendulum-0-{case}.npz")
    kept = km.bench.Prepared(problem, kept=tmp_path).load_design(limits)
    assert isinstance(kept, km.LQR)
    assert km.bench.Prepared(problem, seed=1, kept=tmp_path).load_design(limits) is None
    assert km.bench.Prepared(problem, kept=tmp_path).load_design(km.Limits(u_max=1e-3)) is None


def test_inputs_that_hold_a_reference_are_those_under_the_weather_of_each_step():
    problem = km.load_problem("heat_pump:cold")
    problem = replace(problem, cost=replace(problem.cost, u_target="equilibrium"))
    weather = np.repeat([[-5.0], [10.0]], 3, axis=0)
    case = replace(problem.cases["cold"], steps=6, measured=weather)
    parts = km.bench.Prepared(replace(problem, cases={"cold": case}))
    held = parts.u_reference("cold")
    for u, w in zip(held, weather, strict=True):
        x = [21.0, 21.0 + 0.25 * (21.0 - w[0])]  # the floor warms the room as much as the walls lose
        np.testing.assert_allclose(parts.step_map(x, u, w), x, atol=1e-6)
    assert held[0, 0] > 2 * held[-1, 0]


def _row(problem: km.Problem, case: str, controller: str, cost: float, share: float = 0.0) -> km.bench.RunRow:
    figures = dict.fromkeys(("tracking_rmse", "final_error"), np.zeros(2))
    numbers = dict.fromkeys(("input_violation", "effort", "settling_time", "solve_time_p99", "solve_time_max"), 0.0)
    time = 1e-3 if controller == "nonlinear-mpc" else 1e-5
    measured = km.loop.Metrics(
        **figures,
        **numbers,
        cost=cost,
        violation=share,
        violation_share=share,
        solve_time_p50=time,
        late=0,
        status={},
        fallback={},
    )
    return km.bench.RunRow(problem.name, case, controller, measured)


def test_a_standing_is_the_worst_ratio_over_the_cases_in_which_the_model_is_the_plant():
    problem = km.load_problem("van_der_pol")
    plain = ("rest", "reach", "track", "beyond")
    rows = [_row(problem, case, "nonlinear-mpc", 2.0) for case in problem.cases]
    rows += [
        _row(problem, case, "koopman-mpc", {"reach": 2.4}.get(case, 2.1) if case in plain else 900.0)
        for case in problem.cases
    ]
    rows += [_row(problem, case, "lqr", 1.0, share=0.3) for case in problem.cases]
    rows += [km.bench.RunRow(problem.name, case, "bilinear-mpc") for case in problem.cases]
    found = compute_standings(rows, [problem])["van_der_pol"]
    koopman = found["koopman-mpc"]
    assert (koopman.ratio, koopman.over, koopman.time) == (pytest.approx(1.2), False, pytest.approx(0.01))
    assert (str(found["lqr"]), str(found["bilinear-mpc"])) == ("0.5†", "lost")
    assert find_best_learned(found) == "koopman-mpc"
    assert "| `van_der_pol` | **1.2** | 0.5† | lost |" in format_standings({"van_der_pol": found})


def test_each_problem_of_the_list_has_its_number(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    listed, name = {}, ""
    for line in koopmpc("list").stdout.splitlines():
        name = line.split("  ")[0] if line.split("  ")[0] in FILES else name
        if (told := re.search(r"× the cost of (\S+),", line)) is not None:
            listed[name] = told[1]
    for name, found in STANDINGS.items():
        if find_best_learned(found) is not None:
            assert listed[name] == ("nonlinear-mpc" if "nonlinear-mpc" in found else "linear-mpc")


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(STANDINGS))
def test_what_is_said_of_the_best_learned_controller_is_what_a_run_gives(name: str, tmp_path: Path):
    problem, said = km.load_problem(FILES[name]), STANDINGS[name]
    best, baseline = find_best_learned(said), "nonlinear-mpc" if "nonlinear-mpc" in said else "linear-mpc"
    assert best is not None
    rows = km.sweep([replace(problem, scene=lambda x, u: [])], [best, baseline], folder=tmp_path)
    assert [row.failure for row in rows if row.failure] == []
    assert compute_standings(rows, [problem])[name][best].ratio == pytest.approx(said[best].ratio, rel=0.05)


@pytest.mark.parametrize(("name", "label"), [("cstr", "time [h]"), ("pendulum", "time [s]")])
def test_pictures_of_runs_label_time_in_the_unit_of_their_problem(name, label, tmp_path):
    problem = few(FILES[name]).problem
    case, one = next(iter(problem.cases.items()))
    (row,) = km.sweep([replace(problem, cases={case: replace(one, steps=STEPS)})], ["lqr"], folder=tmp_path)
    run = km.load_run(row.log)
    pictures = km.plot.run(run), km.plot.runs({case: {"lqr": run}})
    assert [picture.axes[-1].get_xlabel() for picture in pictures] == [label] * 2
