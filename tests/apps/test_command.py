"""`koopmpc reproduce`: every paper reaches its required numbers, its page in docs/papers/ says so, and verdicts are printed."""

import re
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import koopmpc as km
from tests.commands import koopmpc

registry = km.papers
korda, control, settings = (
    registry.import_paper_module(name) for name in ("korda", "snyder.control", "snyder.settings")
)
PAGES = Path(__file__).parents[2] / "docs" / "papers"
QUICK = (
    "brunton",
    "proctor",
    "kic",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("williams", "korda", "dictionary", "kaiser", "kernel")),
)


@pytest.mark.slow
def test_the_shortened_paper_writes_all_its_files(tmp_path):
    told = []
    outcome = registry.find_paper("snyder").reproduce(tmp_path, True, told.append)
    text = outcome.report.read_text(encoding="utf-8")
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert len(pictures) == len(set(pictures)) >= 17
    for picture in pictures:
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")
    assert outcome.recording.stat().st_size > 1e6
    assert len(outcome.claims) == 25
    assert {claim.where.split(",")[0] for claim in outcome.claims} >= {"abstract", "results", "discussion"}
    assert text.count("\n## ") == 11
    assert len(told) == 5


def test_data_that_excite_find_B_and_feedback_data_do_not():
    each = control.predict_held_out(settings.all_settings()["pendulum-lqr"], settings.SHAKINGS["pendulum"], episodes=10)
    assert each["DMDc, exciting data"].b == pytest.approx(1.0, abs=0.02)
    assert each["EDMDc, exciting data"].b == pytest.approx(1.0, abs=0.02)
    assert each["DMDc, feedback data"].warned == "A and B inseparable"
    assert np.isnan(each["DMD, feedback data"].b)
    assert each["EDMDc, exciting data"].excited < each["DMD, feedback data"].excited / 2
    assert each["DMDc, feedback data"].b < 0


def test_energy_bounds_the_cost_of_the_hanging_pendulum_from_below():
    def value(x):  # V = 2√10 E solves min over u of 10 ω² + u² + ∇V·f(x, u) = 0
        return 2 * np.sqrt(10) * (2 * x[1] ** 2 + 19.62 * (1 - np.cos(x[0])))

    task = control.prepare_contest(
        "pendulum, hanging, π/4", 40, 20, episodes=20
    )  # horizon and tail see most of a swing
    task = replace(task, models={"Fourier 1": task.models["Fourier 1"]})
    runs = task.runs()
    free, limited = control.compute_costs(runs, False), control.compute_costs(runs, True)
    total = {name: free[name] + value(runs[name, False].X[-1]) for name in free}
    assert total["LQR, linearisation"] == pytest.approx(value(settings.TASKS[task.title].x0), rel=5e-3)
    assert total[control.ORACLE] == pytest.approx(value(settings.TASKS[task.title].x0), rel=5e-3)
    assert min(total.values()) > 0.995 * value(settings.TASKS[task.title].x0)
    assert limited["MPC, Fourier 1"] < 1.1 * limited[control.ORACLE]
    for (_, kind), run in runs.items():
        if kind:
            assert np.abs(run.U).max() <= 2.0 + 1e-9


def test_every_paper_is_found_by_its_name():
    assert [registry.find_paper(name).name for name in registry.PAPERS] == list(registry.PAPERS)


def test_an_unknown_paper_is_refused_and_the_nearest_is_suggested():
    with pytest.raises(km.errors.ProblemError, match=r"no paper 'snider', did you mean 'snyder'\?; there are snyder"):
        registry.find_paper("snider")
    result = koopmpc("reproduce", "nobody")
    assert result.exit_code == 2
    assert "there is no paper 'nobody'" in result.output


@pytest.mark.parametrize(("ours", "code"), [(3.14, 0), (3.15, 1)])
def test_the_command_prints_verdicts_and_paths_and_fails_where_a_required_number_is_missed(
    tmp_path, monkeypatch, ours, code
):
    def work(page, quick, progress):
        assert not quick
        progress("working")
        registry.draw_curves(page, "curve", "A curve", 0.1, ("x",), {"a": np.zeros((5, 1)), "b": np.ones((3, 1))})
        return [
            registry.Claim("abstract", "it works", registry.Verdict.FAILS, "half of it"),
            registry.compare_value("π", 3.14159, ours, 0.005),
        ]

    paper = registry.make_paper("mine", "Mine and yours.\n\nA paper\nof ours.\n", work)
    monkeypatch.setattr(registry, "PAPERS", ("mine",))
    module = ModuleType("mine")
    module.paper = paper
    monkeypatch.setattr(registry, "import_module", lambda name: module)
    result = koopmpc("reproduce", "mine", "--logs", tmp_path)
    assert result.exit_code == code, result.output
    for word in ("Mine and yours", "it works", "does not hold", "half of it", "mine.md", "mine.rrd", "done in"):
        assert word in result.output
    (page,) = tmp_path.glob("*/mine.md")
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# Mine and yours\n\nA paper of ours.\n\n`koopmpc reproduce mine`")
    assert f"Of 2 claims {1 - code} hold, 0 hold in part, {1 + code} do not hold" in text
    assert (page.parent / "mine" / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_all_papers_go_to_one_folder_with_a_table_of_them(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "PAPERS", ("proctor", "kic"))
    found = registry.reproduce_all(tmp_path, True, lambda words: None, workers=1)
    assert [each.paper for each in found] == ["proctor", "kic"]
    text = (tmp_path / "index.md").read_text(encoding="utf-8")
    for each in found:
        claims = len(each.outcome.claims)
        assert f"({each.paper}.md) | {claims} | {claims} | 0 | 0 |" in text
        assert (tmp_path / f"{each.paper}.rrd").is_file()
    assert registry.make_summary_table(found).row_count == 2
    result = koopmpc("reproduce")
    assert result.exit_code == 2
    assert "name one paper, or pass --all" in result.output
    assert koopmpc("reproduce", "proctor", "--all").exit_code == 2


def test_a_claim_holds_or_holds_in_part_or_fails_and_an_error_has_three_digits():
    assert registry.judge_claim("a", "b", holds=True, why="c").verdict is registry.Verdict.HOLDS
    assert registry.judge_claim("a", "b", holds=False, in_part=True, why="c").verdict is registry.Verdict.IN_PART
    assert registry.judge_claim("a", "b", holds=False, why="c").verdict is registry.Verdict.FAILS
    assert [registry.percent(v) for v in (0.0, 0.0111, 3.4e-6, np.inf, np.nan, 1e3)] == [
        "0", "1.11", "3.4e-04", "diverges", "diverges", "diverges",
    ]  # fmt: skip


@pytest.mark.parametrize("name", QUICK)
def test_a_paper_reproduces_its_required_numbers_and_writes_its_page(tmp_path, name):
    outcome = registry.find_paper(name).reproduce(tmp_path, True, lambda words: None)
    assert outcome.failures == ()
    assert any(claim.required for claim in outcome.claims)
    assert outcome.recording.stat().st_size > 1e3
    assert outcome.report.read_text(encoding="utf-8").count("| **holds** |") > 0


@pytest.mark.parametrize("name", [name for name in registry.PAPERS if name != "snyder"])
def test_the_page_in_docs_has_pictures_and_no_required_claim_that_fails(name):
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    assert text.startswith(f"# {registry.find_paper(name).title}\n")
    assert registry.Verdict.HOLDS.value in text
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert pictures
    for picture in pictures:
        assert (PAGES / picture).is_file()


def test_carleman_s_linearisation_is_exact_to_its_degree_near_rest():
    plant = km.discretize(km.load_problem("van_der_pol").dynamics, korda.DT)
    U, x0 = np.zeros((40, 1)), np.array([2e-2, -1e-2])
    truth = plant.rollout(x0, U)
    off = [np.abs(korda.linearise_carleman(plant, d).rollout(x0, U) - truth).max() for d in (1, 3, 5)]
    assert off[1] < 0.02 * off[0]
    assert off[2] < 0.02 * off[1] + 1e-9


def test_the_waves_of_the_data_are_those_of_the_plant():
    problem = km.load_problem("kdv")
    plant = km.discretize(problem.dynamics, problem.dt, problem.integrator)
    rng = np.random.default_rng(0)
    y, u = rng.dirichlet([1, 1, 1], 3) @ korda.SHAPES, rng.uniform(-1, 1, (3, 3))
    for row, push, ahead in zip(y, u, korda.advance_wave(y, u), strict=True):
        np.testing.assert_allclose(plant(row, push), ahead, atol=1e-11)


@pytest.mark.slow
def test_the_local_mpc_of_the_motor_costs_what_the_paper_says():
    plant = km.discretize(km.load_problem("bilinear_motor").dynamics, korda.DT)
    cost = km.Cost(Q=1.0, R=0.01, tail=0, of=km.State("speed"), u_target="zero")
    local = korda.make_local_mpc(plant, [0.0, 0.6], cost, km.Limits(u_min=-1, u_max=1))
    run = korda.run_loop(plant, local, [0.0, 0.6], korda.STEP)
    assert run.kept_limits == korda.STEPS
    assert abs(run.cost - 3.318) < 0.005


def test_the_table_of_all_papers_counts_the_claims_of_each_page():
    text = (PAGES / "index.md").read_text(encoding="utf-8")
    for name in registry.PAPERS:
        page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
        ((total, held, part, failed),) = re.findall(
            r"Of (\d+) claims (\d+) hold, (\d+) hold in part, (\d+) do not hold", page
        )
        assert f"({name}.md) | {total} | {held} | {part} | {failed} |" in text
