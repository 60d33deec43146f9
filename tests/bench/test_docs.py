"""The example in docs/problems.md runs as it stands."""

import re
from pathlib import Path

from koopmpc.bench.library import load_problem
from koopmpc.bench.sweep import sweep


def test_the_example_of_the_documentation_runs_and_reaches(tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "problems.md").read_text()
    (source,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    path = tmp_path / "spring.py"
    path.write_text(source)
    rows = sweep([load_problem(path)], folder=tmp_path / "logs")
    assert [row.failure for row in rows] == [None] * 10
    assert all(row.reached for row in rows if row.controller in ("koopman-mpc", "nonlinear-mpc"))
