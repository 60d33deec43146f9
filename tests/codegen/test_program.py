"""A `Program` says all of a controller: interpreted by a plain loop it gives the same inputs, as the C made of it does."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import koopmpc as km
from tests.codegen.interpreter import Interpreter
from tests.tiers import few

BOX = {"u_min": -8.0, "u_max": 8.0}
COST = km.Cost(Q=[10.0, 1.0], R=0.1)
UPRIGHT = km.Fourier(1, states="theta") + km.State("omega")
CIRCLE = km.Cost(Q=[10, 10, 1], R=0.1, of=UPRIGHT)
EXACT = {"settings": {"primal_tol": 1e-12}, "solver": "daqp"}  # so that all three solve their QPs to the same digits
NEAR = 1e-9  # share of the inputs' span
INTERIOR = 2e-8  # the same: interior points end at a complementarity of 1e-11, and leave a limit that hardly pushes


def lqr(cost=COST, **limits):
    return lambda plant, model, bilinear: km.LQR(model, cost, km.Limits(**BOX | limits))


def mpc(cost=COST, horizon=12, limits=BOX, **options):
    return lambda plant, model, bilinear: km.KoopmanMPC(model, cost, km.Limits(**limits), horizon, **EXACT, **options)


def linearised(plant, model, bilinear):
    return km.LinearMPC(plant, [0, 0], [0], COST, km.Limits(**BOX, x_max=[0.5, 9.0]), 12, **EXACT)


def staged(cost=CIRCLE, limits=None, of_plant=False, **options):
    limits = {"u_min": -10.0, "u_max": 10.0} if limits is None else limits
    return lambda plant, model, bilinear: km.BilinearMPC(
        plant if of_plant else bilinear, cost, km.Limits(**limits), 12, **options
    )


KALMAN = km.LiftedKalman(["theta", "omega"], disturbance="output", delay=1)
ROWS = np.linspace(0, 5, 30)[:, None]


@cache
def past_model():
    """Return a model of the present row and the two before."""
    problem = km.load_problem("pendulum")
    plant, training = km.discretize(problem.dynamics, dt=0.05), problem.training
    data = km.collect(plant, training.x0, training.excitation, episodes=30, steps=40, rng=2)
    return km.edmd(data, km.State() + km.Constant(), embedding=km.Delay(2), ridge=1e-6)


def of_past(build):
    return lambda plant, model, bilinear: build(plant, past_model(), bilinear)


KINDS = {
    "LQR": lqr(),
    "LQR, rates and their weight": lqr(km.Cost(Q=[10.0, 1.0], R=0.1, R_delta=0.3), du_max=8.0),
    "LQR, given inputs": lqr(km.Cost(Q=[10.0, 1.0], R=0.1, u_target=ROWS)),
    "LQR, past rows": of_past(lqr()),
    "KoopmanMPC": mpc(),
    "KoopmanMPC, past rows": of_past(mpc(limits=BOX | {"x_max": [0.5, 9.0]})),
    "KoopmanMPC, soft states": mpc(limits=BOX | {"x_min": [-0.5, -1.0], "x_max": [0.5, 1.0]}),
    "KoopmanMPC, rates and blocks": mpc(
        km.Cost(Q=[10.0, 1.0], R=0.1, R_delta=0.3), limits=BOX | {"du_max": 6.0}, moves=(1, 1, 2, 3, 5), latency=1
    ),
    "KoopmanMPC, given inputs": mpc(km.Cost(Q=[10.0, 1.0], R=0.1, u_target=ROWS)),
    "KoopmanMPC, disturbance": mpc(limits=BOX | {"x_max": [0.5, 9.0]}, estimator=km.LiftedDisturbance()),
    "KoopmanMPC, filter": mpc(estimator=KALMAN),
    "LinearMPC": linearised,
    "BilinearMPC": staged(),
    "BilinearMPC of a map": staged(of_plant=True, sqp_iterations=2),
    "BilinearMPC, soft states": staged(limits={"u_min": -10, "u_max": 10, "x_min": [-4, -2.0], "x_max": [4, 2.0]}),
    "BilinearMPC, rates and blocks": staged(
        km.Cost(Q=[10, 10, 1], R=0.1, R_delta=0.2, of=UPRIGHT),
        {"u_min": -10, "u_max": 10, "du_max": 4.0},
        moves=8,
        latency=1,
    ),
    "BilinearMPC, disturbance": staged(estimator=km.LiftedDisturbance(gain=0.2)),
}


@pytest.fixture(scope="module")
def models(pendulum):
    plant, model = pendulum
    training = km.load_problem("pendulum").training
    data = km.collect(plant, training.x0, training.excitation, episodes=30, steps=40, rng=1)
    lifting = km.State() + km.Fourier(2, states="theta")
    return plant, model, km.bilinear_edmd(data, lifting, difference=True)


@pytest.mark.parametrize(
    "name", few(KINDS, *(name for name in KINDS if "Bilinear" not in name), "BilinearMPC", "BilinearMPC of a map")
)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_a_program_in_a_plain_loop_gives_the_inputs_of_the_controller_and_of_its_c(name, seed, models):
    plant, rng = models[0], np.random.default_rng(seed)
    controller = KINDS[name](*models)
    turned = isinstance(controller, km.BilinearMPC)
    goals = rng.uniform(-0.2, 0.2, 2)
    rows = np.array([[np.sin(a), np.cos(a), 0.0] if turned else [a, 0.0] for a in goals])
    program = controller.build_program(rows)
    twin, plain = km.compiled(controller), Interpreter(program)
    controller.reset()
    twin.reset()
    x, u, span = (
        rng.choice([-1, 1]) * rng.uniform([0.4, 0.4], [0.6, 0.8]),
        None,
        float(np.ptp([program.inputs.low, program.inputs.high])),
    )
    steps, acts = (25 if turned else 60), "disturbance" in name or "filter" in name
    seen = set()
    for k in range(steps):
        y = x.copy()
        if k % 17 == 9 and not turned:
            y[k % 2] = np.nan  # a missed measurement
        late = k >= steps // 2 and not (turned and acts)  # there a jump of the target is more than one Newton step
        reference, applied = rows[int(late)], u if acts else None
        moves = [one(y, reference, applied) for one in (controller, twin)]
        u = plain.step(y, reference, applied)
        seen.add(moves[0].status.name)
        exact = NEAR if moves[0].status.name != "OPTIMAL" or not turned else INTERIOR
        np.testing.assert_allclose(moves[1].u, moves[0].u, rtol=0, atol=exact * span, err_msg=f"C, step {k}")
        np.testing.assert_allclose(u, moves[0].u, rtol=0, atol=exact * span, err_msg=f"step {k}, {moves[0].status}")
        x = plant(x, moves[0].u)
        if not turned:
            x = x + 0.01 * rng.standard_normal(2) if k % 20 else rng.uniform([-0.6, -1.5], [0.6, 1.5])
    assert seen & {"OPTIMAL", "SOFTENED", "SATURATED"}  # limits acted


def test_each_registered_kind_is_interpreted_or_says_why_not(models):
    shipped = {
        kind.controller
        for kind in km.control.list_kinds().values()
        if kind.controller.__module__.startswith("koopmpc.")
    }
    exported = {type(build(*models)) for build in KINDS.values()}
    others = {
        km.NonlinearMPC,
        km.supervise.Adaptive,
        km.supervise.Guarded,
        km.supervise.Station,
        km.control.PID,
        km.control.EigenfunctionLQR,
        km.guarantees.CertifiedFeedback,  # tests/guarantees exports it
    }  # the next test
    assert exported | others == shipped | {km.LinearMPC}  # which is saved as the KoopmanMPC that it is


def test_each_kind_without_c_code_says_why_and_export_raises_that_sentence(models, tmp_path):
    plant, model, bilinear = models
    data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=5, steps=20, rng=0)
    limits, energy = km.Limits(**BOX), km.Expressions(lambda x: [x[1] ** 2], ["E"]).bind(plant.states)
    feedback, watched = km.LQR(model, COST, limits), km.KoopmanMPC(model, COST, limits, 5, monitor=data)
    online = km.OnlineEDMD.start(data, model.lifting)
    refused = {
        "it uses ipopt or a CasADi solver": km.NonlinearMPC(plant, COST, limits, 5),
        "its model changes while it runs": km.supervise.Adaptive(km.KoopmanMPC(model, COST, limits, 5), online),
        "a Guarded.*it holds several controllers": km.supervise.Guarded(watched, feedback),
        "it holds several controllers": km.supervise.Station(watched, feedback),
        "levels.*; export one whose": km.KoopmanMPC(model, COST, km.Limits(levels=[[-8, 0, 8]], level_steps=2), 5),
        "stage of its own": km.BilinearMPC(bilinear, replace(CIRCLE, stage=lambda x, u: x[0] ** 2), limits, 5),
        "price.*; export one without": km.BilinearMPC(bilinear, replace(CIRCLE, price=[0.1]), limits, 5),
        "koopmpc has no C code for its law": km.control.EigenfunctionLQR(
            energy, km.Cost(Q=1, R=1, of=energy), dt=0.05, B=[[0], [1]], eigenvalue=0.0
        ),
        "C has no clock.*iter_limit": km.KoopmanMPC(model, COST, limits, 5, time_limit=1.0),
        "C has no clock.*sqp_iterations": km.BilinearMPC(bilinear, CIRCLE, limits, 5, time_limit=1.0),
    }
    for sentence, controller in refused.items():
        with pytest.raises(km.errors.DataError) as refusal:
            controller.build_program(None)
        with pytest.raises(km.errors.DataError, match=sentence) as error:
            km.export(controller, tmp_path / "c")
        assert str(error.value) == str(refusal.value)
        assert str(error.value).count("export ") <= 1  # one remedy
        assert f"export a {type(controller).__name__}" not in str(error.value)  # which was refused
        assert "C code cannot be generated" not in str(error.value)  # it begins with that
        assert not (tmp_path / "c").exists()
