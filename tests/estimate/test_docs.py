"""The example in docs/offset_free.md runs as it stands, and says what the text says."""

import re
from pathlib import Path


def test_the_example_of_the_documentation_leaves_no_offset(capsys):
    text = (Path(__file__).parents[2] / "docs" / "offset_free.md").read_text()
    (source,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(source, {})
    without, relifted, filtered = (abs(float(line.split()[0])) for line in capsys.readouterr().out.splitlines())
    assert without > 0.1
    assert relifted < 1e-6
    assert filtered < 1e-6
