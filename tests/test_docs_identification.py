"""Every Python block of docs/how/trust.md runs, one after the other, and prints what the page shows."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest

TEXT = (Path(__file__).parents[1] / "docs" / "how" / "trust.md").read_text()
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


@pytest.fixture(scope="module")
def pages():
    """Return the names that the blocks leave behind, and (shown, printed) of each."""
    names, pairs = {}, []
    for source, shown in re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", TEXT, re.DOTALL):
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(compile(source, "docs/how/trust.md", "exec"), names)
        pairs.append((shown, out.getvalue()))
    return names, pairs


def test_every_block_prints_what_the_page_shows(pages):
    assert len(pages[1]) == TEXT.count("```python")
    for shown, printed in pages[1]:
        words = [re.sub(r"\s+", " ", NUMBER.sub("#", text)) for text in (shown, printed)]
        assert words[0] == words[1]
        numbers = [np.array([float(n) for n in NUMBER.findall(text)]) for text in (shown, printed)]
        assert np.allclose(*numbers, rtol=0.02, atol=1e-9)


def test_the_page_shows_a_good_and_a_bad_model(pages):
    found, pairs = pages
    km = found["km"]
    assert pairs[0][1].startswith("TRUST")
    assert "DO NOT TRUST beyond" in pairs[1][1]
    reports = [
        km.trust(found[name], found["held_out"], 12, train=found[data])
        for name, data in (("good", "train"), ("bad", "timid"))
    ]
    assert [report.trusted for report in reports] == [True, False]
    assert (reports[0].score.rmse[-1] < reports[1].score.rmse[-1]).all()
    assert found["bad"].report.residual[1] < found["good"].report.residual[1]  # as the page says


def test_feedback_breaks_the_band_and_calibrating_restores_it(pages):
    found = pages[0]
    assert found["report"].closed_loop.share < 0.9
    assert found["again"].high > 0.9
