"""A report in Markdown: what is added stands in it in order, and only pictures that were saved."""

import matplotlib.figure
import pytest

import koopmpc as km
from koopmpc.recording.page import Page


def test_a_report_holds_its_parts_in_order_and_its_pictures_beside_it(tmp_path):
    page = Page(tmp_path, beside="mine")
    page.text("## Title", "two\nlines")
    page.table(("|u|", "b"), [(1, "x")])
    page.code("a  b")
    page.items(["one", "two"])
    page.picture("one", "A picture", matplotlib.figure.Figure())
    assert (tmp_path / "mine" / "one.png").read_bytes().startswith(b"\x89PNG")
    assert page.write().read_text(encoding="utf-8") == (
        "## Title\n\ntwo lines\n\n| \\|u\\| | b |\n| --- | --- |\n| 1 | x |\n\n```text\na  b\n```\n\n- one\n- two\n\n"
        "![A picture](mine/one.png)\n\n*A picture*\n"
    )
    assert "![" not in page.words
    assert "- two" in page.words


def test_a_picture_that_cannot_be_saved_leaves_the_report_as_it_was(tmp_path):
    (tmp_path / "one.png").mkdir()
    page = Page(tmp_path)
    with pytest.raises(km.errors.LogError, match="is a folder"):
        page.picture("one", "A picture", matplotlib.figure.Figure())
    assert page.parts == []
