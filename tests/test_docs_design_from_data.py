"""Every Python block of docs/design-from-data.md runs, one after the other."""

import contextlib
import io
import re
import warnings
from pathlib import Path

import pytest

TEXT = (Path(__file__).parents[1] / "docs" / "design-from-data.md").read_text()


@pytest.fixture(scope="module")
def blocks(tmp_path_factory):
    """Return the names that the blocks leave behind, and what each printed."""
    names, printed = {}, []
    with contextlib.chdir(tmp_path_factory.mktemp("page")), warnings.catch_warnings():
        for source in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(source, "docs/design-from-data.md", "exec"), names)
            printed.append(out.getvalue())
    return names, printed


def test_the_blocks_end_in_a_loaded_controller_that_holds_the_pendulum_inside_its_limits(blocks):
    names, printed = blocks
    assert "0 of 12" in printed[0]
    violation, upright = printed[1].split()
    assert float(violation) <= 0.01
    assert upright == "True"
    assert names["design"].controller.limits.margin is not None
