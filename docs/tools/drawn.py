"""What drew each picture: `python docs/tools/drawn.py` names pictures that are older than their code or data.

docs/pictures/drawn.json holds a digest of each picture and of its inputs: the code that draws it, the problem file or
the blocks of the page that it shows. Comments, docstrings and line breaks do not count, nor does the library that this
code calls. The tools that draw stamp what they wrote; after `koopmpc reproduce`, once its pictures are copied to
docs/papers/, `python docs/tools/drawn.py papers/kaiser` stamps those of a folder; after `python -m tests.real.pictures`
name the picture, as pictures/real_robot_arm.png.
"""

import ast
import hashlib
import json
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
STAMPS = DOCS / "pictures" / "drawn.json"
TABLES = {  # picture -> the stored rows that it shows
    "calibration": "tests/closed_loop/calibration.json",
    "coverage": "tests/guarantees/coverage/table.json",
}
PAPERS = {  # folder of docs/papers -> the module of problems/papers that draws its pictures
    "brunton": "proctor.py",
    "dictionary": "kevrekidis.py",
    "kaiser": "kaiser.py",
    "kernel": "kevrekidis.py",
    "kic": "proctor.py",
    "korda": "korda.py",
    "proctor": "proctor.py",
    "snyder": "snyder/figures.py",
    "williams": "kevrekidis.py",
}


def list_pictures() -> list[str]:
    """Return the pictures of the site, as paths below docs/."""
    return sorted(str(path.relative_to(DOCS)) for kind in ("*.png", "*.gif") for path in DOCS.rglob(kind))


def inputs_of(picture: str) -> list[str]:
    """Return what a picture is drawn from, as `file` or `file:function`, below the root of the repository."""
    folder, _, file = picture.rpartition("/")
    name = file.partition(".")[0]
    if folder.startswith("problems/"):
        return ["docs/tools/gallery.py:draw", f"problems/{folder.partition('/')[2]}.py"]
    if folder.startswith("papers/"):
        return [f"problems/papers/{PAPERS[folder.partition('/')[2]]}"]
    if name.startswith("real_"):
        return ["tests/real/pictures.py:draw"]
    if name in TABLES:
        return [f"docs/tools/pictures.py:{name}", TABLES[name]]
    return [f"docs/tools/pictures.py:{name}"]


def digest_inputs(picture: str, read: Callable[[str], str] | None = None) -> str:
    """Return a digest of what a picture is drawn from; `read` returns the text of a file of the repository."""
    read = read or (lambda path: (ROOT / path).read_text(encoding="utf-8"))
    parts: list[str] = []
    for each in inputs_of(picture):
        path, _, function = each.partition(":")
        parts.append(_strip_words(_select(read(path), function) if function else read(path)))
    code = "".join(parts)
    for page in sorted({name for name in re.findall(r"[\"']([\w/-]+\.md)[\"']", code) if (DOCS / name).exists()}):
        blocks = re.findall(r"```python[^\n]*\n(.*?)```", read(f"docs/{page}"), re.DOTALL)
        parts += [_strip_words(block) for block in (blocks if page == "start.md" else blocks[:1])]
    problems = re.findall(r"load_problem\([\"'](\w+)", "".join(parts))
    parts += [_strip_words(read(f"problems/{name}.py")) for name in sorted(set(problems))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def digest_picture(picture: str) -> str:
    """Return a digest of the picture itself."""
    return hashlib.sha256((DOCS / picture).read_bytes()).hexdigest()[:16]


def find_stale() -> list[str]:
    """Return the pictures that are not as their inputs were drawn, and what is stamped without being there."""
    stamps = json.loads(STAMPS.read_text(encoding="utf-8"))
    pictures = list_pictures()
    changed = [each for each in pictures if stamps.get(each) != [digest_inputs(each), digest_picture(each)]]
    return changed + sorted(set(stamps) - set(pictures))


def stamp(pictures: Iterable[str]) -> None:
    """Say that these pictures have been drawn now."""
    stamps = json.loads(STAMPS.read_text(encoding="utf-8")) if STAMPS.exists() else {}
    stamps |= {each: [digest_inputs(each), digest_picture(each)] for each in pictures}
    lines = [f"  {json.dumps(each)}: {json.dumps(stamps[each])}" for each in sorted(stamps) if (DOCS / each).exists()]
    STAMPS.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def _strip_words(source: str) -> str:
    """Return a source without docstrings, comments and blanks."""
    lines = source.splitlines()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module) and ast.get_docstring(node) is not None:
            first = node.body[0]
            lines[first.lineno - 1 : first.end_lineno] = [""] * (first.end_lineno - first.lineno + 1)
    return "".join(re.sub(r"(^|\s)#.*$", "", line) for line in lines).replace(" ", "")


def _select(text: str, function: str) -> str:
    """Return a function of a file, with the other functions of this file that it names."""
    found = {node.name: node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)}
    wanted, known = [function], set[str]()
    while wanted:
        name = wanted.pop()
        known.add(name)
        names = {node.id for node in ast.walk(found[name]) if isinstance(node, ast.Name)}
        wanted += sorted((names & set(found)) - known)
    return "\n".join(ast.get_source_segment(text, found[name]) or "" for name in sorted(known))


if __name__ == "__main__":
    if sys.argv[1:]:
        stamp(each for each in list_pictures() if any(f"{each}/".startswith(f"{name}/") for name in sys.argv[1:]))
    for picture in find_stale():
        sys.stdout.write(f"{picture}: draw it again, from {', '.join(inputs_of(picture))}\n")
