"""The parts of the menu that grow by themselves: `NAME: folder/` in mkdocs.yml stands for the pages of that folder."""

from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig


def on_config(config: MkDocsConfig) -> None:
    """Put the pages of a folder, titled up to a colon or else a comma, in place of its name: a hook of MkDocs."""
    docs = Path(config.docs_dir)
    for entry in config.nav or []:
        for title, pages in entry.items():
            entry[title] = [one for page in pages for one in _pages(page, docs)]


def _pages(page: Any, docs: Path) -> list[Any]:
    if not (isinstance(page, str) and page.endswith("/")):
        return [page]
    paths = sorted((docs / page).glob("*.md"))
    return [{_title(path): f"{page}{path.name}"} for path in paths]


def _title(path: Path) -> str:
    heading = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
    return heading.partition(":" if ":" in heading else ",")[0]
