"""docs/start.ipynb from docs/start.md, its source: `python docs/tools/notebook.py`, with what the page shows."""

import base64
import json
import re
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "start.md"
NOTEBOOK = PAGE.with_suffix(".ipynb")
BLOCK = re.compile(r"```python[^\n]*\n(.*?)```\n(?:\n```text\n(.*?)```\n)?", re.DOTALL)
PICTURE = re.compile(r"!\[([^]]*)\]\((pictures/([\w.]+\.png))\)")


def notebook(text: str) -> dict[str, Any]:
    """Return a page as a notebook: Python blocks are cells with what they print, words and pictures stand between."""
    pieces = BLOCK.split(text)  # words, code, output, words, code, output, …, words
    cells: list[dict[str, Any]] = []
    for i in range(0, len(pieces), 3):
        cells.append(words(i, pieces[i].strip()))
        if i + 2 < len(pieces):
            cells.append(code(i + 1, pieces[i + 1].strip(), pieces[i + 2] or ""))
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return {"cells": [c for c in cells if c["source"]], "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}


def words(number: int, source: str) -> dict[str, Any]:
    """Return a cell of Markdown that holds its pictures."""
    held = {file: (PAGE.parent / path).read_bytes() for _, path, file in PICTURE.findall(source)}
    source = PICTURE.sub(r"![\1](attachment:\3)", source)
    made = {"cell_type": "markdown", "id": f"cell-{number}", "metadata": {}, "source": source.splitlines(keepends=True)}
    pictures = {file: {"image/png": base64.b64encode(content).decode()} for file, content in held.items()}
    return made | ({"attachments": pictures} if pictures else {})


def code(number: int, source: str, shown: str) -> dict[str, Any]:
    """Return a cell of Python with what the page shows of its output."""
    out = [{"output_type": "stream", "name": "stdout", "text": shown.splitlines(keepends=True)}] if shown else []
    made = {"cell_type": "code", "id": f"cell-{number}", "metadata": {}, "source": source.splitlines(keepends=True)}
    return made | {"execution_count": None, "outputs": out}


if __name__ == "__main__":
    NOTEBOOK.write_text(json.dumps(notebook(PAGE.read_text()), indent=1, ensure_ascii=False) + "\n")
