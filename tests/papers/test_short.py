"""The short papers: every required number is reproduced, and docs/papers/ holds the pages as the commands write them."""

import re
from pathlib import Path

import pytest

from koopmpc.papers.registry import PAPERS, Verdict, find_paper

PAGES = Path(__file__).parents[2] / "docs" / "papers"
QUICK = ("brunton", "proctor", "williams")


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
