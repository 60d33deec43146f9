"""The law of a log: load_run(record(run)) is run, to the bit; its description is exact data and a page to read."""

import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings

import koopmpc as km
from tests.control.models import step_map
from tests.views.logged import Logged
from tests.views.runs import make_run, options


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(some=options)
@example(some={"nx": 1, "nu": 2, "T": 1, "N": None, "cost": False, "limits": False})
@example(some={"nx": 5, "T": 3, "odd": 1.0})
def test_a_log_reads_back_to_the_bit(some: dict[str, Any], tmp_path: Path) -> None:
    run = make_run(**some)
    km.record(run, tmp_path / "run.rrd")
    assert km.load_run(tmp_path / "run.rrd") == run


def test_a_log_without_the_solvers_of_its_steps_reads_as_before(tmp_path: Path) -> None:
    """Logs of before have no such column, and neither has one whose steps asked no solver."""
    run = replace(make_run(), solver=())
    km.record(run, tmp_path / "run.rrd")
    assert "solver/qp" not in Logged(tmp_path / "run.rrd").entities
    assert km.load_run(tmp_path / "run.rrd") == run
    assert km.metrics(run).solver == {}


def test_a_run_whose_scene_fails_costs_no_line_of_rerun(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A Ctrl-C while a run is drawn is one line of text, and so is an error."""

    def scene(x: np.ndarray, u: np.ndarray) -> list[km.scene.Disk]:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        km.record(make_run(), tmp_path / "run.rrd", scene=scene)
    km.record(make_run(), tmp_path / "next.rrd")  # Rerun now lets go of the recording before
    assert (capfd.readouterr().err, list(tmp_path.iterdir())) == ("", [tmp_path / "next.rrd"])


@pytest.mark.slow
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(some=options)
def test_many_logs_read_back_to_the_bit(some: dict[str, Any], tmp_path: Path) -> None:
    run = make_run(**some)
    km.record(run, tmp_path / "run.rrd")
    assert km.load_run(tmp_path / "run.rrd") == run


def test_the_scene_and_hidden_states_leave_the_run_as_it_was(tmp_path: Path) -> None:
    def scene(x: np.ndarray, u: np.ndarray) -> list[km.scene.Line | km.scene.Box | km.scene.Disk]:
        at = (float(x[0]), float(u[0]))
        return [
            km.scene.Line("a line/of names", [(0.0, 0.0), at]),
            km.scene.Box("box", at, (1.0, 2.0), float(x[1])),
            km.scene.Disk("disk", at, 0.1),
        ]

    run = make_run()
    hidden = replace(run, X=np.full_like(run.X, np.nan))
    broken = replace(run, X=np.where(np.arange(21)[:, None] == 7, np.nan, run.X))
    for i, some in enumerate((run, hidden, broken)):
        km.record(some, tmp_path / f"{i}.rrd", scene=scene)
        assert km.load_run(tmp_path / f"{i}.rrd") == some


@pytest.mark.parametrize("ahead", [False, True])
def test_a_scene_whose_shapes_change_is_refused(ahead: bool, tmp_path: Path) -> None:
    run = make_run(N=3 if ahead else None)
    odd = float(run.plans.X[7, -1, 0] if run.plans is not None else run.X[7, 0])

    def scene(x: np.ndarray, u: np.ndarray) -> list[km.scene.Disk]:
        bob, lamp = km.scene.Disk("bob", (0.0, 0.0), 1.0), km.scene.Disk("lamp", (0.0, 0.0), 1.0)
        return [bob, lamp] if x[0] == odd else [bob]

    with pytest.raises(km.errors.DataError, match="the scene of step 7 has a new shape 'lamp'"):
        km.record(run, tmp_path / "run.rrd", scene=scene)


def test_plans_of_a_model_of_the_outputs_are_recorded_and_drawn_where_the_plant_has_such_a_state(
    tmp_path: Path,
) -> None:
    """The plant has two states and measures one: its plans have one column, by the name of that output."""
    A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    whole, x = step_map(A, B), ca.SX.sym("x", 2)
    hidden = km.StepMap(whole.F, whole.dt, ca.Function("h", [x], [x[1]]), ("x0", "x1"), ("u0",), ("x1",))
    model = km.LinearPredictor(A[1:, 1:], B[1:], np.eye(1), km.State().bind(("x1",)), 0.1, ("x1",), ("u0",))
    mpc = km.KoopmanMPC(model, km.Cost(1, 0.1), km.Limits(-1, 1), 5)
    run = km.simulate(hidden, mpc, x0=[0.3, 0.5], reference=[0.0], steps=12, options=km.loop.LoopOptions(plans=True))
    assert run.plans.X.shape == (12, 6, 1)
    for name, scene in (("plain", None), ("drawn", lambda x, u: [km.scene.Disk("bob", (float(x[0]), 0.0), 1.0)])):
        km.record(run, tmp_path / f"{name}.rrd", scene=scene)
        assert km.load_run(tmp_path / f"{name}.rrd") == run
        log = Logged(tmp_path / f"{name}.rrd")
        at, seen = log.matrix("plots/1/ahead/3")
        np.testing.assert_array_equal(seen[:, 0], run.plans.X[at - 3, 3, 0])
        assert not log.rows("plots/0/ahead/3")[0]


def test_each_plan_is_drawn_whole_across_the_blocks_of_a_log(tmp_path: Path) -> None:
    run = make_run(T=230, N=3)
    assert run.plans is not None
    run.plans.U[[7, 114], 1] = np.nan  # what is missing of one plan leaves nothing out of the others
    run.plans.X[[9, 114], 1] = np.nan
    km.record(run, tmp_path / "run.rrd")
    log = Logged(tmp_path / "run.rrd")
    for j in (1, 2, 3):
        drawn = [log.matrix(f"plots/{name}/ahead/{j}") for name in (0, 1, "u")]
        assert [at.tolist() for at, _ in drawn] == [list(range(j, 231))] * 3
        first = slice(231 - j)
        np.testing.assert_array_equal(np.hstack([drawn[i][1] for i in (0, 1)]), run.plans.X[first, j])
        np.testing.assert_array_equal(drawn[2][1], run.plans.U[first, min(j, 2)])


def test_what_is_kept_of_a_move_is_what_the_move_has(tmp_path: Path) -> None:
    """Every field of a Move but u is a column of the run that `simulate` returns, and of the log of that run."""
    told = {
        "status": km.Status.SOFTENED,
        "fallback": km.control.Fallback.HOLD,
        "solve_time": 0.25,
        "iterations": 7,
        "slack": 0.5,
        "solver": "daqp",
        "known": True,
        "refused": True,
        "actor": "manual",
        "gap": 0.125,
    }
    assert {field.name for field in fields(km.Move)} == {"u", *told}

    class Telling:
        dt, nu, horizon = 0.1, 1, 0

        def reset(self, x0: Any = None, u_prev: Any = None) -> None: ...

        def __call__(self, y: Any, reference: Any, applied: Any = None) -> km.Move:
            return km.Move(np.zeros(1), **told)

    plant = step_map(np.eye(2), np.ones((2, 1)))
    run = km.simulate(plant, Telling(), x0=[0, 0], reference=[0, 0], steps=3)
    km.record(run, tmp_path / "run.rrd")
    for each in (run, km.load_run(tmp_path / "run.rrd")):
        assert {name: list(getattr(each, name)) for name in told} == {name: [value] * 3 for name, value in told.items()}


def test_metrics_are_recomputed_from_the_log_alone(tmp_path: Path) -> None:
    run = replace(make_run(N=None), limits=None)
    km.record(run, tmp_path / "new folder" / "run.rrd")
    assert km.metrics(km.load_run(tmp_path / "new folder" / "run.rrd")) == km.metrics(run)


def test_an_autonomous_run_has_no_inputs_to_read(tmp_path: Path) -> None:
    none = np.empty((20, 0))
    run = replace(make_run(cost=False, limits=False, N=None), U=none, u_reference=none, inputs=())
    km.record(run, tmp_path / "run.rrd")
    assert km.load_run(tmp_path / "run.rrd") == run


def test_logs_of_one_problem_share_the_application_but_no_recording(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    run = make_run(metadata={"problem": "cart pole"})
    entries = []
    for name in ("a.rrd", "b.rrd"):
        km.record(run, tmp_path / name)
        entries += RrdReader(tmp_path / name).recordings()
    assert {entry.application_id for entry in entries} == {"koopmpc-cart_pole"}
    assert len({entry.recording_id for entry in entries}) == 2


def test_a_log_opens_as_the_episode_of_its_run(tmp_path: Path) -> None:
    run = make_run(T=12)
    km.record(run, tmp_path / "run.rrd")
    read = km.load_episodes(tmp_path / "run.rrd")
    assert (read.dt, read.states, read.inputs) == (run.dt, run.states, run.inputs)
    assert np.array_equal(read[0].X, run.X)
    assert np.array_equal(read[0].U, run.U)


def test_a_log_is_read_by_a_process_that_has_recorded_nothing(tmp_path: Path) -> None:
    km.record(make_run(T=12), tmp_path / "run.rrd")
    code = f"import koopmpc as km; print(len(km.load_episodes({str(tmp_path / 'run.rrd')!r})[0].U))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "12\n"


def test_metadata_that_is_no_data_is_refused_before_a_file_is_made(tmp_path: Path) -> None:
    with pytest.raises(km.errors.DataError, match="a function cannot be saved as data; use numbers, names and arrays"):
        km.record(make_run(metadata={"controller": make_run}), tmp_path / "run.rrd")
    assert not (tmp_path / "run.rrd").exists()


@pytest.mark.parametrize("seed", range(3))
def test_what_is_only_for_people_who_look_is_in_the_log_as_well(tmp_path: Path, seed: int) -> None:
    run = make_run(T=12, nu=2, seed=seed)
    km.record(run, tmp_path / "run.rrd")
    log = Logged(tmp_path / "run.rrd")
    ends, deadline = log.matrix("solver/deadline_ms")
    assert ends.tolist() == [0, 12]
    assert deadline == pytest.approx(1e3 * run.dt)
    ends, limits = log.matrix("control/limits")
    assert ends.tolist() == [0, 12]
    np.testing.assert_array_equal(limits, np.tile(run.limits.inputs(2).high, (2, 1)))  # no low limit is finite
    pairs = list(zip(run.status, run.fallback, strict=True))
    begun = [
        k for k in range(12) if pairs[k][1] is not km.control.Fallback.NONE and (not k or pairs[k] != pairs[k - 1])
    ]
    steps, texts = log.rows("log", "text")
    assert steps == begun
    words = [run.fallback[k].name.lower().replace("_", " ") for k in begun]
    assert [text.split(":")[0] for (text,) in texts] == [f"step {k}" for k in begun]
    assert [text.split("then ")[1] for (text,) in texts] == words


def test_a_log_draws_the_plants_scene_the_controllers_eigenvalues_and_the_reference_unasked(tmp_path: Path) -> None:
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, 0.05)
    model = km.LinearPredictor.local(plant, [0, 0], [0])
    mpc = km.KoopmanMPC(model, problem.cost, problem.limits, 10)
    run = km.simulate(
        plant,
        mpc,
        x0=[0.4, 0],
        reference=[0.2, 0],
        steps=12,
        cost=problem.cost,
        options=km.loop.LoopOptions(plans=True),
    )
    km.record(run, tmp_path / "run.rrd")
    log = Logged(tmp_path / "run.rrd")
    assert {"world/bob", "world/reference/bob", "world/prediction/bob", "model/eigenvalues"} <= log.entities
    bob = np.array(log.rows("world/reference/bob", "strips")[1], dtype=float)
    assert bob.reshape(-1, 2).mean(axis=0) == pytest.approx([2 * np.sin(0.2), -2 * np.cos(0.2)], abs=1e-3)
    assert log.static("title", "text") == ["**theta, omega · KoopmanMPC**"]
    for j in (1, 10):  # at the cursor, the dots j steps ahead are the current plan's
        at, theta = log.matrix(f"plots/0/ahead/{j}")
        assert run.plans is not None
        assert theta[:, 0] == pytest.approx(run.plans.X[at - j, j, 0])
        assert at[-1] == run.steps
    assert km.load_run(tmp_path / "run.rrd") == run


def test_the_description_says_what_ran_and_with_what_in_signs_that_the_viewer_has(tmp_path: Path) -> None:
    told = {
        "problem": "pendulum",
        "case": "upright",
        "controller": "lqr",
        "seed": 7,
        "versions": {"casadi": "9.9"},
        "noted": "Uᵀ𝜓 ∈ ℝ, θ̇ ≤ 10⁻⁴, 位置 😀",
    }
    km.record(make_run(metadata=told), tmp_path / "run.rrd")
    (page,) = Logged(tmp_path / "run.rrd").static("description", "text")
    assert page.startswith("# pendulum · upright · lqr")
    signs = "U^Tψ  in  R, θ̇ ≤ 10⁻⁴, ?? ?"  # of those that its font lacks, other spellings
    for part in ("| seed | 7 |", "casadi 9.9", "| u_max | [", "state 0 [m]", "written with", "rerun-sdk 0.41"):
        assert part in page
    assert signs in page


def test_a_run_has_a_title_of_its_own(tmp_path: Path) -> None:
    problem = {"title": "Pendulum: driven upright.", "problem": "pendulum", "case": "hang", "controller": "lqr"}
    for told, title in (({"title": "bench 3, new valve"}, "bench 3, new valve"), (problem, "pendulum · hang · lqr")):
        km.record(make_run(metadata=told), tmp_path / "run.rrd")
        assert Logged(tmp_path / "run.rrd").static("title", "text") == [f"**{title}**"]


def test_an_angle_that_is_tracked_by_its_sine_and_cosine_is_drawn_where_it_is(tmp_path: Path) -> None:
    angles = np.linspace(-3, 3, 13)
    aims = np.column_stack([np.sin(angles), np.cos(angles)])
    aims[0] = 2.0, 0.0  # no angle has such a sine
    cost = km.Cost(Q=[1, 1], R=1, of=km.Fourier(1, states=[0]))
    run = replace(make_run(T=12, N=None, limits=False), reference=aims, cost=cost)
    km.record(run, tmp_path / "run.rrd", scene=lambda x, u: [km.scene.Disk("a", (np.cos(x[0]), np.sin(x[0])), 0.1)])
    at, strips = Logged(tmp_path / "run.rrd").rows("world/reference/a", "strips")
    assert at == list(range(1, 13))
    x, y = np.array([np.mean(strip[0], axis=0) for strip in strips]).T
    np.testing.assert_allclose(np.exp(1j * np.arctan2(-y, x)), np.exp(1j * angles[1:]), atol=1e-3)
