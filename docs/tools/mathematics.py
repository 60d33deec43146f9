"""Blocks of mathematics as MathML, which browsers draw by themselves: no script, no fonts, no network."""

import re
from typing import Any

from latex2mathml.converter import convert

BLOCK = re.compile(r"^```math\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace each ```math block of a page, which is LaTeX, by MathML (a hook of MkDocs)."""
    return BLOCK.sub(
        lambda found: f'<div class="mathematics" tabindex="0">{convert(found[1], display="block")}</div>', markdown
    )
