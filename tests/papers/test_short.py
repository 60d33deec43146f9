"""The short papers: every required number is reproduced, and docs/papers/ holds the pages as the commands write them."""

import re
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from koopmpc.papers import korda, korda_motor
from koopmpc.papers.registry import PAPERS, Verdict, find_paper

PAGES = Path(__file__).parents[2] / "docs" / "papers"
QUICK = (
    "brunton",
    "proctor",
    "williams",
    "kic",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("korda", "dictionary", "kaiser", "kernel")),
)


@pytest.mark.parametrize("name", QUICK)
def test_a_paper_reproduces_its_required_numbers_and_writes_its_page(tmp_path, name):
    outcome = find_paper(name).reproduce(tmp_path, True, lambda words: None)
    assert outcome.failed == ()
    assert any(claim.required for claim in outcome.claims)
    assert outcome.recording.stat().st_size > 1e3
    assert outcome.report.read_text(encoding="utf-8").count("| **holds** |") > 0


@pytest.mark.parametrize("name", [name for name in PAPERS if name != "snyder"])
def test_the_page_in_docs_has_pictures_and_no_required_claim_that_fails(name):
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    assert text.startswith(f"# {find_paper(name).title}\n")
    assert Verdict.HOLDS.value in text
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", text)
    assert pictures
    for picture in pictures:
        assert (PAGES / picture).is_file()


def test_carleman_s_linearisation_is_exact_to_its_degree_near_rest():
    plant = km.discretize(km.load_problem("van_der_pol").dynamics, korda.DT)
    U, x0 = np.zeros((40, 1)), np.array([2e-2, -1e-2])
    truth = plant.rollout(x0, U)
    off = [np.abs(korda.carleman(plant, d).rollout(x0, U) - truth).max() for d in (1, 3, 5)]
    assert off[1] < 0.02 * off[0]
    assert off[2] < 0.02 * off[1] + 1e-9


def test_the_waves_of_the_data_are_those_of_the_plant():
    problem = km.load_problem("kdv")
    plant = km.discretize(problem.dynamics, problem.dt, problem.integrator)
    rng = np.random.default_rng(0)
    y, u = rng.dirichlet([1, 1, 1], 3) @ korda.SHAPES, rng.uniform(-1, 1, (3, 3))
    for row, push, ahead in zip(y, u, korda.advanced(y, u), strict=True):
        np.testing.assert_allclose(plant(row, push), ahead, atol=1e-11)


@pytest.mark.slow
def test_the_local_mpc_of_the_motor_costs_what_the_paper_says():
    plant = km.discretize(km.load_problem("bilinear_motor").dynamics, korda_motor.DT)
    cost = km.Cost(Q=1.0, R=0.01, tail=0, of=km.State("speed"), u_target="zero")
    local = korda_motor.linearised(plant, [0.0, 0.6], cost, km.Limits(u_min=-1, u_max=1))
    run = korda_motor.loop(plant, local, [0.0, 0.6], korda_motor.STEP)
    assert run.solved == korda_motor.STEPS
    assert abs(run.cost - 3.318) < 0.005


def test_the_table_of_all_papers_counts_the_claims_of_each_page():
    text = (PAGES / "index.md").read_text(encoding="utf-8")
    for name in PAPERS:
        page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
        ((total, held, part, failed),) = re.findall(
            r"Of (\d+) claims (\d+) hold, (\d+) hold in part, (\d+) do not hold", page
        )
        assert f"({name}.md) | {total} | {held} | {part} | {failed} |" in text
