"""koopmpc check --new: whether a design still holds for the plant of new logs."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import koopmpc as km
from koopmpc.apps.cli.app import app
from koopmpc.apps.fitting.changed import compare_logs, read_new_logs
from koopmpc.models.base import load_value
from koopmpc.synthesis.designed import SavedDesign
from koopmpc.validate import find_drift
from tests.apps.mass import NAMES, A, B, logs


def record(gain=1.0, seed=5, sigma=1e-3):
    rng, X = np.random.default_rng(seed), [np.zeros(2)]
    U = np.repeat(rng.uniform(-1.5, 1.5, (75, 1)), 4, axis=0)
    for u in U:
        X.append(A @ X[-1] + gain * B @ u)
    return km.Episodes([km.Episode(X=np.array(X) + sigma * rng.standard_normal((301, 2)), U=U)], 0.1, *NAMES)


@pytest.fixture(scope="module")
def old():
    noisy = logs()
    rng = np.random.default_rng(0)
    return noisy.with_episodes([km.Episode(X=e.X + 1e-3 * rng.standard_normal(e.X.shape), U=e.U) for e in noisy])


def test_a_design_holds_on_the_same_plant_and_where_its_runs_bear_the_change(old):
    assert compare_logs(old, record(), ()).holds
    weak = record(gain=0.82)
    report = compare_logs(old, weak, ()).report
    assert ("the gain of force", "input") in {(one.name, one.kind) for one in report.changes}
    borne = compare_logs(old, weak, ("inputs 20 % weaker",))  # the kind of change decides, not its words
    assert borne.holds is all(one.kind == "input" for one in report.changes)
    assert compare_logs(old, weak, ()).holds is False
    assert "design again" in compare_logs(old, weak, ()).sentence


def test_a_design_that_bears_what_alone_changed_holds(old, monkeypatch):
    weak = record(gain=0.82)
    report = find_drift(old, weak)
    gain = [one for one in report.changes if one.kind == "input"]
    monkeypatch.setattr("koopmpc.apps.fitting.changed.find_drift", lambda *logs: replace(report, changes=tuple(gain)))
    held = compare_logs(old, weak, ("inputs 20 % weaker",))
    assert held.holds
    assert "keeps its goal with such inputs" in held.sentence
    assert compare_logs(old, weak, ("inputs 20 % stronger",)).holds is False


@pytest.mark.slow
def test_the_command_compares_new_logs_with_those_of_the_design(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = load_value(made.controller, SavedDesign).evidence.logs
    assert (kept.states, kept.inputs) == NAMES
    record(gain=0.5, sigma=0.0).save(tmp_path / "new.npz")
    assert read_new_logs(made.controller, [tmp_path / "new.npz"]).nu == 1
    result = CliRunner().invoke(app, ["check", str(made.controller), "--runs", "1", "--new", "new.npz"])
    assert result.exit_code == 1
    assert "the plant has changed" in " ".join(result.output.split())
    km.Episodes(list(record()), 0.1).save(tmp_path / "other.npz")
    refused = CliRunner().invoke(app, ["check", str(made.controller), "--new", "other.npz"])
    assert refused.exit_code == 2
    assert "pass logs with these columns" in " ".join((refused.output + refused.stderr).split())


def test_a_design_without_its_logs_cannot_be_compared():
    with pytest.raises(km.errors.DataError, match="saved without its logs"):
        compare_logs(None, record(), ())
