"""koopmpc fit: from logs of an unknown plant to a model file, a report, pictures and a Rerun log."""

import contextlib
import importlib
import re
import subprocess
import sys
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests import tiers
from tests.apps.tiny import write
from tests.commands import koopmpc


@dataclass(frozen=True)
class HangingCartPole(km.Dynamics):
    """A cart of 1 kg with friction, and a pole of 0.5 m with 0.2 kg at its tip, hanging at θ = 0."""

    states = ("x", "theta", "v", "omega")
    inputs = ("force",)

    def rhs(self, x, u):
        S, C, omega = ca.sin(x[1]), ca.cos(x[1]), x[3]
        a = (u[0] - 0.3 * x[2] + 0.2 * S * (0.5 * omega**2 + 9.81 * C)) / (1 + 0.2 * S**2)
        return ca.vertcat(x[2], omega, a, -(a * C + 9.81 * S) / 0.5 - 0.05 * omega)


def cart_pole(episodes, steps=40, rng=0):
    start = km.Uniform([-0.5, -1.5, -0.5, -2], [0.5, 1.5, 0.5, 2])
    plant = km.discretize(HangingCartPole(), 0.02)
    return km.collect(plant, start, km.Noise(-4, 4, hold=5), episodes=episodes, steps=steps, rng=rng)


def write_csv(data: km.Episodes, folder, header="time [s],x,theta,v,omega,force"):
    folder.mkdir(exist_ok=True)
    for i, e in enumerate(data):
        rows = np.column_stack([np.arange(len(e.X)) * data.dt, e.X, np.vstack([e.U, e.U[-1:]])])
        np.savetxt(folder / f"{i:02d}.csv", rows, delimiter=",", header=header, comments="", fmt="%.9g")
    return folder


@pytest.fixture
def few(monkeypatch):
    """Let a selection try three models only, and no hidden states."""

    def usual(episodes, _, bilinear, *__):
        base = km.State() + km.Constant()
        tried = [
            km.synthesis.Candidate("x, 1", base),
            km.synthesis.Candidate("squares", base + km.State() * km.State()),
        ]
        tried += [km.synthesis.Candidate("squares", tried[1].lifting, bilinear=True)] * bilinear
        return [one.bind(episodes.states, episodes.inputs) for one in tried]

    monkeypatch.setattr("koopmpc.synthesis.search.candidates.propose_candidates", usual)
    monkeypatch.setattr("koopmpc.synthesis.search.records.DELAYS", (0, 1))
    monkeypatch.setattr("koopmpc.synthesis.search.prepare.is_late", lambda _: False)
    monkeypatch.setattr("koopmpc.synthesis.select.judge_hidden_states", lambda *_, **__: [])


@pytest.fixture
def quick(few, monkeypatch):
    """Draw and record nothing either."""
    monkeypatch.setattr("koopmpc.apps.fitting.fit.list_pictures", lambda *_: [])
    monkeypatch.setattr("koopmpc.apps.fitting.fit.record_model", lambda *_, **__: None)


def fit(place, *arguments):
    """Return the folder that `koopmpc fit` wrote, and what it printed."""
    result = koopmpc("fit", *arguments, "--logs", place / "logs")
    assert result.exit_code == 0, result.output
    (folder,) = (place / "logs").iterdir()
    return folder, result.stdout


@pytest.fixture
def made(monkeypatch):
    """What the steps of a fit return to it, by name: the parts of the data, and the models that are chosen."""
    found, room = {}, importlib.import_module("koopmpc.apps.fitting.fit")

    def kept(name, step):
        return lambda *given, **how: found.setdefault(name, step(*given, **how))

    for name in ("read_logs", "select"):
        monkeypatch.setattr(room, name, kept(name, getattr(room, name)))
    return found


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Return the folder of one call without any option, what it printed, and fresh data of the same plant."""
    place = tmp_path_factory.mktemp("fit")
    write_csv(cart_pole(18, steps=60), place / "csv")
    with contextlib.chdir(place), pytest.MonkeyPatch.context() as patch:
        patch.setitem(importlib.import_module("koopmpc.views.figures.style")._RC, "savefig.dpi", 50.0)
        result = koopmpc("fit", "csv")
    assert result.exit_code == 0, result.stderr
    (folder,) = (place / "logs").iterdir()
    return folder, result, cart_pole(12, steps=60, rng=1)


def test_csv_logs_of_an_unknown_plant_give_a_predictor_without_any_option(fitted):
    """At the horizon its errors on fresh data are below those of the plain linear fit, half as large on average."""
    folder, result, fresh = fitted
    names = {path.name for path in folder.iterdir()}
    assert {"model.npz", "report.md", "model.rrd", "spectrum.png", "error.png", "rollout-0.png"} <= names
    usage = result.stdout.split("use it:\n")[1]
    held: dict = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder.parents[1])
        exec(usage, held)  # what is printed runs as it stands
    model = held["model"]
    plain = km.edmd(cart_pole(18, steps=60), km.State() + km.Constant(), ridge=1e-9)
    horizon = int(re.search(r"horizon (\d+) steps", result.stdout).group(1))
    assert horizon >= 10
    lifted = isinstance(model, km.BilinearPredictor)  # as its controller does
    share = km.score(model, fresh, horizon, relift=lifted).rmse[-1] / km.score(plain, fresh, horizon).rmse[-1]
    assert share.max() < 1
    assert share.mean() < 0.5


def test_it_prints_what_it_understood_the_leaderboard_and_the_verdict(fitted):
    folder, result, _ = fitted
    out = result.stdout
    assert "18 episodes of 60 steps, 1080 in all" in out
    assert "dt = 0.02 s" in out
    assert re.search(r"states +x .*\n +theta .*\n +v .*\n +omega .*\ninputs +force", out)
    assert "linear: x, 1 " in out
    assert re.search(r"^(DO NOT )?TRUST", out, re.MULTILINE)
    assert re.search(r"over that of the plain linear fit.*:\n  x [\d.]+, theta", out)
    assert re.search(r"look at it: .*koopmpc view .*model\.rrd", out)
    page = (folder / "report.md").read_text()
    assert re.match(r"# Model report\s+(DO NOT )?TRUST", page)
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", page):
        assert (folder / picture).exists()
    assert page.count("![") == 5
    assert out.split("use it:\n")[1].strip() in page


def test_the_model_is_read_in_a_process_that_never_saw_its_lifting(fitted):
    folder, result, _ = fitted
    usage = result.stdout.split("use it:\n")[1] + "print(model.nz)"
    done = subprocess.run(
        [sys.executable, "-c", usage], cwd=folder.parents[1], capture_output=True, text=True, check=False
    )
    assert int(done.stdout) > 5, done.stderr


@pytest.mark.usefixtures("quick")
def test_the_report_is_of_episodes_that_no_fit_saw(tmp_path, made):
    rng, episodes = np.random.default_rng(0), []
    for _ in range(20):
        X, U = [rng.uniform(-1, 1, 2)], rng.uniform(-1, 1, (80, 1))
        for (u,) in U:
            a, b = X[-1]
            X.append(np.array([0.9 * a + 0.1 * b, 0.9 * b - 0.1 * a + 0.4 * u * a + 0.1 * u]))
        episodes.append(km.Episode(X=X, U=U))
    data = km.Episodes(episodes, 0.1)
    data.save(tmp_path / "data.npz")
    folder, said = fit(tmp_path, tmp_path / "data.npz", "--horizon", "10")
    assert "held out  6 episodes" in said
    held = {e.X.tobytes() for e in made["read_logs"].held_out}
    assert len(held) == 6
    assert held < {e.X.tobytes() for e in data}
    assert km.load_model(folder / "model.npz") == made["select"].predictor
    assert km.load_model(folder / "linear.npz") == made["select"].linear
    assert made["select"].predictor.report.samples == 14 * 80
    assert "What could not be made" not in (folder / "report.md").read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_what_memory_does_not_hold_is_fitted_part_by_part_on_processes(tmp_path, monkeypatch, made):
    monkeypatch.setattr("koopmpc.data.files.folder._PART", 1)
    data = cart_pole(24)
    for i in range(12):
        data[2 * i : 2 * i + 2].save(tmp_path / "in" / f"{i:02d}.npz")
    monkeypatch.setattr("koopmpc.apps.fitting.logs.IN_MEMORY", 1000)
    folder, said = fit(tmp_path, tmp_path / "in", "--horizon", "10", "--workers", "2", "--linear")
    assert "read in 12 parts: 1 of them is held out" in said
    model, best = km.load_model(folder / "model.npz"), made["select"].best
    assert model.report.samples == 22 * 40
    held = {e.X.tobytes() for e in made["read_logs"].held_out}
    rest = data.with_episodes([e for e in data if e.X.tobytes() not in held])
    assert len(rest) == 22
    again = km.edmd(rest, best.lifting, ridge=best.ridge, towards="affine")
    assert pytest.approx(again.A, abs=1e-6) == model.A


@pytest.mark.usefixtures("quick")
def test_the_end_of_one_long_log_is_held_out_and_that_is_said(tmp_path, made):
    data = cart_pole(1, steps=500)
    write_csv(data, tmp_path / "csv")
    _, said = fit(tmp_path, tmp_path / "csv" / "00.csv", "--horizon", "10", "--linear")
    assert re.search(r"the last fifth of the record is held out, in \d+ blocks", said)
    assert len(made["read_logs"].held_out) >= 4
    assert np.allclose(np.concatenate([e.X[:-1] for e in made["read_logs"].held_out]), data[0].X[400:-1])


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("memory", tiers.few([10**9, 1000], 1000))
def test_columns_that_say_nothing_are_left_out_and_wrapped_angles_unwrapped_and_that_is_said(
    tmp_path, monkeypatch, memory, made
):
    monkeypatch.setattr("koopmpc.data.files.folder._PART", 1)
    for i, e in enumerate(cart_pole(24)):
        turning = e.X[:, 1] + 0.1 * np.arange(len(e.X))
        wrapped = (turning + np.pi) % (2 * np.pi) - np.pi
        rest, ones = e.X[:, [0, 2, 3]], np.ones(len(e.X))
        X = np.column_stack([rest, wrapped, 7 * ones, rest[:, 0]])
        names = ["x", "v", "omega", "theta", "temp", "again"]
        U = np.column_stack([e.U, np.zeros(len(e))])
        km.Episodes([km.Episode(X=X, U=U)], 0.02, names, ["force", "brake"]).save(tmp_path / "in" / f"{i:02d}.npz")
    monkeypatch.setattr("koopmpc.apps.fitting.logs.IN_MEMORY", memory)
    folder, said = fit(tmp_path, tmp_path / "in", "--horizon", "10", "--linear")
    for words in ("left out: temp is 7 throughout", "left out: again repeats x", "left out: brake is 0 through"):
        assert f"! {words}" in said
    assert re.search(r"! theta jumped by 2π \d+ times and was unwrapped", said)
    model = km.load_model(folder / "model.npz")
    assert (model.states, model.inputs) == (("x", "v", "omega", "theta"), ("force",))
    assert max(np.abs(np.diff(e.X[:, 3])).max() for e in made["read_logs"].held_out) < 1.0


@pytest.mark.usefixtures("quick")
def test_a_folder_of_runs_is_data_though_their_table_is_in_it(tmp_path):
    problem = km.load_problem(write(tmp_path))
    km.sweep([problem], ["lqr"], folder=tmp_path / "runs")
    assert (tmp_path / "runs" / "results.parquet").exists()
    folder, said = fit(tmp_path, tmp_path / "runs", "--horizon", "1")
    assert "2 files" in said
    assert km.load_model(folder / "model.npz").states == problem.dynamics.states


@pytest.mark.usefixtures("quick")
def test_gaps_are_told(tmp_path):
    folder = write_csv(cart_pole(16), tmp_path / "csv")
    lines = (folder / "03.csv").read_text().splitlines()
    (folder / "03.csv").write_text("\n".join(lines[:20] + lines[25:]) + "\n")
    _, said = fit(tmp_path, folder, "--horizon", "10")
    assert re.search(r"! .*03\.csv.*gap", said)


@pytest.mark.usefixtures("few")
def test_a_picture_or_a_log_that_fails_costs_neither_model_nor_report(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise RuntimeError("no ink")

    monkeypatch.setattr("koopmpc.apps.fitting.fit.record_model", fails)
    monkeypatch.setattr("koopmpc.apps.fitting.fit.spectrum", fails)
    write_csv(cart_pole(16), tmp_path / "csv")
    monkeypatch.chdir(tmp_path)
    result = koopmpc("fit", "csv", "--horizon", "10", "--linear")
    assert result.exit_code == 0, result.output
    (folder,) = (tmp_path / "logs").iterdir()
    assert km.load_model(folder / "model.npz").nu == 1
    assert "not made: spectrum.png: RuntimeError: no ink" in result.stderr
    assert "model.rrd: RuntimeError: no ink" in (folder / "report.md").read_text()
    assert "look at it" not in result.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "nowhere does not exist"),
        (["empty"], "or .rrd file: it holds"),
        (["csv", "--states", "x,speed"], "has no column 'speed'"),
        (["csv", "--horizon", "500"], "pass a shorter --horizon"),
        (["csv", "--horizon", "0"], "--horizon is 0"),
        (["csv", "--dt", "-1"], "--dt is -1"),
        (["csv", "--resample", "0"], "--resample is 0"),
        (["nowhere", "--name", "../x"], "--name is '../x', and ends the name of one folder"),
        (["nowhere", "--name", ""], "--name is '', and ends the name of one folder"),
        (["csv/00.csv", "text.csv"], "text.csv"),
        (["nowhere", "--workers", "0"], "--workers is 0"),
        (["nowhere", "--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], "leave out --workers 2"),
        (["nowhere", "--scheduler", "here"], "--scheduler is 'here'"),
        (["csv/00.csv", "csv/00.csv"], "csv/00.csv is given twice"),
        (
            ["told.csv"],
            'its columns are a, b, c; pass --inputs with those that drive the plant, or --inputs "" if noth',
        ),
        (["bare.dat"], "or --inputs with the numbers of the columns that are inputs, 1 to 3"),
        (["bare.dat", "--columns", "t,u"], "has 3 columns, --columns gives 2 names"),
    ],
)
@pytest.mark.usefixtures("quick")
def test_a_mistake_gives_one_message_and_exit_code_2(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    write_csv(cart_pole(14, steps=30), tmp_path / "csv")
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.csv").write_text("a,b\nyes,no\n")
    rows = np.random.default_rng(0).normal(size=(400, 3))
    np.savetxt(tmp_path / "bare.dat", rows)
    np.savetxt(tmp_path / "told.csv", np.c_[0.1 * np.arange(400), rows], delimiter=",", header="t,a,b,c", comments="")
    result = koopmpc("fit", *arguments)
    assert result.exit_code == 2, result.output
    assert words in result.stderr
    assert "Traceback" not in result.output
    assert result.stderr.count(words) == 1
    assert not list(tmp_path.glob("logs/*"))  # no empty folder is left behind


def test_states_and_inputs_may_be_told(tmp_path, monkeypatch, quick):
    monkeypatch.chdir(tmp_path)
    write_csv(cart_pole(16), tmp_path / "csv", header="when,p,q,r,s,push")
    arguments = ["--states", "p, q,r,s", "--inputs", "push", "--dt", "0.02", "--linear", "--name", "cart"]
    result = koopmpc("fit", "csv", *arguments)
    assert result.exit_code == 0, result.output
    (folder,) = (tmp_path / "logs").iterdir()
    assert folder.name.endswith("-cart")
    model = km.load_model(folder / "model.npz")
    assert (model.states, model.inputs, model.dt) == (("p", "q", "r", "s"), ("push",), 0.02)


@pytest.mark.usefixtures("quick")
def test_what_files_have_in_common_is_said_once_and_no_column_of_one_file_is_judged(tmp_path):
    for i, e in enumerate(cart_pole(24)):
        lines = ["time [s],x,theta,v,omega,load,force"]
        for k, row in enumerate(e.X):
            push = e.U[min(k, len(e) - 1), 0] if k != 9 or i % 2 else np.nan  # a gap at row 10 of half of them
            cells = [0.02 * k, *row, float(i), push]
            lines.append(",".join("" if np.isnan(c) else repr(float(c)) for c in cells))
        (tmp_path / f"{i:02d}.csv").write_text("\n".join(lines))
    folder, said = fit(tmp_path, tmp_path, "--horizon", "10", "--linear")
    (gaps,) = [line for line in said.splitlines() if " gap" in line]
    every_other = ", ".join(f"{i:02d}.csv" for i in range(2, 24, 2))
    assert gaps.startswith(f"! 12 files ({tmp_path / '00.csv'}, {every_other}): 1 gap (after line 11)")
    assert "throughout" not in said  # load is constant in each file, and not over all of them
    assert "load" in km.load_model(folder / "model.npz").states


@pytest.mark.usefixtures("quick")
def test_logs_are_audited_and_what_is_safe_is_done_and_said(tmp_path, made):
    """Spikes are left out, a late input widens the past that models may see, and a clock that jitters is evened."""
    episodes, data = [], cart_pole(20, steps=80)
    for e in data:
        X, U = e.X[:-3].copy(), e.U[3:]  # the force acts three steps late
        X[30, 1] += 40
        episodes.append(km.Episode(X=X, U=U))
    (tmp_path / "in").mkdir()
    data.with_episodes(episodes).save(tmp_path / "in" / "late.npz")
    _, said = fit(tmp_path, tmp_path / "in", "--horizon", "10", "--linear")
    assert re.search(r"! spikes: theta leaves its path and returns, 20 times: .*these rows were left out", said, re.S)
    assert re.search(r"! input delay: force acts 3 steps late; models that see 3 steps of the past are", said)
    assert max(np.abs(e.X[:, 1]).max() for e in made["read_logs"].held_out) < 20
    assert made["read_logs"].delay == 3


@pytest.mark.usefixtures("quick")
def test_a_clock_that_jitters_is_evened_and_that_is_said(tmp_path):
    data, rng = cart_pole(16), np.random.default_rng(0)
    (tmp_path / "csv").mkdir()
    for i, e in enumerate(data):
        time = (np.arange(len(e.X)) + rng.uniform(-0.1, 0.1, len(e.X))) * 0.02
        rows = np.column_stack([time, e.X, np.vstack([e.U, e.U[-1:]])])
        np.savetxt(
            tmp_path / "csv" / f"{i:02d}.csv", rows, delimiter=",", header="time [s],x,theta,v,omega,force", comments=""
        )
    _, said = fit(tmp_path, tmp_path / "csv", "--horizon", "10", "--linear")
    unequal = r"sampling is unequal in 16 files, interpolated to 0\.0\d+ s; steps that differ by more than 2 %: "
    assert re.search(unequal + r"\S*00\.csv \(\d+ of 40, from line \d+\), 01\.csv \(", " ".join(said.split()))
    with pytest.raises(km.errors.DataError, match="sampling is unequal"):
        km.load_episodes(tmp_path / "csv" / "00.csv")
