"""A page of the documentation: its Python blocks, run one after the other, and what it shows as printed."""

import contextlib
import io
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

DOCS = Path(__file__).parents[2] / "docs"
BLOCK = re.compile(r"```python(?: title=\"needs the extra (\w+)[^\n]*)?\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.DOTALL)
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


class Block(NamedTuple):
    """Python of a page, the extra that it needs, and the text that the page shows as its output."""

    extra: str
    source: str
    shown: str


def blocks(page: str) -> list[Block]:
    return [Block(*found) for found in BLOCK.findall((DOCS / page).read_text(encoding="utf-8"))]


def run(page: str, folder: Path) -> tuple[dict, list[tuple[str, str]]]:
    """Run the blocks of a page in a folder; return the names that they leave and, where it shows it, (shown, printed)."""
    names: dict = {"__name__": "page"}
    pairs = []
    with contextlib.chdir(folder):
        for block in blocks(page):
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(block.source, f"docs/{page}", "exec"), names)
            if block.shown:
                pairs.append((block.shown, out.getvalue()))
    return names, pairs


def alike(shown: str, printed: str) -> bool:
    """Whether the words are the same, and the numbers to 2 %."""
    words = [re.sub(r"\s+", " ", NUMBER.sub("#", text)).strip() for text in (shown, printed)]
    numbers = [np.array([float(n) for n in NUMBER.findall(text)]) for text in (shown, printed)]
    return words[0] == words[1] and np.allclose(*numbers, rtol=0.02, atol=1e-9)
