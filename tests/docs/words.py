"""Kinds of pages and how many words of prose each may have: `python -m tests.docs.words` counts them by page."""

import re
import sys

from tests.docs.page import DOCS

MOST = {  # words of prose on a page of each kind; blocks of code, tables and front matter do not count
    "tutorial": 900,
    "how-to": 400,
    "why": 900,
    "reference": 900,
    "evidence": 600,
    "menu": 300,  # pages that lead to others
    "problem": 400,
    "paper": 1500,
    "history": 12_000,  # docs/research.md: how defaults came about
}
FOLDERS = {"how": "how-to", "why": "why", "problems": "problem", "papers": "paper"}
KINDS = {  # pages outside of these folders
    "index.md": "menu",
    "papers/index.md": "menu",
    "start.md": "tutorial",
    "research.md": "history",
    "adaptive.md": "how-to",
    "design-from-data.md": "how-to",
    "offset_free.md": "how-to",
    "on_the_machine.md": "how-to",
    "plants.md": "how-to",
    "realtime.md": "how-to",
    "release.md": "how-to",
    "sweeps.md": "how-to",
    "viewer.md": "how-to",
    "design.md": "why",
    "controllers.md": "reference",
    "extending.md": "reference",
    "faults.md": "reference",
    "identification.md": "reference",
    "problems.md": "reference",
    "what_can_go_wrong.md": "reference",
    "bench.md": "evidence",
    "c_speed.md": "evidence",
    "speed.md": "evidence",
    "beside_others.md": "evidence",
    "closed_loop.md": "evidence",
    "designs.md": "evidence",
    "library.md": "evidence",
    "real.md": "evidence",
}
LONGER = {"closed_loop.md": 1500}  # the page that every default is chosen by
ALL_BY_HAND = 24_000  # words of prose of all pages but research.md, papers and problems
ALL_PROBLEMS = 12_000  # words of all kinds, code and tables included, on the pages of the problems
APART = re.compile(
    r"\A---\n.*?\n---\n|^ *```.*?^ *```[^\n]*$|<!--.*?-->|^ *\|.*?$|^    .*?$|(?<=\])\([^)]*\)",
    re.DOTALL | re.MULTILINE,
)


def kind_of(page: str) -> str:
    """Return the kind of a page, by its name or its folder."""
    return KINDS.get(page) or FOLDERS[page.partition("/")[0]]


def limit_of(page: str) -> int:
    """Return the words that a page may have."""
    return LONGER.get(page, MOST[kind_of(page)])


def count_prose(text: str) -> int:
    """Count the words outside of code, tables, comments, targets of links and front matter."""
    return len(re.findall(r"\S*\w\S*", APART.sub("", text)))


def find_long(text: str) -> list[str]:
    """Return the beginnings of paragraphs above 120 words and of sentences above 40."""
    paragraphs = re.split(r"\n\s*\n|\n(?=- |\d+\. )", APART.sub("", text))
    sentences = [each for part in paragraphs for each in re.split(r"(?<=[.;:?!])\s+", part)]
    long = [each for each in paragraphs if count_prose(each) > 120] + [
        each for each in sentences if count_prose(each) > 40
    ]
    return [" ".join(each.split())[:80] for each in long]


def count_pages() -> dict[str, int]:
    """Return the words of prose of each page of docs/."""
    paths = {str(path.relative_to(DOCS)): path for path in sorted(DOCS.rglob("*.md"))}
    return {page: count_prose(path.read_text(encoding="utf-8")) for page, path in paths.items()}


if __name__ == "__main__":
    counts = count_pages()
    for page, words in sorted(counts.items(), key=lambda item: -item[1]):
        sys.stdout.write(f"{words:6} of {limit_of(page):6}  {kind_of(page):10} {page}\n")
    for kind in MOST:
        sys.stdout.write(f"{sum(n for page, n in counts.items() if kind_of(page) == kind):6} {kind}\n")
