"""`km.export`: a folder that builds with every warning an error, runs clean, and closes the loop as Python does."""

import re
import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest
from typer.testing import CliRunner

import koopmpc as km
from koopmpc.apps.cli.app import app
from tests.faults.damage import room_for

COST = km.Cost(Q=[10.0, 1.0], R=0.1)
LIMITS = km.Limits(u_min=-25.0, u_max=25.0, x_min=[-0.5, -1.0], x_max=[0.5, 1.0], du_max=20.0)
QUICKLY = "CFLAGS=-O0"
HEAP = {"malloc", "calloc", "realloc", "free", "fopen", "printf", "time", "clock"}


@pytest.fixture(scope="module")
def exported(pendulum, tmp_path_factory):
    """A controller with soft limits, rates, latency and an estimator, and its folder."""
    plant, model = pendulum
    controller = km.KoopmanMPC(
        model, COST, LIMITS, 15, solver="daqp", latency=1, estimator=km.LiftedDisturbance(), moves=10
    )
    folder = tmp_path_factory.mktemp("c") / "controller"
    return plant, controller, km.export(controller, folder, plant=plant, x0=[0.7, 0.0], reference=[0.1, 0.0], steps=80)


def make(folder, *words):
    return subprocess.run(["make", "-s", *words], cwd=folder, capture_output=True, text=True)


def table(printed):
    return np.array([[float(word) for word in line.split(",")] for line in printed.splitlines()[1:]])


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_our_files_build_with_every_warning_an_error(exported, compiler):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not here")
    done = make(exported[2], "strict", f"CC={compiler}")
    assert done.returncode == 0, done.stderr[:2000]


def test_a_controller_without_limits_has_no_function_that_nothing_calls(pendulum, tmp_path):
    """Of syntax alone, as in `strict`, a compiler does not say so."""
    mpc = km.KoopmanMPC(pendulum[1], COST, None, 15, solver="daqp", estimator=km.LiftedDisturbance())
    done = make(km.export(mpc, tmp_path / "c"), "koopmpc_condensed.o", "CFLAGS=-O0 -Wall -Werror")
    assert done.returncode == 0, done.stderr[:2000]


def test_the_example_closes_the_loop_as_python_does_with_inputs_that_act_late(exported):
    plant, controller, folder = exported
    done = make(folder, "run", QUICKLY)
    assert done.returncode == 0, done.stderr[:2000]
    rows = table(done.stdout)
    controller.reset()
    x, acting = np.array([0.7, 0.0]), np.zeros(1)
    for row in rows:
        move = controller(x, [0.1, 0.0])
        np.testing.assert_allclose(row[1:3], x, atol=1e-6)
        np.testing.assert_allclose(row[3], move.u, atol=1e-5)
        assert int(row[4]) == move.status.value
        x, acting = plant(x, acting), move.u


def test_the_example_of_a_model_with_delays_starts_as_if_its_state_had_been_held(pendulum, tmp_path):
    plant, _ = pendulum
    data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=40, steps=30, rng=0)
    model = km.edmd(data, km.State(), embedding=km.Delay(2))
    controller = km.KoopmanMPC(model, COST, km.Limits(u_min=2.0, u_max=25.0), 10, solver="daqp")
    folder = km.export(controller, tmp_path / "c", x0=[0.3, -0.2], reference=[0.1, 0.0], steps=3)
    rows = table(make(folder, "run", QUICKLY).stdout)
    np.testing.assert_allclose(rows[0, 1:9], [0.3, -0.2, 2.0, 0.3, -0.2, 2.0, 0.3, -0.2], rtol=1e-8)
    x = model.step_map()(rows[0, 1:9], rows[0, 9:10])
    np.testing.assert_allclose(rows[1, 1:9], x, rtol=1e-6)


def test_no_object_calls_the_heap_a_file_or_a_clock(exported):
    folder = exported[2]
    # Tables that hold addresses are written once by the loader, unless the code stands where it was linked for.
    assert make(folder, "clean").returncode == 0
    assert make(folder, "libkoopmpc.a", "CFLAGS=-O2 -fno-pic").returncode == 0
    printed = subprocess.run(["nm", "libkoopmpc.a"], cwd=folder, capture_output=True, text=True, check=True).stdout
    asked = {line.split()[-1] for line in printed.splitlines() if line.strip().startswith("U ")}
    assert asked
    assert not HEAP & asked
    kinds = {line.split()[-2] for line in printed.splitlines() if len(line.split()) == 3}
    assert "T" in kinds
    assert not kinds & set("DdBbC")


def test_the_example_runs_clean_under_the_sanitizers(exported):
    done = make(exported[2], "sanitize")
    assert done.returncode == 0, done.stderr[:2000]


def test_the_folder_may_be_written_again_but_not_over_other_files(exported, tmp_path):
    controller = exported[1]
    folder = km.export(controller, tmp_path / "c")
    assert km.export(controller, folder) == folder
    tmp_path = tmp_path / "other"
    tmp_path.mkdir()
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(km.errors.DataError, match=r"holds thesis.tex, which no export wrote"):
        km.export(controller, tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "mine"
    with pytest.raises(km.errors.DataError, match="is a file; pass a folder"):
        km.export(controller, tmp_path / "thesis.tex")


def test_the_readme_states_sizes(exported):
    text = (exported[2] / "README.md").read_text()
    assert "RAM: one `koopmpc_state`" in text
    (share,) = re.findall(r"change of an input by rounding in double precision, at most \| (\S+) % of its range", text)
    assert 0 < float(share) < 1e-8
    assert "DAQP" in text
    assert "(a" not in (exported[2] / "koopmpc_sizes.h").read_text()


def test_a_plant_of_another_size_is_refused(exported):
    _, controller, folder = exported
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    other = km.StepMap(ca.Function("F", [x, u], [x]), 0.05)
    with pytest.raises(km.errors.DataError, match="the plant has 2 inputs, the controller 1"):
        km.export(controller, folder, plant=other)


def test_single_precision_warns_where_rounding_moves_the_input(pendulum, tmp_path):
    model = pendulum[1]
    narrow = km.LQR(model, km.Cost(Q=[1e9, 1.0], R=1e-6), km.Limits(u_min=-1e-3, u_max=1e-3))
    with pytest.warns(UserWarning, match=r"single precision rounding may move an input by .* % of its span"):
        km.export(narrow, tmp_path / "f", precision="float")


def test_a_saved_controller_is_exported_from_the_shell(exported, tmp_path):
    exported[1].save(tmp_path / "c.npz")
    arguments = ["export", str(tmp_path / "c.npz"), "--out", str(tmp_path / "c"), "--problem", "pendulum:hold"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "plant_step" in (tmp_path / "c" / "plant.c").read_text()


def test_a_bench_in_c_says_of_each_controller_whether_it_was(tmp_path):
    arguments = ["bench", "pendulum:upright", "-c", "koopman-mpc", "-c", "nonlinear-mpc", "--compiled"]
    done = CliRunner().invoke(app, [*arguments, "--logs", str(tmp_path)])
    assert done.exit_code == 0, done.output
    runs = {path.stem.split("-", 2)[2]: km.load_run(path) for path in tmp_path.rglob("*.rrd")}
    assert runs["koopman-mpc"].metadata["compiled"] is True
    assert runs["nonlinear-mpc"].metadata["compiled"] is False


def test_two_controllers_link_into_one_program(pendulum, tmp_path):
    plant, model = pendulum
    made = {
        "pitch": km.KoopmanMPC(model, COST, LIMITS, 10, solver="daqp"),
        "yaw": km.KoopmanMPC(model, km.Cost(Q=[1.0, 1.0], R=0.5), km.Limits(-9.0, 9.0), 5, solver="daqp"),
        "roll": km.BilinearMPC(plant, COST, km.Limits(-25.0, 25.0), 6),
    }
    for name, controller in made.items():
        km.export(controller, tmp_path / name, name=name, precision="float" if name == "yaw" else "double")
    calls = "".join(
        f"  {{{name}_real y[2] = {{0.5, 0}}, r[2] = {{0, 0}}, u[1]; {name}_rows rows = {{r, 1}};\n"
        f'   {name}_init(&{name}, 0, 0); {name}_step(&{name}, y, &rows, 0, 0, u, 0); printf("%.9g\\n", (double)u[0]); }}\n'
        for name in made
    )
    heads = "".join(f'#include "{name}/{name}.h"\nstatic {name}_state {name};\n' for name in made)
    (tmp_path / "main.c").write_text(f"#include <stdio.h>\n{heads}int main(void) {{\n{calls}  return 0;\n}}\n")
    sources = [str(file) for name in made for file in (tmp_path / name).glob(f"{name}_*.c")]
    subprocess.run(["cc", "-std=c99", *sources, "main.c", "-lm", "-o", "main"], cwd=tmp_path, check=True)
    printed = subprocess.run([str(tmp_path / "main")], capture_output=True, text=True, check=True).stdout
    for said, controller in zip(printed.split(), made.values(), strict=True):
        np.testing.assert_allclose(float(said), controller([0.5, 0.0], [0.0, 0.0]).u, rtol=1e-4)
    with pytest.raises(km.errors.DataError, match="name is 'Yaw 1'; pass one of lower-case letters"):
        km.export(made["yaw"], tmp_path / "other", name="Yaw 1")


def test_cmake_builds_it(exported, tmp_path):
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not here")
    folder = km.export(exported[1], tmp_path / "c", plant=exported[0], steps=80)
    for words in (["-S", str(folder), "-B", "build"], ["--build", "build"]):
        done = subprocess.run(["cmake", *words], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, (done.stdout + done.stderr)[-2000:]
    printed = subprocess.run([str(tmp_path / "build" / "example")], capture_output=True, text=True, check=True).stdout
    assert len(table(printed)) == 80


def test_a_full_disk_is_told_in_one_sentence(exported, tmp_path):
    with room_for(2000), pytest.raises(km.errors.FullDiskError, match=r"cannot be written: File too large"):
        km.export(exported[1], tmp_path / "c")
