"""Every Python block of docs/design-from-data.md runs, one after the other."""

import contextlib
import io
import re
import warnings
from pathlib import Path

import pytest

from tests.small_designs import small_designs

TEXT = (Path(__file__).parents[1] / "docs" / "design-from-data.md").read_text()


@pytest.mark.parametrize(
    "size", [small_designs, pytest.param(contextlib.nullcontext, marks=pytest.mark.slow)], ids=["small", "as it stands"]
)
def test_the_blocks_end_in_a_loaded_controller_that_holds_the_pendulum_inside_its_limits(size, tmp_path):
    names, printed = {}, []
    with contextlib.chdir(tmp_path), warnings.catch_warnings(), size():
        for source in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(source, "docs/design-from-data.md", "exec"), names)
            printed.append(out.getvalue())
    assert "0 of 12" in printed[0]
    violation, upright = printed[1].split()
    assert float(violation) <= 0.01
    assert upright == "True"
    assert names["design"].controller.limits.margin is not None
