"""docs/start.ipynb from docs/start.md, its source: `python docs/tools/notebook.py`. Outputs come when it is run."""

import json
import re
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "start.md"
NOTEBOOK = PAGE.with_suffix(".ipynb")
BLOCK = re.compile(r"```python[^\n]*\n(.*?)```\n(?:\n```text\n.*?```\n)?", re.DOTALL)


def notebook(text: str) -> dict[str, Any]:
    """Return a page as a notebook: Python blocks are cells, what they printed is left out, words stand between."""
    pieces = BLOCK.split(text)  # words, code, words, code, …, words
    cells = [cell("code" if i % 2 else "markdown", i, piece.strip()) for i, piece in enumerate(pieces) if piece.strip()]
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return {"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}


def cell(kind: str, number: int, source: str) -> dict[str, Any]:
    """Return a cell of a notebook."""
    made = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": source.splitlines(keepends=True)}
    return made | ({"execution_count": None, "outputs": []} if kind == "code" else {})


if __name__ == "__main__":
    NOTEBOOK.write_text(json.dumps(notebook(PAGE.read_text()), indent=1, ensure_ascii=False) + "\n")
