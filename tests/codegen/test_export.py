"""`km.export`: a folder that builds with every warning an error, runs clean, and closes the loop as Python does."""

import re
import shutil
import subprocess
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.codegen import plants
from tests.codegen.test_parity import KINDS
from tests.commands import koopmpc
from tests.compiler import find_compiler
from tests.control.models import Told
from tests.control.test_levels import draw_model
from tests.faults.damage import room_for
from tests.tiers import few

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
    done = koopmpc("export", str(tmp_path / "c.npz"), "--out", str(tmp_path / "c"), "--problem", "pendulum:hold")
    assert done.exit_code == 0, done.output
    assert "plant_step" in (tmp_path / "c" / "plant.c").read_text()


def test_a_bench_in_c_says_of_each_controller_whether_it_was(tmp_path):
    kinds = ["-c", "koopman-mpc", "-c", "nonlinear-mpc"]
    done = koopmpc("bench", "pendulum:upright", *kinds, "--compiled", "--logs", str(tmp_path))
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


STRICT = ["limits in time, rates", "price", "limits in time, learned", "bilinear, limits in time, soft rates", "tank"]


@pytest.mark.parametrize("name", few(STRICT, STRICT[0], STRICT[3]))
def test_the_c_of_other_kinds_has_no_warning(name, tmp_path):
    folder = km.export(KINDS[name](np.random.default_rng(0)).controller, tmp_path / "c")
    done = make(folder, "strict", f"CC={' '.join(find_compiler() or ())}")
    assert done.returncode == 0, done.stderr[:2000]


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "float"])
def test_the_folder_of_a_bilinear_mpc_builds_without_a_warning_and_runs_clean(tmp_path, precision):
    plant, model = plants.make_swung()
    limits = km.Limits(-8.0, 8.0, du_max=3.0, x_max=[2.0, 1.5])
    controller = km.BilinearMPC(model, COST, limits, 12, latency=1, estimator=km.LiftedDisturbance())
    rows = np.column_stack([np.linspace(0.0, 0.3, 40), np.zeros(40)])
    folder = km.export(controller, tmp_path / "c", precision=precision, plant=plant, x0=[0.8, 0], reference=rows)
    strict = [["strict", f"CC={compiler}"] for compiler in ("gcc", "clang") if shutil.which(compiler)]
    for words in (*strict, ["sanitize"]):
        done = make(folder, *words)
        assert done.returncode == 0, done.stderr[:2000]
    x, acting, close = np.array([0.8, 0.0]), np.zeros(1), 1e-5 if precision == "double" else 1e-2
    controller.reset()
    for k, row in enumerate(table(make(folder, "run", QUICKLY).stdout)[:60]):
        move = controller(x, rows[min(k, 39) :])
        np.testing.assert_allclose(row[1:3], x, atol=close)
        np.testing.assert_allclose(row[3], move.u, atol=10 * close)
        x, acting = plant(x, acting), move.u
    assert "Any other row may come at run time" in (folder / "README.md").read_text()


DRIVER = r"""
#include <stdio.h>
#include "koopmpc.h"
static koopmpc_state s;
int main(void) {
  static double y[KOOPMPC_NY], rows[1000], applied[KOOPMPC_NU], count, acts;
  koopmpc_init(&s, 0, 0);
  while (scanf("%lf", &count) == 1) {
    koopmpc_real u[KOOPMPC_NU];
    koopmpc_report report;
    const koopmpc_rows reference = {rows, (int)count};
    for (int i = 0; i < KOOPMPC_NY; i++) scanf("%lf", y + i);
    for (int i = 0; i < (int)count * KOOPMPC_NR; i++) scanf("%lf", rows + i);
    scanf("%lf", &acts);
    for (int i = 0; i < KOOPMPC_NU; i++) scanf("%lf", applied + i);
    koopmpc_step(&s, y, &reference, acts > 0 ? applied : 0, 0, u, &report);
    for (int i = 0; i < KOOPMPC_NU; i++) printf("%.17g ", u[i]);
    printf("%d %d\n", (int)report.status, (int)report.fallback);
  }
  return 0;
}
"""


SEARCHED = {
    "bilinear": 0.8, "swing up": 0.3, "bilinear, rates": 0.2, "bilinear, learned": 0.4, "bilinear, given inputs": 0.3,
    "bilinear, weighed end": 0.6, "bilinear, soft": 0.9, "equations": 0.8, "bilinear, late": 0.5,
    "bilinear, no tail": 0.7, "bilinear, soft rates": 0.3,
}  # fmt: skip


@pytest.mark.parametrize("name", few(SEARCHED, "bilinear, rates"))
def test_a_reference_row_that_was_not_exported_is_found_at_run_time(name, tmp_path):
    case, reach, rng = KINDS[name](np.random.default_rng(0)), SEARCHED[name], np.random.default_rng(5)
    features = name == "swing up"
    known = [[0.0, 1.0, 0.0]] if features else [[0.0, 0.0], [-0.1, 0.0]]
    folder = km.export(case.controller, tmp_path / "c", reference=known)
    (tmp_path / "main.c").write_text(DRIVER)
    command = [*find_compiler(), "-std=c99", "-O1", "-Ic", *map(str, folder.glob("koopmpc_*.c")), "main.c", "-lm"]
    subprocess.run([*command, "-o", "main"], cwd=tmp_path, check=True)
    x, lines, moves = np.array([0.3, 0.0]), [], []
    for k in range(40):
        at = k // 5 if case.rows == 1 else k + np.arange(case.rows)
        angles = np.ravel(np.round(reach * np.sin(0.13 * at), 3))
        still = np.zeros(len(angles))
        rows = np.column_stack([np.sin(angles), np.cos(angles), still] if features else [angles, still])
        y, applied = x + rng.normal(0, 0.002, 2), None if k % 3 else rng.uniform(-2, 2, 1)
        moves.append(move := case.controller(y, rows, applied))
        told = [len(rows), *y, *np.ravel(rows), applied is not None, *(np.zeros(1) if applied is None else applied)]
        lines.append(" ".join(repr(float(number)) for number in told))
        x = np.array(case.step(x, move.u))
    printed = subprocess.run([tmp_path / "main"], input="\n".join(lines), capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in printed.stdout.splitlines()], dtype=float)
    assert found[:, 1].astype(int).tolist() == [move.status.value for move in moves]
    off = np.abs(found[:, 0] - [move.u[0] for move in moves]) / 16
    assert np.quantile(off, 0.9) <= 1e-6
    assert off.max() <= 1e-5
    assert {"OPTIMAL", "UNCONSTRAINED", "SOFTENED"} & {move.status.name for move in moves}


def test_each_registered_kind_is_exported_or_says_why_not():
    shipped = {kind.controller for kind in km.control.list_kinds().values()}
    exported = {km.LQR, km.KoopmanMPC, km.LinearMPC, km.BilinearMPC}
    refused = {km.NonlinearMPC, km.supervise.Adaptive, km.supervise.Guarded, km.supervise.Station}
    refused |= {km.control.PID, km.control.EigenfunctionLQR}
    others = {km.guarantees.CertifiedFeedback}  # tests/guarantees exports it
    own = {kind for kind in shipped if kind.__module__.startswith("koopmpc.")}
    assert exported | refused | others == own | {km.LinearMPC}  # which is saved as the KoopmanMPC that it is


def test_each_kind_without_c_code_says_why(pendulum, tmp_path):
    plant, model = pendulum
    bilinear, limits = plants.make_swung()[1], km.Limits(-8.0, 8.0)
    data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=5, steps=20, rng=0)
    energy = km.Expressions(lambda x: [x[1] ** 2], ["E"]).bind(plant.states)
    feedback, watched = km.LQR(model, COST, limits), km.KoopmanMPC(model, COST, limits, 5, monitor=data)
    online = km.OnlineEDMD.start(data, model.lifting)
    implicit = km.discretize(km.load_problem("pendulum").dynamics, 0.05, km.plants.Collocation(2))
    some, levels = draw_model(np.random.default_rng(0), 2), km.Limits(levels=[[0, 1], None])
    own = km.KoopmanMPC(model, COST, limits, 5, estimator=Told([0.0] * model.nz))
    crowded = km.Limits(x_max=0.3, of=km.State(), y_max=0.2, priority=[0, 1, 2, 3])
    refused = {
        r"a NonlinearMPC cannot be exported: it uses ipopt or a CasADi solver.*; export a KoopmanMPC": km.NonlinearMPC(
            plant, COST, limits, 5
        ),
        "its model changes while it runs": km.supervise.Adaptive(km.KoopmanMPC(model, COST, limits, 5), online),
        "a Guarded.*it holds several controllers": km.supervise.Guarded(watched, feedback),
        "it holds several controllers": km.supervise.Station(watched, feedback),
        "levels.*; export one whose": km.KoopmanMPC(model, COST, km.Limits(levels=[[-8, 0, 8]], level_steps=2), 5),
        "only some of its inputs or steps": km.KoopmanMPC(some, km.Cost(Q=1.0, R=0.1), levels, 5),
        "stage of its own": km.BilinearMPC(bilinear, replace(COST, stage=lambda x, u: x[0] ** 2), limits, 5),
        "price.*; export one without": km.BilinearMPC(bilinear, replace(COST, price=[0.1]), limits, 5),
        "koopmpc has no C code for its law": km.control.EigenfunctionLQR(
            energy, km.Cost(Q=1, R=1, of=energy), dt=0.05, B=[[0], [1]], eigenvalue=0.0
        ),
        "time_limit, and C has no clock.*iter_limit": km.KoopmanMPC(model, COST, limits, 5, time_limit=1.0),
        "C has no clock.*sqp_iterations": km.BilinearMPC(bilinear, COST, limits, 5, time_limit=1.0),
        r"implicit integrator .* discretize with RK4": km.BilinearMPC(implicit, COST, limits, 5),
        "the estimator Told cannot be written in C; use": own,
        "can tell 3 apart": km.KoopmanMPC(plants.make_pair()[0], km.Cost(Q=[1, 0.5], R=0.05), crowded, 6),
    }
    for sentence, controller in refused.items():
        with pytest.raises(km.errors.DataError, match=sentence) as refusal:
            km.compiled(controller)
        with pytest.raises(km.errors.DataError) as error:
            km.export(controller, tmp_path / "c")
        assert str(error.value) == str(refusal.value)
        assert str(error.value).count("export ") <= 1  # one remedy
        assert f"export a {type(controller).__name__}" not in str(error.value)  # which was refused
        assert "C code cannot be generated" not in str(error.value)  # it begins with that
        assert not (tmp_path / "c").exists()
