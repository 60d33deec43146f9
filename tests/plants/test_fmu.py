"""Functional Mock-up Units as plants: km.plants.fmu."""

import copy
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from tests.compiler import find_compiler
from tests.plants import units
from tests.tiers import few

pytest.importorskip("fmpy", reason="the extra fmu is not installed")

ROD = ["theta", "omega"]


class Pendulum(km.Dynamics):
    """The equations of the units, in CasADi."""

    states, inputs = ("theta [rad]", "omega [rad/s]"), ("tau [N.m]",)
    g = 9.81

    def rhs(self, x, u):
        import casadi as ca

        return ca.vertcat(x[1], -self.g * ca.sin(x[0]) - 0.1 * x[1] + u[0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("units")


@pytest.fixture(scope="module")
def pendulum(folder):
    return units.build_pendulum(folder / "pendulum.fmu")


@pytest.fixture(scope="module")
def pendulum3(folder):
    return units.build_pendulum3(folder)


@pytest.fixture(scope="module")
def pendulum_with_slopes(folder):
    return units.build_pendulum(folder / "slopes.fmu", slopes=True)


@pytest.fixture(scope="module")
def tanks(folder):
    return {fmi: units.build_tank(folder, fmi) for fmi in (2, 3)}


def tank_step(level, inflow, dt, drain=0.5, area=2.0):
    for _ in range(20):
        level += dt / 20 * (inflow - drain * np.sqrt(max(level, 0.0))) / area
    return level


@pytest.mark.parametrize("name", ["pendulum", "pendulum_with_slopes", "pendulum3"])
def test_model_exchange_is_the_step_map_of_the_same_equations(name, request):
    unit = km.plants.fmu(request.getfixturevalue(name), dt=0.05, outputs=ROD, integrator=km.RK4(2))
    own = km.discretize(Pendulum(), 0.05, km.RK4(2))
    assert (unit.states, unit.inputs, unit.outputs) == (own.states, own.inputs, own.outputs)
    assert unit.measures_all
    rng = np.random.default_rng(0)
    for x, u in zip(rng.normal(size=(5, 2)), rng.normal(size=(5, 1)), strict=True):
        assert unit(x, u) == pytest.approx(own(x, u), abs=1e-12)
        exact, found = own.linearize(x, u), unit.linearize(x, u)
        close = 1e-6 if name == "pendulum" else 1e-12  # this unit has no derivatives: they are differences
        assert pytest.approx(exact.A, abs=close) == found.A
        assert pytest.approx(exact.B, abs=close) == found.B
    data = km.collect(unit, km.Uniform([-1, -1], [1, 1]), km.Noise(-2, 2), episodes=3, steps=10)
    expected = km.collect(own, km.Uniform([-1, -1], [1, 1]), km.Noise(-2, 2), episodes=3, steps=10)
    assert np.array([e.X for e in data]) == pytest.approx(np.array([e.X for e in expected]), abs=1e-12)


@pytest.mark.parametrize(
    "integrator", [km.plants.Euler(), km.plants.ImplicitMidpoint(), km.plants.Collocation(2), km.plants.CVODES()]
)
def test_every_integrator_takes_the_equations_of_a_unit(integrator, pendulum3):
    unit, own = km.plants.fmu(pendulum3, dt=0.05, integrator=integrator), km.discretize(Pendulum(), 0.05, integrator)
    assert unit([0.4, 1.0], [0.7]) == pytest.approx(own([0.4, 1.0], [0.7]), abs=1e-8)


def test_start_values_limits_names_and_units_come_from_the_description(pendulum):
    for interface in ("model exchange", "co-simulation"):
        unit = km.plants.fmu(pendulum, interface=interface, start_values={"theta": 0.5})
        assert unit.dt == 0.05
        assert unit.states == ("theta [rad]", "omega [rad/s]")
        assert unit.outputs == ("theta [rad]",)
        assert unit.x0.tolist() == [0.5, 0.0]
        assert (unit.u_min, unit.u_max) == (-5, 5)
        assert unit.x_min.tolist() == [-4, -np.inf]
        assert unit.x_max.tolist() == [4, np.inf]
    moon = km.plants.fmu(pendulum, dt=0.05, start_values={"g": 1.62}, outputs=ROD)
    own = Pendulum()
    own.g = 1.62
    assert moon([0.4, 0.0], [0.0]) == pytest.approx(km.discretize(own, 0.05)([0.4, 0.0], [0.0]), abs=1e-12)
    moon = km.plants.fmu(pendulum, interface="co-simulation", start_values={"g": 1.62}, outputs=ROD)
    moon.reset([0.4, 0.0])
    exact = km.discretize(own, 0.05, km.plants.CVODES())([0.4, 0.0], [0.0])
    assert moon.step([0.0]) == pytest.approx(exact, abs=1e-4)


@pytest.mark.parametrize("fmi", [2, 3])
def test_co_simulation_steps_resets_and_is_measured_as_the_unit_says(fmi, tanks):
    tank = km.plants.fmu(tanks[fmi], dt=0.5, start_values={"drain": 0.3})
    assert isinstance(tank, km.plants.Plant)
    assert (tank.states, tank.inputs, tank.outputs) == (("level",), ("inflow",), ("level",))
    assert tank.state is None
    rng = np.random.default_rng(1)
    for start in (None, [2.0], [0.5]):
        level = 1.0 if start is None else start[0]
        assert tank.reset(start) == [level]
        for u in rng.uniform(0, 2, 10):
            level = tank_step(level, u, 0.5, drain=0.3)
            assert tank.step(u) == pytest.approx([level], abs=1e-14)
            assert tank.state == pytest.approx([level], abs=1e-14)
    data = km.collect(tank, km.Uniform(0.5, 2), km.Noise(0, 1), episodes=3, steps=5, rng=2)
    assert data == km.collect(
        pickle.loads(pickle.dumps(tank)), km.Uniform(0.5, 2), km.Noise(0, 1), episodes=3, steps=5, rng=2
    )


def test_two_instances_of_a_unit_know_nothing_of_each_other(pendulum):
    first = km.plants.fmu(pendulum, interface="co-simulation")
    second = copy.deepcopy(first)
    first.reset([1.0, 0.0])
    second.reset(None)
    first.step([1.0])
    assert second.state.tolist() == [0.3, 0.0]


@pytest.mark.parametrize("name", ["pendulum", "pendulum_with_slopes", "pendulum3"])
def test_nonlinear_mpc_holds_the_pendulum_of_a_unit_as_it_holds_its_equations(name, request):
    unit = km.plants.fmu(request.getfixturevalue(name), dt=0.05, outputs=ROD)
    cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(unit.u_min, unit.u_max)
    runs = []
    for plant in (unit, km.discretize(Pendulum(), 0.05)):
        mpc = km.NonlinearMPC(plant, cost, limits, horizon=8)
        runs.append(km.simulate(plant, mpc, x0=[0.8, 0.0], reference=[0.3, 0.0], steps=6))
    assert pytest.approx(runs[1].U, abs=1e-4) == runs[0].U
    again = copy.deepcopy(mpc)
    assert again([0.8, 0.0], [0.3, 0.0]).u == pytest.approx(runs[0].U[0], abs=1e-4)


def test_a_copy_of_a_controller_on_a_unit_has_a_unit_of_its_own(pendulum):
    unit = km.plants.fmu(pendulum, dt=0.05, outputs=ROD)
    mpc = km.NonlinearMPC(unit, km.Cost(Q=[10, 1], R=0.1), horizon=3)
    assert copy.deepcopy(mpc)([0.5, 0], [0, 0]).u == pytest.approx(mpc([0.5, 0], [0, 0]).u, abs=1e-8)


def test_simulate_and_realtime_drive_a_co_simulation_unit(tanks):
    tank = km.plants.fmu(tanks[2], dt=0.02)
    data = km.collect(tank, km.Uniform(0.5, 2), km.Noise(0, 1), episodes=10, steps=20)
    cost, limits = km.Cost(Q=1, R=1e-3), km.Limits(0, 20)
    mpc = km.KoopmanMPC(km.edmd(data, km.State() + km.Constant()), cost, limits, horizon=10)
    run = km.simulate(tank, mpc, x0=[1.0], reference=[1.5], steps=100)
    assert run.X[-1] == pytest.approx([1.5], abs=0.02)
    moves: list[float] = []
    km.realtime(
        mpc,
        tank,
        x0=[1.0],
        reference=[1.5],
        dt=0.02,
        steps=5,
        safe=[0.0],
        watchdog=20,
        recorder=lambda step: moves.extend(step.u[:1] if step.move.status != km.Status.TIME_LIMIT else []),
    )
    assert moves == pytest.approx(run.U[: len(moves), 0], abs=1e-9)  # a busy machine may have skipped some
    assert moves


def test_a_step_that_the_unit_refuses_names_its_reason_and_a_reset_mends_it(pendulum):
    unit = km.plants.fmu(pendulum, interface="co-simulation", dt=0.3)
    unit.reset(None)
    with pytest.raises(
        km.KoopmpcError, match=r"refused the step from t = 0 s by 0\.3 s .*discard.*at most 0\.2 s.*another dt"
    ):
        unit.step([0.0])
    with pytest.raises(km.KoopmpcError, match="call reset"):
        unit.step([0.0])
    assert unit.reset(None) == [0.3]


def build_eventful(path):
    """Write an FMI 3 co-simulation unit, y ↦ u, that stops at an event in the step from t = 0.1 s."""
    plant = km.discretize(Pendulum(), 0.05)
    law = km.LQR(km.LinearPredictor.local(plant, [0, 0], [0]), km.Cost(Q=[1, 1], R=1))
    with zipfile.ZipFile(km.export(law, path / "c", name="arm", fmu=3) / "arm.fmu") as whole:
        held = {name: whole.read(name) for name in whole.namelist()}
    text = held["sources/arm.c"].decode()
    flags = "*event = *ends = *early = false;"
    assert flags in text
    (path / "arm.c").write_text(text.replace(flags, "*ends = false, *event = *early = time > 0.09; if (*early) { *last = time + 0.02; return OK; }"))  # fmt: skip
    command = [*find_compiler(), "-std=c99", "-O1", "-fPIC", "-shared", str(path / "arm.c"), "-o", str(path / "arm.so")]
    subprocess.run([*command, "-lm"], check=True)
    (binary,) = (name for name in held if name.startswith("binaries/"))
    held[binary] = (path / "arm.so").read_bytes()
    with zipfile.ZipFile(path / "eventful.fmu", "w") as archive:
        for name, content in held.items():
            archive.writestr(name, content)
    return path / "eventful.fmu"


def test_an_event_inside_a_step_is_an_error_that_names_its_time(tmp_path):
    unit = km.plants.fmu(build_eventful(tmp_path), inputs=["y.theta", "y.omega"], outputs=["u.tau"])
    unit.reset(None)
    for _ in range(2):
        assert abs(unit.step([0.1, 0.0])[0]) > 1e-3
    with pytest.raises(
        km.KoopmpcError, match=r"an event inside the step from t = 0\.1 s by 0\.05 s and stopped at t = 0\.12 s"
    ):
        unit.step([0.1, 0.0])
    with pytest.raises(km.KoopmpcError, match=r"it met an event.*call reset"):
        unit.step([0.1, 0.0])
    unit.reset(None)
    assert abs(unit.step([0.1, 0.0])[0]) > 1e-3


BAD = {
    "unknown": ({"outputs": ["thta"]}, "outputs names 'thta', a variable that pendulum.fmu lacks; it has theta"),
    "unknown start": ({"start_values": {"G": 1.0}}, "start_values names 'G'.* it has "),
    "calculated": ({"start_values": {"reach": 1.0}}, "reach, which pendulum.fmu calculates itself"),
    "no input": ({"inputs": ["omega"]}, "omega, which pendulum.fmu does not take as an input"),
    "states": ({"states": ROD}, "model exchange knows its states"),
    "interface": ({"interface": "exchange"}, "interface is 'exchange'; pass"),
    "dt": ({"dt": -1.0}, "dt is -1 s; it must be above zero"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mistake_is_named_in_a_sentence(case, pendulum):
    arguments, message = BAD[case]
    with pytest.raises(km.KoopmpcError, match=message):
        km.plants.fmu(pendulum, **arguments)


def test_units_that_cannot_be_a_plant_say_why(folder, pendulum, pendulum3, tanks):
    def refuse(path, message, **arguments):
        with pytest.raises(km.KoopmpcError, match=message):
            km.plants.fmu(path, **arguments)

    for flaw, built, message in (
        ("driven", {"driven": True}, "depend on time"),
        ("direct", {"direct": True}, r"the output reach of direct.fmu depends on an input.*outputs=\['theta'\]"),
        ("windows", {"folder": "win64"}, "no binary for linux64, only for win64; export the model for linux64"),
    ):
        refuse(units.build_pendulum(folder / f"{flaw}.fmu", **built), message)
    events = units.build_pendulum(folder / "events.fmu", events=2)
    refuse(events, "has 2 event indicators", interface="model exchange")
    assert isinstance(km.plants.fmu(events), km.plants.FMUPlant)  # co-simulation handles its events itself
    refuse(pendulum3, 'offers no co-simulation; pass interface="model exchange"', dt=0.1, interface="co-simulation")
    refuse(pendulum3, "does not tell a step size; pass dt=")
    refuse(tanks[2], "count of Tank.fmu, which is Integer", dt=0.1, outputs=["count"])
    refuse(folder / "none.fmu", "there is no file")
    (folder / "text.fmu").write_text("no zip")
    refuse(folder / "text.fmu", "is no .fmu file")
    texts = {"modelDescription.xml": units.DESCRIPTION.format(events="", reach="local", outputs="", slopes="false")}
    for name, held, message in (
        ("one", {"modelDescription.xml": '<fmiModelDescription fmiVersion="1.0" modelName="a" guid="b" numberOfContinuousStates="0" numberOfEventIndicators="0" modelIdentifier="m"/>'}, "is FMI 1.0"),
        ("slip", texts | {"../evil.so": ""}, "'../evil.so', which leaves the unit's folder; nothing was unpacked"),
        ("root", texts | {"/etc/evil": ""}, "leaves the unit's folder"),
        ("empty", {"readme": ""}, "holds no modelDescription.xml"),
        ("xml", {"modelDescription.xml": "<a"}, "modelDescription.xml of xml.fmu cannot be read"),
    ):  # fmt: skip
        with zipfile.ZipFile(folder / f"{name}.fmu", "w") as archive:
            for inside, text in held.items():
                archive.writestr(inside, text)
        refuse(folder / f"{name}.fmu", message)


HELD = """
import os, sys, tempfile
import koopmpc as km
from koopmpc.base.parallel import map_tasks

def run(unit):
    noise = km.Noise(-1, 1)
    return len(km.collect(unit, km.Uniform([0, 0], [1, 1]), noise, episodes=2, steps=2)), os.listdir(".")

kinds = ["model exchange", "co-simulation"]
units = [km.plants.fmu(sys.argv[1], dt=0.05, interface=kind, outputs=["theta", "omega"]) for kind in kinds]
mpc = km.NonlinearMPC(units[0], km.Cost(Q=[1, 1], R=0.1), horizon=3)
assert list(map_tasks(run, units, workers=2)) == [(2, [])] * 2
assert [run(unit) for unit in units] == [(2, [])] * 2
assert any(name.startswith("koopmpc-") for name in os.listdir(tempfile.gettempdir()))
"""


TALKING = """
import gc, sys
import koopmpc as km

first, second = (km.plants.fmu(sys.argv[1], dt=0.3, interface="co-simulation") for _ in range(2))
if sys.argv[2] == "freed":
    del second
    gc.collect()
for plant in (first, first):
    plant.reset(None)
    try:
        plant.step([0.0])
    except km.KoopmpcError as error:
        print(error)
"""


@pytest.mark.parametrize("other", few(["freed", "alive"], "freed"))
def test_a_unit_speaks_for_itself_after_another_one_was_loaded(other, pendulum):
    done = subprocess.run([sys.executable, "-c", TALKING, str(pendulum), other], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("and said: at most 0.2 s") == 2


def test_processes_with_units_leave_no_files_behind(pendulum, tmp_path):
    places = [tmp_path / "here", tmp_path / "temporary"]
    for place in places:
        place.mkdir()
    words = [sys.executable, "-c", HELD, str(pendulum)]
    path = os.pathsep.join([str(Path(km.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    env = os.environ | {"TMPDIR": str(places[1]), "PYTHONPATH": path}
    done = subprocess.run(words, cwd=places[0], env=env, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert [list(place.iterdir()) for place in places] == [[], []]


@pytest.mark.parametrize("count", [40, pytest.param(300, marks=pytest.mark.slow)])
def test_a_damaged_unit_is_refused_in_a_sentence_before_its_code_is_loaded(count, folder, tmp_path):
    path = units.build_pendulum(tmp_path / "win.fmu", folder="win64")  # complete, its code is for another platform
    with zipfile.ZipFile(path) as whole:
        text = whole.read("modelDescription.xml")
    content, rng, loaded = path.read_bytes(), np.random.default_rng(3), 0
    for k in range(count):
        damaged, place = bytearray(content if k % 2 else text), int(rng.integers(len(content if k % 2 else text)))
        if k % 3 == 0:
            damaged[place : place + 8] = rng.bytes(int(rng.integers(1, 8)))
        elif k % 3 == 1:
            damaged[place : place + int(rng.integers(1, 200))] = b""
        else:
            damaged[place:place] = damaged[place : place + int(rng.integers(1, 200))]
        if k % 2:
            path.write_bytes(damaged)
        else:
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("modelDescription.xml", bytes(damaged))
                archive.writestr("binaries/win64/pendulum.dll", b"")
        with pytest.raises(km.KoopmpcError) as caught:
            km.plants.fmu(path)
        loaded += "no binary for" in str(caught.value)
    assert 0 < loaded < count


def test_an_episode_cannot_begin_where_the_unit_does_not_let_it(pendulum):
    unit = km.plants.fmu(pendulum, interface="co-simulation", states=["theta", "reach"], outputs=["theta"])
    with pytest.raises(km.KoopmpcError, match=r"calculates reach itself; pass x0=None"):
        unit.reset([0.1, 0.1])
    unit.reset(None)
    assert unit.step([1.0]) == unit.state[:1]


def test_fmpy_is_imported_by_nothing_else_and_its_absence_is_said():
    code = (
        "import sys; sys.modules['fmpy'] = None\n"
        "import koopmpc as km\n"
        "km.plants.StepMap if hasattr(km.plants, 'StepMap') else km.StepMap; km.simulate; km.plants.fmu\n"
        "try:\n    km.plants.fmu('a.fmu')\n"
        "except ImportError as error:\n    assert 'needs FMPy, which is not installed: pip install' in str(error)\n"
        "else:\n    raise SystemExit(1)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    code = "import sys, koopmpc as km; km.simulate; km.plants.fmu; assert 'fmpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
