"""How plainly the library speaks: counts of names and words that may fall, and may not rise (docs/design.md)."""

import ast
import io
import re
import tokenize
from collections import defaultdict

import pytest

from tests.sources import texts, trees

MOST = {
    "functions named by a participle": 32,
    "lines with two constants": 0,
    "public names with two homes": 0,
    "riddling words": 5,
    "sentences above 40 words": 0,
}
IRREGULAR = re.compile(
    "begun|bound|built|chosen|cut|done|drawn|driven|fed|felt|found|given|gone|got|had|heard|held|kept|known|laid|left|"
    "lost|made|meant|met|put|read|run|said|seen|sent|set|shown|shut|spent|split|spoken|stood|struck|taken|thought|told|"
    "torn|understood|unfelt|unheld|won|written|[a-z]{3,}ed"
)
NOUNS = re.compile("cut|embed|exceed|feed|hundred|lead|need|proceed|put|read|run|seed|set|speed|split|spread|succeed")
RIDDLES = re.compile(
    r"(?<!there )\b(is|are|was|were) (none|no (?!longer|more))\b|\b(is|are) told\b|\bin whom\b|\banew\b|\bof ours\b|"
    r"\bthat which\b|\bbut for\b|\bcounts? beside\b|\bwhose answer it is\b|\bon its way\b|\bof one's own\b|\bshall\b|"
    r"\bthe same of\b|\bhas not shown up\b|\blet through\b|\bas little as\b|\bthe one who\b|\bwhat is left of\b",
    re.I,
)
DOCUMENTED = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Module)
SECTIONS = re.compile(r"\n\s*(?:Parameters|Raises|References|Examples|Returns|Attributes)\n\s*-+")


def is_participle(name: str) -> bool:
    word = name.strip("_")
    return IRREGULAR.fullmatch(word) is not None and NOUNS.fullmatch(word) is None


def sets_two_constants(node: ast.stmt) -> bool:
    if not isinstance(node, ast.Assign) or not isinstance(node.targets[0], ast.Tuple):
        return False
    return all(isinstance(e, ast.Name) and e.id.strip("_").isupper() for e in node.targets[0].elts)


def sentences_of(nodes: list[ast.AST]):
    for node in nodes:
        if isinstance(node, DOCUMENTED) and (text := ast.get_docstring(node)):
            yield from re.split(r"(?<=[.;:?!])\s+", SECTIONS.split(text)[0])


def spoken_lines(text: str):
    """Yield the comments, and the strings of more than a word that are no docstrings."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        plain = token.type == tokenize.STRING and not token.string.startswith(('"""', "'''"))
        middle = token.type == getattr(tokenize, "FSTRING_MIDDLE", None)  # text of f-strings from Python 3.12 on
        if token.type == tokenize.COMMENT or ((plain or middle) and " " in token.string):
            yield token.string


def may_riddle(text: str, nodes: list[ast.AST]) -> bool:
    """Return whether a line with a comment or a string, outside docstrings, holds a riddling word."""
    inside = {
        line
        for node in nodes
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False)
        for line in range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1)
    }
    lines = enumerate(text.splitlines(), start=1)
    return any(RIDDLES.search(line) for k, line in lines if re.search("[#\"']", line) and k not in inside)


def find_places(files: list[tuple[str, str, ast.Module]]) -> dict[str, list[str]]:
    """Return the places of each kind in files, given as (name, text, tree)."""
    places: dict[str, list[str]] = defaultdict(list)
    homes: dict[str, set[str]] = defaultdict(set)
    for file, text, tree in files:
        every = list(ast.walk(tree))
        for node in every:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and is_participle(node.name):
                places["functions named by a participle"].append(f"{file}:{node.lineno} {node.name}")
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].add(file)
            if sets_two_constants(node):
                places["lines with two constants"].append(f"{file}:{node.lineno}")
        for sentence in sentences_of(every):
            if len(sentence.split()) > 40:
                places["sentences above 40 words"].append(f"{file}: {sentence[:80]}")
            if RIDDLES.search(sentence):
                places["riddling words"].append(f"{file}: {sentence[:80]}")
        spoken = spoken_lines(text) if may_riddle(text, every) else ()  # tokens take most of the time
        places["riddling words"] += [f"{file}: {line[:80]}" for line in spoken if RIDDLES.search(line)]
    shared = {name: sorted(where) for name, where in homes.items() if len(where) > 1}
    places["public names with two homes"] = [f"{name}: {', '.join(where)}" for name, where in shared.items()]
    return places


@pytest.fixture(scope="module")
def places():
    files = [(str(path), text, trees()[path]) for path, text in texts().items()]
    return find_places([one for one in files if not one[0].startswith("problems/")])


@pytest.mark.parametrize("kind", MOST)
def test_the_library_speaks_as_plainly_as_before(places, kind):
    assert len(places[kind]) <= MOST[kind], "\n".join(places[kind])


def test_each_kind_is_found_where_it_stands():
    long = " ".join(["word"] * 41)
    text = (
        f'"""{long}."""\nA, B = 1, 2  # found anew\ndef solved():\n    raise ValueError("x is told")\nclass Box: ...\n'
    )
    files = {"one.py": text, "two.py": "class Box: ...\nC = 1\ndef solve(): ...\n"}
    found = find_places([(name, text, ast.parse(text)) for name, text in files.items()])
    assert {kind: len(found[kind]) for kind in MOST} == {
        "functions named by a participle": 1,
        "lines with two constants": 1,
        "public names with two homes": 1,
        "riddling words": 2,
        "sentences above 40 words": 1,
    }
