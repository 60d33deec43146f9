"""design of plants whose inputs act on their outputs at once, against the optimum of the true plant."""

import warnings
from functools import cache

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import koopmpc as km
from tests.bare import shown
from tests.estimate.test_feedthrough import PLAIN, A, B, C, D, log_of
from tests.searches import design
from tests.small_designs import short_loops, small_designs

Q, R, GOAL, ENDS = 2.0, 0.3, 0.5, 0.3
REST = (C @ np.linalg.solve(np.eye(2) - A, B) + D).item()  # y at rest under u = 1
COST, LIMITS = km.Cost(Q=Q, R=R), km.Limits(u_min=-ENDS, u_max=ENDS)


def records(direct, count=3, steps=70):
    logs = [log_of(direct, np.random.default_rng(seed), steps)[0] for seed in range(count)]
    return km.Episodes(logs, 0.1, ["y"], ["u"])


def designed(data, **more):
    asked = {"reference": [GOAL], "horizon": 15, "candidates": [PLAIN], "delays": [2], "loops": 0, "smooth": False}
    with short_loops(), warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)
        return design(data, COST, LIMITS, feedthrough=True, **(asked | {"bilinear": False} | more))


@cache
def usual():
    return designed(records(1))


def steer(mpc, x, before, steps=40):
    """Return the inputs and the outputs h(x_k, u_k) of a loop whose controller reads h(x_k, u_{k−1})."""
    U, Y, u = [], [], np.array([before])
    mpc.reset(u_prev=u)
    for _ in range(steps):
        u = mpc(C @ x + D @ u, [GOAL]).u
        U.append(u[0])
        Y.append((C @ x + D @ u)[0])
        x = A @ x + B @ u
    return np.array(U), np.array(Y)


def find_least(x, steps=40):
    """Return the inputs of the least Σ Q (y_k − r)² + R (u_k − u_r)² within the limits, and that cost."""
    powers = [np.linalg.matrix_power(A, k) for k in range(steps)]
    T = np.zeros((steps, steps))
    for k in range(steps):
        T[k, k] = D.item()
        for i in range(k):
            T[k, i] = (C @ powers[k - 1 - i] @ B).item()
    gap = GOAL - np.array([(C @ each @ x).item() for each in powers])
    rows = np.vstack([np.sqrt(Q) * T, np.sqrt(R) * np.eye(steps)])
    right = np.concatenate([np.sqrt(Q) * gap, np.full(steps, np.sqrt(R) * GOAL / REST)])
    found = lsq_linear(rows, right, bounds=(-ENDS, ENDS), tol=1e-12)
    return found.x, 2 * found.cost


@pytest.mark.parametrize("bilinear", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_designed_controller_drives_a_plant_with_feedthrough_at_the_cost_of_its_optimum(bilinear, tmp_path):
    candidate = km.synthesis.Candidate("x", PLAIN, km.Delay(2), bilinear=True)
    found = designed(records(1), candidates=[candidate], bilinear=True) if bilinear else usual()
    assert isinstance(found.controller, km.BilinearMPC if bilinear else km.KoopmanMPC)
    for x, before in ((np.zeros(2), 0.0), (np.linalg.solve(np.eye(2) - A, B[:, 0]) * -0.2, -0.2)):
        U, Y = steer(found.controller, x, before)
        best, least = find_least(x)
        assert best.max() == pytest.approx(ENDS, abs=1e-9)  # the limits are active
        assert np.abs(U).max() <= ENDS + 1e-9
        assert Q * np.sum((Y - GOAL) ** 2) + R * np.sum((U - GOAL / REST) ** 2) == pytest.approx(least, rel=0.01)
    assert found.expected.lost == 0
    assert found.controller.as_data().model.input_lead == 1
    found.save(tmp_path / "saved.npz")
    again = km.load_controller(tmp_path / "saved.npz")
    np.testing.assert_array_equal(steer(again, x, before), steer(found.controller, x, before))


def test_a_stand_in_shows_a_controller_its_next_output_under_the_input_of_the_step_before():
    found = usual()
    rows, one = found.evidence.logs[0], found.evidence.surrogates[0]
    plant, near = one.plant(), found.evidence.neighbours
    point = one.model.embed(found.evidence.logs)[0].X[5]  # of row 7, which holds u_7 already
    for u in (rows.U[7], np.array([-0.4])):
        after = one.plant(reads=False)(point, u)[:1]
        assert plant.measure(np.concatenate([point, u])) == pytest.approx(after, abs=1e-12)
        assert plant(np.concatenate([point, [9.0]]), u)[:1] == pytest.approx(after, abs=1e-12)
    assert one.plant(reads=False)(point, rows.U[7])[:1] == pytest.approx(rows.X[8], abs=1e-5)
    other = near.draw(np.random.default_rng(0))
    assert other.measure(np.concatenate([point, rows.U[7]])) == pytest.approx(rows.X[8], abs=1e-3)


@pytest.mark.slow
def test_the_inputs_of_a_late_log_are_moved_without_a_flag():
    """x⁺ = 0.8 x + 0.5 u, and row k of the log holds u_{k−1}: its controller is that of the log in time."""
    rng = np.random.default_rng(0)
    x, U = np.zeros(401), rng.uniform(-1, 1, 401)
    for k in range(400):
        x[k + 1] = 0.8 * x[k] + 0.5 * U[k]
    task = {"reference": [GOAL], "horizon": 8, "bilinear": False, "loops": 0, "smooth": False, "delays": [0]}
    firsts = []
    for late in (1, 0):
        rows = U[:400] if not late else np.concatenate([[0.0], U[:399]])
        data = km.Episodes([km.Episode(X=x[:, None], U=rows[:, None])], 0.1, ["y"], ["u"])
        with small_designs():
            found = design(data, COST, LIMITS, **task)
        assert found.controller.as_data().model.input_lead == late
        assert any("one row" in note for note in found.notes) == bool(late)
        firsts.append(found.controller([0.2], [GOAL]).u[0])
    assert firsts[0] == pytest.approx(firsts[1], abs=1e-3)


def test_data_that_feedthrough_does_not_go_with_are_refused_in_a_sentence():
    data = records(1)
    with pytest.raises(km.errors.DataError, match="there is nothing to control"):
        designed(km.Episodes([km.Episode(X=e.X) for e in data], 0.1))
    watched = km.Episodes([km.Episode(X=e.X, U=e.U, W=e.U[::-1]) for e in data], 0.1, ["y"], ["u"], ["w"])
    with pytest.raises(km.errors.DataError, match="fit the model without W"):
        designed(watched)
    (said,) = shown("""
data = km.Episodes([km.Episode(X=np.zeros((9, 1)), U=np.ones((8, 1)))], 0.1)
show(lambda: km.design(data, km.Cost(Q=1, R=1), reference=[0.0], options=km.DesignOptions(feedthrough=1)))
""")
    assert said.startswith("DataError feedthrough is an int")
