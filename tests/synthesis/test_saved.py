"""Controllers in files: what comes back steers as before, and what is no controller is refused in a sentence."""

import json
import zipfile

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.synthesis.test_design import COST, LIMITS, SQUARES, data, usual

LIFTED = km.State() + km.Constant()


def models():
    return km.edmd(data(), LIFTED), km.bilinear_edmd(data(), LIFTED, ridge=1e-9)


def controllers():
    linear, bilinear = models()
    estimator = km.LiftedDisturbance(gain=0.4)
    return [
        km.KoopmanMPC(linear, COST, LIMITS, 9, estimator=estimator, latency=1, moves=4, solver="daqp", time_limit=5.0),
        km.KoopmanMPC(linear, COST, LIMITS, 9, settings={"max_iter": 50}),
        km.BilinearMPC(bilinear, COST, LIMITS, 9, sqp_iterations=2, estimator=estimator),
        km.NonlinearMPC(bilinear, COST, LIMITS, 6, solver=km.control.NLP(starts=2)),
        km.LQR(linear, COST, LIMITS),
        km.supervise.Guarded(
            km.KoopmanMPC(linear, COST, LIMITS, 9, monitor=data()), km.LQR(linear, COST, LIMITS), patience=2
        ),
        km.control.PID([2.0], [0.5], [0.1], dt=linear.dt, limits=LIMITS, options=km.control.PIDOptions(b=0.5)),
        km.supervise.Station(
            km.KoopmanMPC(linear, COST, LIMITS, 9), km.LQR(linear, COST, LIMITS), limits=LIMITS, ramp=[0.5, 1.0]
        ),
    ]


def moves(controller):
    rng = np.random.default_rng(0)
    controller.reset()
    return np.array([controller(rng.uniform(-0.4, 0.4, 2), [1.0, 0.0]).u for _ in range(4)])


@pytest.mark.parametrize("place", range(8))
def test_a_loaded_controller_is_of_the_same_kind_and_steers_to_the_bit_as_the_saved_one(place, tmp_path):
    controller = controllers()[place]
    controller.save(tmp_path / "c.npz")
    loaded = km.load_controller(tmp_path / "c.npz")
    assert type(loaded) is type(controller)
    np.testing.assert_array_equal(moves(loaded), moves(controller))


@pytest.mark.parametrize("B", [[[0.0], [1.0]], lambda x: ca.vertcat(0, ca.cos(x[0]))])
def test_a_loaded_law_of_an_eigenfunction_steers_to_the_bit_as_the_saved_one(B, tmp_path):
    energy = km.Expressions(lambda x: [x[1] ** 2 / 2 - ca.cos(x[0])], ["E"]).bind(("a", "b"))
    cost = km.Cost(Q=2, R=0.5, of=energy)
    law = km.control.EigenfunctionLQR(energy, cost, km.Limits(-1, 1), dt=0.02, B=B, eigenvalue=0.0)
    law.save(tmp_path / "law.npz")
    loaded = km.load_controller(tmp_path / "law.npz")
    assert isinstance(loaded, km.control.EigenfunctionLQR)
    for x in np.random.default_rng(0).uniform(-2, 2, (10, 2)):
        np.testing.assert_array_equal(loaded(x, [0.3]).u, law(x, [0.3]).u)


def test_a_controller_that_goes_on_learning_is_refused_with_what_to_save_instead(tmp_path):
    mpc = km.KoopmanMPC(models()[0], COST, LIMITS, 5)
    learning = km.supervise.Adaptive(mpc, km.OnlineEDMD.start(data(), mpc.predictor.lifting))
    with pytest.raises(km.errors.DataError, match="save the controller inside it"):
        learning.save(tmp_path / "c.npz")


def test_a_linear_mpc_comes_back_as_the_koopman_mpc_that_it_is(tmp_path):
    plant = km.load_problem("pendulum")
    step = km.discretize(plant.dynamics, 0.05)
    controller = km.LinearMPC(step, [0, 0], [0], km.Cost(Q=[1, 1], R=0.1), km.Limits(u_min=-8, u_max=8), 10)
    controller.save(tmp_path / "c.npz")
    loaded = km.load_controller(tmp_path / "c.npz")
    assert loaded([0.1, 0.0], [0.0, 0.0]).u == controller([0.1, 0.0], [0.0, 0.0]).u


def test_a_design_is_saved_with_its_controller(tmp_path):
    usual().save(tmp_path / "d.npz")
    loaded = km.load_controller(tmp_path / "d.npz")
    np.testing.assert_array_equal(moves(loaded), moves(usual().controller))


def test_a_controller_on_equations_is_refused_for_they_are_code(tmp_path):
    step = km.discretize(km.load_problem("pendulum").dynamics, 0.05)
    with pytest.raises(km.KoopmpcError, match="StepMap, which is code"):
        km.NonlinearMPC(step, km.Cost(Q=[1, 1], R=0.1), None, 5).save(tmp_path / "c.npz")


def test_what_is_no_controller_is_refused_in_a_sentence(tmp_path):
    whole = tmp_path / "c.npz"
    controllers()[0].save(whole)
    cut = tmp_path / "cut.npz"
    cut.write_bytes(whole.read_bytes()[:-400])
    model = tmp_path / "model.npz"
    models()[0].save(model)
    text = tmp_path / "text.npz"
    text.write_text("hello")
    for path, sentence in (
        (tmp_path / "none.npz", "none.npz"),
        (cut, "cut.npz"),
        (model, "holds a LinearPredictor, not a Controller or Design"),
        (text, "text.npz"),
    ):
        with pytest.raises(km.KoopmpcError, match=sentence):
            km.load_controller(path)


def changed(source, target, change):
    """Write a copy of a saved file with another tree."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "tree.npy":
                header = content[:128]
                tree = change(json.loads(content[128:].decode()))
                array = np.frombuffer(json.dumps(tree).encode(), dtype=np.uint8)
                assert header.startswith(b"\x93NUMPY")
                with new.open(name, "w") as stream:
                    np.lib.format.write_array(stream, array)
            else:
                new.writestr(name, content)


def test_a_file_of_another_version_and_one_whose_parts_do_not_fit_are_refused(tmp_path):
    whole, other = tmp_path / "c.npz", tmp_path / "other.npz"
    controllers()[1].save(whole)
    changed(whole, other, lambda tree: tree | {"format": "koopmpc-0"})
    with pytest.raises(km.KoopmpcError, match="koopmpc-1"):
        km.load_controller(other)
    changed(whole, other, lambda tree: tree | {"value": tree["value"] | {"name": "LQR"}})
    with pytest.raises(km.KoopmpcError):
        km.load_controller(other)
    changed(whole, other, lambda tree: tree | {"value": tree["value"] | {"horizon": 0}})
    with pytest.raises(km.KoopmpcError, match="parts do not go together"):
        km.load_controller(other)


def test_observables_survive(tmp_path):
    model = km.edmd(data(), SQUARES)
    km.KoopmanMPC(model, km.Cost(Q=[1.0], R=0.1, of=km.State([0])), LIMITS, 5).save(tmp_path / "c.npz")
    assert km.load_controller(tmp_path / "c.npz").predictor == model
