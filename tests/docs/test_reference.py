"""The reference of the site: every public name has an entry, every entry a page, and the examples of docstrings run."""

import doctest
import html
import importlib
import inspect
import re
import sys
from types import ModuleType

import pytest

import koopmpc as km
from tests.docs.page import DOCS

sys.path.insert(0, str(DOCS / "tools"))
import reference

from tests.tiers import few

ENTRIES = reference.entries()
WITH_EXAMPLE = [entry for entry in ENTRIES if callable(entry.found) and ">>>" in (inspect.getdoc(entry.found) or "")]


def test_every_public_name_has_an_entry_that_leads_to_where_it_is_defined():
    found = {id(entry.found) for entry in ENTRIES}
    for name in dir(km):
        value = getattr(km, name)
        public = getattr(value, "__all__", []) if isinstance(value, ModuleType) else [name]
        room = value if isinstance(value, ModuleType) else km
        for each in public:
            assert id(getattr(room, each)) in found, f"{name}.{each}"
    for entry in ENTRIES:
        home, _, attribute = entry.path.rpartition(".")
        assert getattr(importlib.import_module(home), attribute) is entry.found
    for name in ("NaNSensor", "Fault"):
        assert f"km.faults.{name}" in {entry.name for entry in ENTRIES}
    assert {"km.scene.Box", "km.errors.LogError", "km.plot.spectrum"} <= {entry.name for entry in ENTRIES}


def test_every_room_has_a_page_in_the_menu_and_every_function_and_class_a_first_line():
    menu = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    for entry in ENTRIES:
        assert f"reference/{entry.room}.md" in menu, entry.name
        assert entry.first_line or not callable(entry.found), entry.name
    assert set(reference.ROOMS) == {entry.room for entry in ENTRIES}


def test_every_command_is_on_its_page_with_what_it_says_of_itself():
    page = reference.commands()
    for command in ("fit", "bench", "export", "inspect"):
        assert f"## koopmpc {command}\n" in page
    assert "`--seeds`" in page


def test_thirty_names_have_an_example():
    assert len(WITH_EXAMPLE) >= 30
    assert {"km.edmd", "km.KoopmanMPC", "km.simulate", "km.Cost"} <= {entry.name for entry in WITH_EXAMPLE}


@pytest.mark.parametrize(
    "entry",
    few(WITH_EXAMPLE, *(entry for entry in WITH_EXAMPLE if entry.name != "km.identify.neural_state_space")),
    ids=lambda entry: entry.name,
)
def test_the_examples_of_a_docstring_run_and_show_what_they_say(entry, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    example = doctest.DocTestParser().get_doctest(inspect.getdoc(entry.found), {}, entry.name, None, None)
    said = []
    doctest.DocTestRunner(verbose=False).run(example, out=said.append)
    assert not said, "".join(said)


def test_arguments_described_together_have_each_their_own_type():
    griffe = pytest.importorskip("griffe", reason="the extra docs is not installed")
    extensions = griffe.load_extensions(str(DOCS / "tools" / "annotations.py"))
    package = griffe.load(
        "koopmpc", search_paths=[DOCS.parent], docstring_parser="numpy", extensions=extensions, allow_inspection=False
    )
    for name, argument, kind in (("KoopmanMPC", "limits", "Limits | None"), ("KoopmanMPC", "cost", "Cost")):
        path = next(entry.path for entry in ENTRIES if entry.name == f"km.{name}")
        sections = package[path.removeprefix("koopmpc.")].docstring.parsed
        types = {each.name: str(each.annotation) for s in sections if s.kind.value == "parameters" for each in s.value}
        assert types[argument] == kind


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_holds_every_entry_and_every_problem_file(site):
    for entry in ENTRIES:
        assert f'id="{entry.path}"' in (site / "reference" / f"{entry.room}.html").read_text(encoding="utf-8")
    for path in (DOCS.parent / "problems").glob("*.py"):
        page = (site / "problems" / f"{path.stem}.html").read_text(encoding="utf-8")
        assert "--8<--" not in page
        assert path.read_text(encoding="utf-8").splitlines()[0].strip('"') in re.sub("<[^>]*>", "", html.unescape(page))
