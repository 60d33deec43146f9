"""Records that cannot be fitted, or only in part: each ends in a sentence or a note, and a file of before still reads."""

import re

import numpy as np
import pytest
from typer.testing import CliRunner

import koopmpc as km
from koopmpc.apps.cli.app import app
from koopmpc.apps.fitting.logs import read_logs


def write(path, rows=1200, **columns):
    """Write a record of a first-order plant; `columns` replace or add some."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, rows // 10 + 1), 10)[:rows]
    y = np.zeros(rows)
    for k in range(rows - 1):
        y[k + 1] = 0.9 * y[k] + 0.1 * u[k]
    table = {"t [s]": 0.1 * np.arange(rows), "valve": u, "y": y + 1e-3 * rng.standard_normal(rows)} | columns
    text = "\n".join(",".join(f"{v:.10g}" for v in row) for row in np.column_stack([*table.values()]))
    path.write_text(",".join(table) + "\n" + text + "\n")
    return path


def refusal(*arguments):
    """Return what `koopmpc fit` says where it stops; it ends with a code above zero and without a traceback."""
    result = CliRunner().invoke(app, ["fit", *map(str, arguments)])
    assert result.exit_code > 0
    assert isinstance(result.exception, SystemExit)
    return re.sub(r"[\s│]+", " ", result.output)


def read(path, **options):
    return read_logs(path, None, np.random.default_rng(0), 10**9, options)


def test_an_input_that_never_moves_is_named_and_nothing_is_fitted_without_inputs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refusal(write(tmp_path / "a.csv", valve=np.full(1200, 7.0)))
    assert "no input moves: valve is 7 throughout, so what it does cannot be learned" in said
    assert not (tmp_path / "logs").exists() or not list((tmp_path / "logs").rglob("model.npz"))


def test_an_output_that_never_moves_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "no state moves: y are constant" in refusal(write(tmp_path / "a.csv", y=np.full(1200, 3.0)))


def test_a_short_record_is_told_how_long_it_must_be(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refusal(write(tmp_path / "a.csv", rows=180))
    need = int(re.search(r"so (\d+) in all", said).group(1))
    with pytest.raises(km.errors.DataError, match="in all"):
        read(write(tmp_path / "b.csv", rows=need - 20))
    assert len(read(write(tmp_path / "c.csv", rows=need + 1)).held_out) >= 2


def test_a_column_that_repeats_another_is_left_out_with_a_note(tmp_path):
    path = write(tmp_path / "a.csv")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    table = np.hstack([table, table[:, 2:]])
    path.write_text("t [s],valve,y,y2\n" + "\n".join(",".join(map(repr, row)) for row in table.tolist()) + "\n")
    found = read(path)
    assert found.seen.states == ("y",)
    assert any("y2 repeats y" in note for note in found.notes)


def test_a_gap_of_missing_readings_ends_in_a_note_and_the_other_rows_stay(tmp_path):
    path = write(tmp_path / "a.csv", rows=2400)
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    rows = [",".join(map(repr, row)) for row in table.tolist()]
    rows[700:740] = [f"{row[0]!r},{row[1]!r}," for row in table[700:740].tolist()]
    path.write_text("t [s],valve,y\n" + "\n".join(rows) + "\n")
    found = read(path)
    assert any(re.search(r"row|gap|missing|empty", note) for note in found.notes)
    assert sum(map(len, found.fitted)) > 2200


def test_rows_at_both_rails_are_told_and_kept_unless_models_gain(tmp_path):
    path = write(tmp_path / "a.csv")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    low, high = np.quantile(table[:, 2], [0.15, 0.85])
    found = read(write(path, y=np.clip(table[:, 2], low, high)))
    notes = " ".join(found.notes)
    assert "limit" in notes or "saturat" in notes
    assert sum(map(len, found.fitted)) > 600


def test_a_model_file_without_the_new_fields_still_reads(tmp_path):
    rng = np.random.default_rng(0)
    data = km.Episodes(
        [km.Episode(X=rng.standard_normal((300, 1)), U=rng.standard_normal((299, 1)))], 0.1, ["y"], ["u"]
    )
    model = km.edmd(data, km.State() + km.Constant())
    model.save(tmp_path / "new.npz")
    with np.load(tmp_path / "new.npz", allow_pickle=False) as file:
        arrays = dict(file)
    kept = {key: value for key, value in arrays.items() if "input_lead" not in key and "rails" not in key}
    np.savez(tmp_path / "old.npz", **kept)
    old = km.load_model(tmp_path / "old.npz")
    assert old.input_lead == 0
    assert np.array_equal(old.A, model.A)
