"""The Python blocks of docs/adaptive.md run, and do what the page says."""

import re
from pathlib import Path

TEXT = (Path(__file__).parents[1] / "docs" / "adaptive.md").read_text()


def test_the_blocks_run_and_the_model_knows_what_the_page_says():
    names = {}
    for source in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
        source = source.replace("# True", "").replace("# False: no data there", "")
        exec(compile(source, "docs/adaptive.md", "exec"), names)
    mpc = names["mpc"]
    mpc.reset()
    assert mpc([0.1, 0.2], [0, 0]).known
    assert not mpc([1.0, 40.0], [0, 0]).known
