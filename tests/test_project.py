"""The files around the library agree: version, tested Pythons, tools, and the form of the changelog."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOW = ROOT / ".github" / "workflows" / "tests.yml"
HOOKS = ROOT / ".pre-commit-config.yaml"
LONGEST = 200  # characters of an entry of the changelog


def test_the_citation_has_the_version_of_the_package() -> None:
    (cited,) = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.M)
    assert cited == PROJECT["version"]


@pytest.mark.skipif(not WORKFLOW.exists(), reason="the folder .github belongs to the repository alone")
def test_the_workflow_runs_the_pythons_that_the_package_names_and_files_that_exist() -> None:
    text = WORKFLOW.read_text()
    named = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.fullmatch(r".*:: 3\.\d+", c)]
    (run,) = re.findall(r"python: \[(.*)\]", text)
    assert re.findall(r"3\.\d+", run) == named
    smoke = re.findall(r"\btests/[\w/.]+", text)
    assert smoke
    assert all((ROOT / name).exists() for name in smoke)
    targets = re.findall(r"^([\w ]+):(?!=)", (ROOT / "Makefile").read_text(), re.M)
    made = re.findall(r"\bmake (\w+)", text)
    assert {"lowest", "newest"} <= set(made) <= set(" ".join(targets).split())
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111


@pytest.mark.skipif(not HOOKS.exists(), reason="the hooks belong to the repository alone")
def test_the_hooks_use_the_ruff_that_the_tests_use() -> None:
    (pinned,) = re.findall(r"^ruff==(\S+)$", (ROOT / "constraints.txt").read_text(), re.M)
    assert re.findall(r"rev: v(\S+)", HOOKS.read_text()) == [pinned]


def test_the_changelog_is_one_page_of_short_entries() -> None:
    text = (ROOT / "CHANGELOG.md").read_text()
    assert text.count("\n") <= 150
    assert re.findall(r"^## (.*)$", text, re.M) == ["0.1.0: what it does", "Old names"]
    entries = re.findall(r"^- (.*(?:\n +.*)*)", text, re.M)
    assert len(entries) > 20
    assert [entry for entry in entries if len(entry) > LONGEST] == []
