"""Pages are short: words of prose by kind of page, and in all."""

import pytest

from tests.docs.page import DOCS
from tests.docs.words import (
    ALL_BY_HAND,
    ALL_PROBLEMS,
    FOLDERS,
    KINDS,
    count_pages,
    count_prose,
    find_long,
    kind_of,
    limit_of,
)

COUNTS = count_pages()


@pytest.mark.parametrize("page", COUNTS)
def test_no_page_is_longer_than_its_kind_may_be(page):
    assert page in KINDS or page.partition("/")[0] in FOLDERS, f"enter docs/{page} in tests/docs/words.py"
    assert COUNTS[page] <= limit_of(page), f"docs/{page} is a {kind_of(page)} page of {COUNTS[page]} words"


@pytest.mark.parametrize("page", [page for page in COUNTS if kind_of(page) not in ("history", "paper", "problem")])
def test_paragraphs_and_sentences_can_be_read_at_once(page):
    assert not find_long((DOCS / page).read_text(encoding="utf-8"))


def test_a_long_paragraph_and_a_long_sentence_are_found():
    assert len(find_long("One two. " * 61)) == 1
    assert len(find_long("word " * 41)) == 1
    assert not find_long("- " + "word " * 39 + "end.\n- next.")


def test_the_pages_written_by_hand_and_the_pages_of_the_problems_are_short_in_all():
    by_hand = {page: n for page, n in COUNTS.items() if kind_of(page) not in ("history", "paper", "problem")}
    assert sum(by_hand.values()) <= ALL_BY_HAND
    problems = [path.read_text(encoding="utf-8") for path in (DOCS / "problems").glob("*.md")]
    assert sum(len(text.split()) for text in problems) <= ALL_PROBLEMS


def test_every_page_that_is_listed_exists():
    assert set(KINDS) <= set(COUNTS)


def test_code_tables_targets_and_front_matter_are_no_prose():
    page = (
        "---\nboost: 2\n---\n# One two\n\n[three](four/five.md) six.\n\n```python\nseven = 8\n```\n\n| nine | ten |\n"
    )
    assert count_prose(page) == 4
