"""Problems are found by path or name, and every way to miss one has a message that helps."""

import re
from pathlib import Path

import pytest

import koopmpc as km
from tests.apps.tiny import SOURCE, write
from tests.commands import koopmpc


def test_a_bench_runs_five_problems_and_with_all_every_shipped_one(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    ran = []
    monkeypatch.setattr(
        "koopmpc.apps.cli.sweeps._sweep", lambda problems, *_, **__: ran.append([p.name for p in problems])
    )
    for arguments in (["bench"], ["bench", "--all"]):
        assert koopmpc(*arguments).exit_code == 0
    assert ran[0] == ["bilinear_motor", "cart_pole", "cart_pole_swing", "pendulum", "van_der_pol"]
    assert ran[1] == [path.stem for path in km.bench.shipped()]
    assert len(ran[1]) >= 16


@pytest.mark.parametrize("name", ["pendulum", "cart_pole"])
def test_a_name_and_its_path_are_the_same_problem_from_any_folder(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    by_name = km.load_problem(name)
    by_path = km.load_problem(next(path for path in km.bench.shipped() if path.stem == name))
    assert by_name.name == by_path.name == name
    assert by_name.title
    assert by_name.title == by_path.title
    assert by_name.cases.keys() == by_path.cases.keys()


def test_name_and_title_come_from_the_file(tmp_path):
    problem = km.load_problem(write(tmp_path, "basin"))
    assert problem.name == "basin"
    assert problem.title == "Tiny: a leaky tank of one state."


def test_a_file_is_found_before_a_name_and_a_local_problem_before_a_shipped_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "problems", "pendulum")
    assert km.load_problem("pendulum").title.startswith("Tiny")
    assert km.load_problem("problems/pendulum.py").title.startswith("Tiny")
    assert [entry.title[:4] for entry in km.bench.list_problems() if entry.name == "pendulum"] == ["Tiny"]


def test_listing_runs_no_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "problems"
    folder.mkdir()
    (folder / "loud.py").write_text('"""Loud: raises when it runs."""\nraise RuntimeError("ran")\n')
    (folder / "garbled.py").write_text("def (:\n")
    (folder / "_helper.py").write_text("x = 1\n")
    titles = {entry.name: entry.title for entry in km.bench.list_problems()}
    assert titles["loud"] == "Loud: raises when it runs."
    assert "not valid Python" in titles["garbled"]
    assert "_helper" not in titles
    assert {"pendulum", "cart_pole"} <= titles.keys()


def test_one_case_is_chosen_behind_a_colon(tmp_path):
    path = write(tmp_path)
    assert list(km.load_problem(f"{path}:far").cases) == ["far"]
    assert list(km.load_problem(path).cases) == ["near", "far"]
    assert list(km.load_problem("cart_pole:recover").cases) == ["recover"]


def test_the_limits_of_a_case_take_the_place_of_the_problems(tmp_path):
    problem = km.load_problem(write(tmp_path))
    assert float(problem.limits_of("near").inputs(1).high[0]) == 2.0
    assert float(problem.limits_of("far").inputs(1).high[0]) == 1.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pendulun", r"no problem 'pendulun', did you mean 'pendulum'\?; there are .*cart_pole"),
        ("zzz", r"no problem 'zzz'; there are .*, or pass a path"),
        ("cart_pole:recovery", r"'cart_pole' has no case 'recovery', did you mean 'recover'\?; its cases are shift"),
        ("nowhere/plant.py", r"^there is no file nowhere/plant\.py;"),
        (
            r"C:\Users\me\spring.py",
            r"^there is no file C:\\Users\\me\\spring\.py;",
        ),  # the colon of a drive names no case
        ("C:/Users/me/spring.py", r"^there is no file C:/Users/me/spring\.py;"),
    ],
)
def test_what_is_not_found_is_named_with_the_nearest_that_is(text, message):
    with pytest.raises(km.errors.ProblemError, match=message):
        km.load_problem(text)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        # The line is that of the file, even where the library raises.
        ("import koopmpc as km\n\nkm.Limits(u_min=1.0, u_max=-1.0)\n", r", line 3: DataError: input limits cross"),
        ("import sys\n\nsys.exit(3)\n", r", line 3: SystemExit: 3"),
        ("x = 1\ny = (\n", r", line 2: SyntaxError"),
        ("x = 1\n", r" must define `problem = km\.Problem\(\.\.\.\)`, but holds nothing of that name"),
        ("problem = 3\n", r" must define `problem = km\.Problem\(\.\.\.\)`, but holds an int"),
    ],
)
def test_a_file_that_gives_no_problem_is_named_with_its_line_and_cause(tmp_path, source, message):
    path = tmp_path / "broken.py"
    path.write_text(source)
    with pytest.raises(km.errors.ProblemError, match=rf"broken\.py{message}"):
        km.load_problem(path)


def test_a_folder_is_said_to_be_one(tmp_path):
    path = write(tmp_path)
    with pytest.raises(km.errors.ProblemError, match="is a folder; pass the path of one problem file: ") as caught:
        km.load_problem(tmp_path)
    assert str(caught.value).endswith(str(path))
    (tmp_path / "empty").mkdir()
    with pytest.raises(km.errors.ProblemError, match=r"is a folder; .*there is none in it"):
        km.load_problem(tmp_path / "empty")


def test_a_file_that_raises_gives_file_line_and_cause(tmp_path):
    path = write(tmp_path, **{"horizon=5": "horizon=1 // 0"})
    line = SOURCE.split("\n").index("    horizon=5,") + 1
    with pytest.raises(km.errors.ProblemError) as caught:
        km.load_problem(path)
    assert re.search(r"tiny\.py, line \d+: ZeroDivisionError", str(caught.value))
    assert int(re.search(r"line (\d+)", str(caught.value))[1]) in range(line - 15, line + 1)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_two_files_of_one_name_do_not_meet(tmp_path):
    first = km.load_problem(write(tmp_path / "a"))
    second = km.load_problem(write(tmp_path / "b", **{"horizon=5": "horizon=6"}))
    assert (first.horizon, second.horizon) == (5, 6)
    assert type(first.dynamics) is not type(second.dynamics)


def test_a_new_problem_is_the_documented_one_and_is_never_overwritten(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = km.bench.new_problem("mine")
    text = (Path(__file__).parents[2] / "docs" / "problems.md").read_text()
    assert path == Path("mine.py")
    assert f"```python\n{path.read_text()}```" in text  # which the tests of the documentation run
    assert km.load_problem("mine.py").name == "mine"
    path.write_text("kept")
    with pytest.raises(km.KoopmpcError, match="exists already and is kept as it is"):
        km.bench.new_problem("mine.py")
    assert path.read_text() == "kept"
    with pytest.raises(km.KoopmpcError, match="'my-plant' is not a name for a problem"):
        km.bench.new_problem("my-plant")
