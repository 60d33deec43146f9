"""Every page of the site: its blocks run, its pictures have words, its links lead somewhere, and the menu has it."""

import base64
import json
import re
import sys

import pytest

from tests.docs.page import DOCS, alike, blocks, run
from tests.tiers import few

sys.path.insert(0, str(DOCS / "tools"))
PAGES = sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))
ELSEWHERE = {  # pages whose claims are tested beyond what they print, and where
    "adaptive.md": "tests/test_docs_pages.py",
    "controllers.md": "tests/test_docs_pages.py",
    "design-from-data.md": "tests/test_docs_pages.py",
    "faults.md": "tests/apps/test_docs.py",
    "how/compiled.md": "tests/test_docs_pages.py",
    "how/from_pid.md": "tests/test_docs_from_pid.py",
    "how/fmu.md": "tests/test_docs_pages.py",
    "how/gymnasium.md": "tests/test_docs_pages.py",
    "how/hidden_states.md": "tests/test_docs_pages.py",
    "how/onnx.md": "tests/lifting/test_onnx.py",
    "how/opcua.md": "tests/loop/test_live.py",
    "how/own_step_function.md": "tests/test_docs_pages.py",
    "how/peers.md": "tests/models/test_peers.py",
    "how/ros2.md": "tests/loop/test_live.py",
    "how/trust.md": "tests/test_docs_pages.py",
    "offset_free.md": "tests/estimate/test_docs.py",
    "on_the_machine.md": "tests/test_docs_pages.py",
    "problems.md": "tests/apps/test_docs.py",
    "realtime.md": "tests/loop/test_realtime.py",
    "start.md": "tests/docs/test_pages.py",  # as the notebook
    "sweeps.md": "tests/apps/test_docs.py",
}
PACKAGES = {
    "gym": "gymnasium",
    "sklearn": "sklearn",
    "pandas": "pandas",
    "hdf5": "h5py",
    "mdf": "asammdf",
    "ros": "mcap",
    "opcua": "asyncua",
}

HERE = [page for page in PAGES if blocks(page) and page not in ELSEWHERE]
LONG = {"extending.md", "how/closed_loop_logs.md", "how/own_logs.md", "how/unequal_rates.md", "why/guarantees.md"}
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")


def links(text):
    """Return (picture?, words, target) of each link that stands outside of code."""
    text = re.sub(r"^```.*?^```|^    .*?$|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)
    return [(bool(mark), words, target) for mark, words, target in LINK.findall(text)]


def anchors(page):
    """Return the anchors that the headings of a page give, by their words or by `{ #name }` behind them."""
    titles = re.findall(r"^#+ (.*?)(?: \{ #?([\w-]+) \})?$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", (given or words).lower()).strip().replace(" ", "-") for words, given in titles}


@pytest.mark.filterwarnings("ignore:.*sampling is unequal.*interpolated to:koopmpc.FitWarning")  # the page says so
@pytest.mark.parametrize("page", few(HERE, *(page for page in HERE if page not in LONG)))
def test_every_block_of_a_page_runs_and_prints_what_the_page_shows(page, tmp_path):
    for block in blocks(page):
        if block.extra:
            pytest.importorskip(PACKAGES[block.extra])
    for shown, printed in run(page, tmp_path)[1]:
        assert alike(shown, printed), printed


def test_no_block_is_left_out():
    for page, test in ELSEWHERE.items():
        assert page in PAGES
        assert page.rpartition("/")[2] in (DOCS.parent / test).read_text(encoding="utf-8"), page
    for page in PAGES:
        assert (DOCS / page).read_text(encoding="utf-8").count("```python") == len(blocks(page)), page


@pytest.mark.parametrize("page", [*PAGES, "../README.md"])
def test_pictures_have_words_and_links_lead_to_files_and_headings_that_exist(page):
    path = DOCS / page
    for picture, words, target in links(path.read_text(encoding="utf-8")):
        if picture:
            assert len(words.split()) >= 2, f"{page}: {target} needs words that tell what it shows"
        if (
            "://" in target
            or target.startswith("reference/")
            or "/reference/" in target
            or target.startswith("gallery/")
        ):
            continue
        file, _, heading = target.partition("#")
        found = path.parent / file if file else path
        assert found.exists(), f"{page}: {target}"
        if heading:
            assert heading in anchors(found), f"{page}: {target}"


def test_every_page_is_in_the_menu():
    menu = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    listed = re.findall(r"([\w/.-]+\.md)$", menu, re.MULTILINE)
    for folder in re.findall(r"- ([\w/]+/)$", menu, re.MULTILINE):
        listed += [f"{folder}{path.name}" for path in (DOCS / folder).glob("*.md")]
    assert len(listed) == len(set(listed))
    assert set(PAGES) <= set(listed)


def test_no_two_entries_of_a_menu_have_one_title():
    pytest.importorskip("mkdocs")
    from menu import _title

    for folder in ("papers", "problems"):
        titles = [_title(path) for path in (DOCS / folder).glob("*.md")]
        assert len(titles) == len(set(titles)), folder


def test_every_page_of_a_problem_leads_to_the_table_of_all():
    for path in (DOCS / "problems").glob("*.md"):
        assert "../library.md" in [
            target for picture, _, target in links(path.read_text(encoding="utf-8")) if not picture
        ]


def test_pictures_of_the_site_are_small():
    for path in [*(DOCS / "pictures").iterdir(), *DOCS.rglob("*.gif")]:
        assert path.stat().st_size <= 200_000, path


def test_the_notebook_is_the_start_page_and_runs(tmp_path, monkeypatch, capsys):
    from notebook import NOTEBOOK, PAGE, notebook

    made = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert made == notebook(PAGE.read_text(encoding="utf-8")), "run python docs/tools/notebook.py"
    cells = ["".join(cell["source"]) for cell in made["cells"] if cell["cell_type"] == "code"]
    page = blocks("start.md")
    outputs = ["".join("".join(out["text"]) for out in c["outputs"]) for c in made["cells"] if "outputs" in c]
    assert [text.strip() for text in outputs] == [(block.shown or "").strip() for block in page]
    held = [base64.b64decode(one["image/png"]) for c in made["cells"] for one in c.get("attachments", {}).values()]
    assert (DOCS / "pictures" / "start.png").read_bytes() in held
    assert [cell.strip() for cell in cells] == [block.source.strip() for block in page]
    names: dict = {"__name__": "notebook"}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)  # there rich displays what else it writes
    for cell, block in zip(cells, page, strict=True):
        exec(compile(cell, "start.ipynb", "exec"), names)
        assert alike(block.shown, capsys.readouterr().out)
    assert (tmp_path / "swing_up.rrd").exists()


def test_the_readme_keeps_to_two_screens():
    assert len((DOCS.parent / "README.md").read_text(encoding="utf-8").splitlines()) <= 100
