"""Ctrl-C while CasADi builds expressions: every construction of koopmpc stands in `raise_swallowed`.

CasADi's C calls Python helpers to convert its arguments, and drops a KeyboardInterrupt that one of them raises. A
profile sees each of these calls, so this test needs no luck with the moment of a signal.
"""

import functools
import signal
import sys
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.example_plants import Pendulum

ROOT = Path(km.__file__).parent
COST = km.Cost(Q=[10.0, 1.0], R=0.1)
BOX = km.Limits(u_min=-3.0, u_max=5.0, x_min=[-2.0, -2.5], x_max=[2.0, 2.5])
STEADY = ([0.0, 0.0], [0.0])


def lifting():
    """Return a fresh lifting, which has traced nothing yet."""
    own = km.Expressions(lambda x: [x[0] * x[1]], ["product"])
    radial = km.Gaussian(np.ones((1, 2)), 1.0) + km.ThinPlate(np.ones((1, 2))) + km.RandomFourier(2, 1.0, 0)
    return km.State() + km.Fourier(1, states=[0]) + km.Monomials(2) + radial + own + km.Constant()


def plant():
    return km.discretize(Pendulum(), 0.05)


def data(**options):
    return km.collect(plant(), km.Uniform([-2, -2], [2, 2]), km.Noise(-3, 3), **{"episodes": 40, "steps": 12} | options)


def linear():
    return km.edmd(data(), lifting(), ridge=1e-6)


def bilinear():
    return km.bilinear_edmd(data(), km.State() + km.Fourier(1, states=[0]) + km.Constant())


def delayed():
    return km.edmd(data(), km.State() + km.Constant(), embedding=km.Delay(1))


def surrogate():
    return km.synthesis.Surrogate(linear(), np.zeros(1), np.zeros(0), np.zeros(2))


def take_steps(controller):
    for angle in (0.1, 1.9):
        controller([angle, 0.0], [0.3, 0.0])


def hold_energy():
    energy = km.Expressions(lambda x: [x[1] ** 2 / 2 - ca.cos(x[0])], ["H"]).bind(("theta [rad]", "omega [rad/s]"))
    cost = km.Cost(Q=1, R=1, of=energy)
    return km.control.EigenfunctionLQR(energy, cost, dt=0.01, B=lambda x: ca.vertcat(0, 1), eigenvalue=0.0)


BUILDS = {
    "discretize": lambda _: plant(),
    "CVODES": lambda _: km.discretize(Pendulum(), 0.05, km.plants.CVODES())([0.1, 0.0], [0.0]),
    "Collocation": lambda _: km.discretize(Pendulum(), 0.05, km.plants.Collocation(2)).linearize(*STEADY),
    "linearize": lambda _: plant().linearize(*STEADY),
    "rollouts": lambda _: plant().rollouts(np.zeros((100, 2)), np.zeros((100, 250, 1))),
    "collect": lambda _: data(),
    "edmd": lambda _: linear(),
    "eigenfunctions": lambda _: km.identify.eigenfunctions(data(), km.State() + km.Constant(), count=1),
    "kic": lambda _: km.identify.kic(data(), km.State() + km.Constant()).step_map(),
    "kic, linear": lambda _: km.identify.kic(data(), km.State() + km.Constant()).linear(),
    "refine": lambda _: km.identify.refine(bilinear(), data(), horizon=2, iterations=1),
    "train": lambda _: km.train(km.State() + km.Gaussian(np.ones((1, 2)), 1.0), data(), iterations=1),
    "step_map": lambda _: linear().step_map().rollouts(np.zeros((70, 2)), np.zeros((70, 3, 1))),
    "LQR": lambda _: take_steps(km.LQR(linear(), COST, BOX)),
    "EigenfunctionLQR": lambda _: hold_energy().as_data(),
    "KoopmanMPC": lambda _: take_steps(km.KoopmanMPC(linear(), COST, BOX, 8)),
    "offset-free": lambda _: take_steps(km.KoopmanMPC(linear(), COST, BOX, 8, estimator=km.LiftedDisturbance())),
    "delays": lambda _: delayed().step_map(),
    "surrogate": lambda _: surrogate().plant(1.2),
    "equilibria": lambda _: surrogate().holding(COST, BOX),
    "LinearMPC": lambda _: take_steps(km.LinearMPC(plant(), *STEADY, COST, BOX, 8)),
    "BilinearMPC": lambda _: take_steps(km.BilinearMPC(bilinear(), COST, BOX, 3, estimator=km.LiftedDisturbance())),
    "NonlinearMPC": lambda _: take_steps(km.NonlinearMPC(plant(), COST, BOX, 4)),
    "compiled": lambda _: take_steps(km.compiled(km.BilinearMPC(bilinear(), COST, km.Limits(-3, 3), 3))),
    "export": lambda folder: km.export(km.KoopmanMPC(linear(), COST, BOX, 6), folder, plant=plant()),
    "save": lambda folder: linear().save(folder / "model.npz"),
    "simulate": lambda _: km.simulate(
        plant(),
        km.KoopmanMPC(linear(), COST, BOX, 6),
        x0=[0.1, 0],
        reference=[0, 0],
        steps=3,
        cost=COST,
        options=km.loop.LoopOptions(plans=True),
    ),
}


class Walk:
    """A profile that lists the code of koopmpc in which CasADi's C calls Python, and nobody would raise a Ctrl-C."""

    def __init__(self) -> None:
        self.inside: list[object] = []  # calls of C that CasADi's Python layer has open
        self.unguarded: set[str] = set()
        self.files: set[str] = set()

    def __call__(self, frame, event, called) -> None:
        by_casadi = frame.f_code.co_filename.endswith("casadi.py")
        if by_casadi and event == "c_call":
            self.inside.append(called)
            places = self._places(frame)
            self.files.update(place.split(":")[0] for place in places[:1])
        elif event in ("c_return", "c_exception") and self.inside and called is self.inside[-1]:
            self.inside.pop()
        elif by_casadi and event == "call" and self.inside and not self._is_guarded():
            self.unguarded.add(" < ".join(self._places(frame)))

    @staticmethod
    def _is_guarded() -> bool:
        handler = signal.getsignal(signal.SIGINT)
        return getattr(handler, "__qualname__", "").startswith("raise_swallowed")

    @staticmethod
    def _places(frame) -> list[str]:
        places = []
        while frame is not None:
            path = Path(frame.f_code.co_filename)
            if ROOT in path.parents:
                places.append(f"{path.relative_to(ROOT).as_posix()}:{frame.f_lineno}")
            frame = frame.f_back
        return places


def walk(build, folder):
    """Return the profile of one build."""
    profile = Walk()
    sys.setprofile(profile)
    try:
        with warnings.catch_warnings(action="ignore"):  # these models need not be good
            build(folder)
    finally:
        sys.setprofile(None)
    return profile


@pytest.fixture(scope="module", autouse=True)
def _ctrl_c_is_heard():
    """Listen to Ctrl-C, which a shell lets its jobs in the background ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


QUICK = {"discretize", "CVODES", "Collocation", "linearize", "rollouts", "collect", "edmd", "kic", "kic, linear"} | {
    *("step_map", "delays", "LinearMPC")
}


@pytest.fixture(scope="module")
def walks(tmp_path_factory):
    return functools.cache(lambda name: walk(BUILDS[name], tmp_path_factory.mktemp("build")))


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in BUILDS]
)
def test_no_build_calls_casadi_where_an_interrupt_would_be_lost(walks, name):
    assert walks(name).files
    assert not walks(name).unguarded


@pytest.mark.slow
def test_no_part_of_a_design_does_either(tmp_path):
    found = walk(
        lambda _: km.design(
            data(), COST, BOX, horizon=4, reference=[0, 0], options=km.DesignOptions(delays=[0], sample=400)
        ),
        tmp_path,
    )
    assert found.files
    assert not found.unguarded


@pytest.mark.slow
def test_these_builds_reach_every_file_that_calls_casadi(walks):
    sources = {path.relative_to(ROOT).as_posix(): path.read_text() for path in ROOT.rglob("*.py")}
    calls = {name for name, text in sources.items() if "import casadi as ca" in text and "papers/" not in name}
    assert calls <= set().union(*(walks(name).files for name in BUILDS))
