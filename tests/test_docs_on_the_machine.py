"""The blocks of docs/on_the_machine.md and docs/how/compiled.md run, and show what is printed."""

import re
import subprocess
from pathlib import Path

from tests.docs.page import blocks

TEXT = (Path(__file__).parents[1] / "docs" / "on_the_machine.md").read_text(encoding="utf-8")


def test_the_page_runs_as_it_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    for source in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
        exec(compile(source, "docs/on_the_machine.md", "exec"), names)
    printed = subprocess.run(
        ["make", "-s", "run", "CFLAGS=-O0"], cwd=tmp_path / "controller", capture_output=True, text=True, check=True
    ).stdout.splitlines()
    shown = [line.strip() for line in TEXT.splitlines() if re.match(r"    (step|\d+),", line)]
    assert printed[0] == shown[0]
    for line, wanted in zip(printed[1:], shown[1:], strict=False):
        numbers = [[float(word) for word in each.split(",")] for each in (line, wanted)]
        assert max(abs(a - b) for a, b in zip(*numbers, strict=True)) < 1e-4


def test_the_page_on_compiled_controllers_runs_and_says_what_is_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in blocks("how/compiled.md"):
        exec(compile(block.source, "docs/how/compiled.md", "exec"), names)
    said = capsys.readouterr().out.splitlines()
    assert said[-2:] == ["True", "(1000, 201, 2) (1000, 200, 1) True"]
