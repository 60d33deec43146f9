"""docs/design.md shows the house as it is: its rooms in the order of imports, and files that exist."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
HOUSE = ROOT / "koopmpc"
TEXT = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
BETWEEN_TICKS = re.compile(r"`([^`]+)`")


def table(heading: str) -> list[list[str]]:
    """Return the cells of the rows of the table with this heading in its first column."""
    lines = TEXT.partition(f"| {heading} |")[2].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_the_rooms_are_all_there_in_the_order_of_imports() -> None:
    named = [name.rstrip("/") for room, *_ in table("room") for name in BETWEEN_TICKS.findall(room)]
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    layers = contracts[0]["layers"]
    place = {name: i for i, name in enumerate(reversed(layers))}
    top = [name for name in named if "/" not in name]
    assert set(top) == set(layers)
    rooms = [name for name in top if (HOUSE / name).is_dir()]
    assert rooms == sorted(rooms, key=place.__getitem__)
    for name in named:
        assert (HOUSE / name).is_dir() or (HOUSE / f"{name}.py").is_file(), name


def test_each_idea_is_in_a_file_that_exists() -> None:
    rows = table("idea")
    assert len(rows) >= 10
    for idea, place in rows:
        paths = [name for name in BETWEEN_TICKS.findall(place) if name.endswith((".py", "/"))]
        assert paths, idea
        for path in paths:
            known = [base / path for base in (HOUSE, ROOT)]
            assert any(found.exists() for found in known), f"{idea}: {path}"
