"""Problems are found by path or name, and every way to miss one has a message that helps."""

import re

import numpy as np
import pytest

import koopmpc as km
from tests.bench.tiny import SOURCE, write


def test_the_shipped_problems_are_two_plants_and_their_swing_ups():
    names = ["cart_pole", "cart_pole_swing", "pendulum", "pendulum_swing"]
    assert [path.stem for path in km.bench.shipped()] == names


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
    assert "no valid Python" in titles["garbled"]
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


def test_an_unknown_name_suggests_the_nearest_and_lists_what_there_is():
    with pytest.raises(
        km.errors.ProblemError, match=r"no problem 'pendulun', did you mean 'pendulum'\?; there are .*cart_pole"
    ):
        km.load_problem("pendulun")
    with pytest.raises(km.errors.ProblemError, match=r"no problem 'zzz'; there are .*, or pass a path"):
        km.load_problem("zzz")


def test_an_unknown_case_suggests_the_nearest():
    with pytest.raises(
        km.errors.ProblemError,
        match=r"'cart_pole' has no case 'recovery', did you mean 'recover'\?; its cases are shift, recover",
    ):
        km.load_problem("cart_pole:recovery")


@pytest.mark.parametrize("text", [r"C:\Users\me\spring.py", "C:/Users/me/spring.py"])
def test_the_colon_of_a_drive_is_none_of_a_case(text):
    with pytest.raises(km.errors.ProblemError) as caught:
        km.load_problem(text)
    assert str(caught.value).startswith(f"there is no file {text};")


def test_a_folder_is_said_to_be_one(tmp_path):
    path = write(tmp_path)
    with pytest.raises(km.errors.ProblemError, match="is a folder; pass the path of one problem file: ") as caught:
        km.load_problem(tmp_path)
    assert str(caught.value).endswith(str(path))
    (tmp_path / "empty").mkdir()
    with pytest.raises(km.errors.ProblemError, match=r"is a folder; .*there is none in it"):
        km.load_problem(tmp_path / "empty")


def test_a_missing_file_is_named():
    with pytest.raises(km.errors.ProblemError, match=r"there is no file nowhere/plant\.py"):
        km.load_problem("nowhere/plant.py")


def test_a_file_that_raises_gives_file_line_and_cause(tmp_path):
    path = write(tmp_path, **{"horizon=5": "horizon=1 // 0"})
    line = SOURCE.split("\n").index("    horizon=5,") + 1
    with pytest.raises(km.errors.ProblemError) as caught:
        km.load_problem(path)
    assert re.search(r"tiny\.py, line \d+: ZeroDivisionError", str(caught.value))
    assert int(re.search(r"line (\d+)", str(caught.value))[1]) in range(line - 15, line + 1)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_the_line_is_the_files_own_where_the_library_raises(tmp_path):
    path = tmp_path / "deep.py"
    path.write_text("import koopmpc as km\n\nlimits = km.Limits(u_min=1.0, u_max=-1.0)\n")
    with pytest.raises(km.errors.ProblemError, match=r"deep\.py, line 3: DataError: input limits cross"):
        km.load_problem(path)


def test_a_file_that_exits_is_an_error_like_any_other(tmp_path):
    path = tmp_path / "quitter.py"
    path.write_text("import sys\n\nsys.exit(3)\n")
    with pytest.raises(km.errors.ProblemError, match=r"quitter\.py, line 3: SystemExit: 3"):
        km.load_problem(path)


def test_a_syntax_error_has_its_line(tmp_path):
    path = tmp_path / "broken.py"
    path.write_text("x = 1\ny = (\n")
    with pytest.raises(km.errors.ProblemError, match=r"broken\.py, line 2: SyntaxError"):
        km.load_problem(path)


@pytest.mark.parametrize(("text", "got"), [("x = 1\n", "nothing of that name"), ("problem = 3\n", "a int")])
def test_a_file_without_a_problem_says_what_is_missing(tmp_path, text, got):
    path = tmp_path / "empty.py"
    path.write_text(text)
    with pytest.raises(
        km.errors.ProblemError, match=rf"must define `problem = km\.Problem\(\.\.\.\)`, but holds {got}"
    ):
        km.load_problem(path)


def test_two_files_of_one_name_do_not_meet(tmp_path):
    first = km.load_problem(write(tmp_path / "a"))
    second = km.load_problem(write(tmp_path / "b", **{"horizon=5": "horizon=6"}))
    assert (first.horizon, second.horizon) == (5, 6)
    assert type(first.dynamics) is not type(second.dynamics)


def test_a_loaded_problem_holds_checked_arrays(tmp_path):
    problem = km.load_problem(write(tmp_path))
    x, u = problem.equilibrium
    assert x.dtype == u.dtype == np.float64
