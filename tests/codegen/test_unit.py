"""Controllers as Functional Mock-up Units: km.export(…, fmu=…)."""

import subprocess
import zipfile

import numpy as np
import pytest

import koopmpc as km
from tests.codegen import plants
from tests.commands import koopmpc
from tests.compiler import find_compiler, needs_compiler
from tests.tiers import few

fmpy = pytest.importorskip("fmpy", reason="the extra fmu is not installed")
pytestmark = needs_compiler

COST, LIMITS = km.Cost(Q=[10, 1], R=0.1), km.Limits(-12, 12)


class Unit:
    """A unit as another program sees it, called through FMPy alone."""

    def __init__(self, path, x0=None):
        self.description = fmpy.read_model_description(str(path))
        assert fmpy.validation.validate_fmu(str(path)) == []
        self.refs = {v.name: v.valueReference for v in self.description.modelVariables}
        self.slave = fmpy.instantiate_fmu(fmpy.extract(str(path)), self.description, "CoSimulation")
        self.is_two = self.description.fmiVersion == "2.0"
        if self.is_two:
            self.slave.setupExperiment(startTime=0.0)
        if x0 is not None:
            self.set("x0", x0)
        self.slave.enterInitializationMode()
        self.slave.exitInitializationMode()

    def group(self, name):
        return [ref for word, ref in self.refs.items() if word.startswith(f"{name}.")]

    def set(self, name, values):
        (self.slave.setReal if self.is_two else self.slave.setFloat64)(self.group(name), list(values))

    def step(self, k, dt, y, reference, w=None):
        self.set("y", y)
        self.set("reference", reference)
        if w is not None:
            self.set("w", w)
        self.slave.doStep(k * dt, dt)
        whole = [self.refs[name] for name in ("status", "fallback", "iterations")]
        u = (self.slave.getReal if self.is_two else self.slave.getFloat64)(self.group("u"))
        return np.array(u), (self.slave.getInteger if self.is_two else self.slave.getInt32)(whole)


def controllers(pendulum):
    plant, model = pendulum
    yield "feedback", km.LQR(model, COST), 2
    yield "condensed", km.KoopmanMPC(model, COST, LIMITS, horizon=20, solver="daqp"), 2
    local = km.LinearMPC(plant, [0, 0], [0], COST, km.Limits(-6, 6, du_max=3), horizon=15)
    yield "rates", local, 2
    yield (
        "filter",
        km.KoopmanMPC(model, COST, LIMITS, 20, solver="daqp", estimator=km.LiftedKalman(["theta", "omega"])),
        2,
    )
    yield (
        "pushed",
        km.KoopmanMPC(
            plants.make_cart()[1], km.Cost(Q=[10, 1], R=[0.1, 0.2]), km.Limits(-1, 1), horizon=8, solver="daqp"
        ),
        2,
    )


@pytest.mark.parametrize("version", few([2, 3], 3))
def test_a_closed_loop_with_the_unit_is_that_with_the_controller(version, pendulum, tmp_path):
    plant, rows = pendulum[0], np.repeat([[0.0, 0.0], [0.3, 0.0]], 12, axis=0)
    rng, seen = np.random.default_rng(0), set()
    for name, mpc, nx in controllers(pendulum):
        km.export(mpc, tmp_path / name, fmu=version)
        x = np.array([0.6, 0.0])
        unit = Unit(tmp_path / name / "koopmpc.fmu", x)
        mpc.reset(x)
        for k, row in enumerate(rows):
            y, w = x + 1e-3 * rng.normal(size=nx), rng.normal(size=1) if name == "pushed" else None
            move = mpc(y, row, w=w)
            u, (status, fallback, _) = unit.step(k, mpc.dt, y, row, w)
            assert u == pytest.approx(move.u, abs=1e-9), (name, k)
            assert (list(km.Status)[status], fallback) == (move.status, 0), (name, k)
            seen.add(move.status)
            x = plant(x, u[:1])
    assert {km.Status.UNCONSTRAINED, km.Status.OPTIMAL} <= seen


@pytest.mark.parametrize("version", few([2, 3], 2))
def test_a_bilinear_unit_takes_any_reference(version, pendulum, tmp_path):
    plant = pendulum[0]
    data = km.collect(plant, km.Uniform([-1, -2], [1, 2]), km.Noise(-6, 6), episodes=30, steps=20)
    model = km.bilinear_edmd(data, km.State() + km.Fourier(1, states=[0]), difference=True)
    mpc = km.BilinearMPC(model, COST, LIMITS, horizon=8)
    km.export(mpc, tmp_path, name="arm", fmu=version)
    unit, x, rng = Unit(tmp_path / "arm.fmu"), np.array([0.5, 0.0]), np.random.default_rng(2)
    for k in range(20):
        row = np.array([rng.uniform(-0.6, 0.6), 0.0]) if k % 4 == 0 else row
        move = mpc(x, row)
        u, (status, fallback, _) = unit.step(k, mpc.dt, x, row)
        assert u == pytest.approx(move.u, abs=1e-9)
        assert (list(km.Status)[status], fallback) == (move.status, 0)
        x = plant(x, u)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unit")
    plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    km.LinearMPC(plant, [0, 0], [0], COST, LIMITS, horizon=10).save(folder / "controller.npz")
    words = ["export", str(folder / "controller.npz"), "--out", str(folder / "c"), "--name", "arm", "--fmu", "2"]
    return folder, koopmpc(*words, "--reference", "0.3, 0; 0, 0")


def test_a_unit_of_version_2_that_is_none_is_an_error_and_not_a_crash(exported):
    library = Unit(exported[0] / "c" / "arm.fmu").slave.dll
    for name in ("fmi2EnterInitializationMode", "fmi2Terminate"):
        assert getattr(library, name)(None) == 3  # fmi2Error


def test_the_command_writes_the_unit_with_names_units_and_sources(exported):
    folder, printed = exported
    assert "arm.fmu: the controller as a co-simulation unit, FMI 2" in printed.output.replace("\n", "")
    unit = Unit(folder / "c" / "arm.fmu")
    variables = {v.name: v for v in unit.description.modelVariables}
    assert list(variables)[:5] == ["y.theta", "y.omega", "reference.theta", "reference.omega", "x0.theta"]
    assert (variables["y.theta"].unit, variables["u.torque"].causality) == ("rad", "output")
    assert unit.description.defaultExperiment.stepSize == "0.05"
    with zipfile.ZipFile(folder / "c" / "arm.fmu") as archive:
        text = archive.read("sources/arm.c").decode()
        assert "koopmpc_" not in text
        (folder / "arm.c").write_text(text)
        assert "Daniel Arnstr" in archive.read("documentation/licenses/daqp.txt").decode()
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-Wno-unused-parameter"]
    subprocess.run([*find_compiler(), *strict, str(folder / "arm.c")], check=True)
    assert "plant_reference[4] = {\n  0.3, 0.0, 0.0, 0.0," in (folder / "c" / "plant.c").read_text()


def test_a_step_of_another_length_is_discarded_and_a_reset_starts_again(exported):
    unit = Unit(exported[0] / "c" / "arm.fmu")
    first = unit.step(0, 0.05, [0.4, 0.0], [0.0, 0.0])[0]
    with pytest.raises(fmpy.fmi1.FMICallException, match="discard"):
        unit.slave.doStep(0.05, 0.1)
    unit.step(1, 0.05, [0.1, 0.0], [0.0, 0.0])
    unit.slave.reset()
    unit.slave.enterInitializationMode()
    unit.slave.exitInitializationMode()
    assert unit.step(0, 0.05, [0.4, 0.0], [0.0, 0.0])[0].tolist() == first.tolist()


def test_without_a_compiler_the_unit_holds_sources_and_says_so(tmp_path, pendulum, monkeypatch):
    monkeypatch.setattr("koopmpc.codegen.unit.find_compiler", lambda: None)
    with pytest.warns(km.errors.SourcesOnlyWarning, match="sources only"):
        km.export(km.LQR(pendulum[1], COST), tmp_path, fmu=3)
    with pytest.raises(km.KoopmpcError, match=r"no binary for x86_64-linux; compile its C sources"):
        km.plants.fmu(tmp_path / "koopmpc.fmu")
    with pytest.raises(km.KoopmpcError, match="fmu is 1; pass 2 or 3"):
        km.export(km.LQR(pendulum[1], COST), tmp_path, fmu=1)
