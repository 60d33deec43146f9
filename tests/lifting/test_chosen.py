"""States chosen by index or by name."""

import numpy as np
import pytest

import koopmpc as km
from tests.lifting.families import NAMES
from tests.roundtrip import returned


@pytest.mark.parametrize("given", ["omega", "omega [rad/s]", 1, -2, [1], ["omega"]])
def test_one_state_by_name_or_index(given) -> None:
    lifting = km.State(given).bind(NAMES)
    X = np.random.default_rng(0).normal(size=(5, 3))
    assert lifting.names == ("omega [rad/s]",)
    assert np.array_equal(lifting(X), X[:, [1]])
    assert km.Fourier(1, given).bind(NAMES).names == ("sin(omega)", "cos(omega)")
    assert returned(lifting) == lifting


def test_a_part_of_the_state_joins_the_whole() -> None:
    assert (km.State(["p", 0]) + km.State()).bind(NAMES).names == ("p [m]", "theta [rad]", "omega [rad/s]")


def test_what_is_no_state() -> None:
    with pytest.raises(km.errors.DataError, match=r"State is asked for state 'phi'"):
        km.State("phi").bind(NAMES)
    with pytest.raises(km.errors.DataError, match=r"Fourier is asked for state 3; the states are .* or 0 … 2"):
        km.Fourier(1, 3).bind(NAMES)


def test_a_cost_of_one_state_tracks_it() -> None:
    A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, NAMES[:2], ["u"])
    part = km.KoopmanMPC(model, km.Cost(Q=3.0, R=0.1, of=km.State("theta")), km.Limits(u_min=-9, u_max=9), horizon=30)
    whole = km.KoopmanMPC(model, km.Cost(Q=[3.0, 0.0], R=0.1), km.Limits(u_min=-9, u_max=9), horizon=30)
    for controller in (part, whole):
        controller.reset()
    x = np.array([0.3, -0.2])
    assert part(x, np.array([0.1])).u == pytest.approx(whole(x, np.array([0.1, 0.0])).u, abs=1e-8)
    lifting, limits = km.State() + km.Fourier(1, 0), km.Limits(u_min=-9, u_max=9)
    lifted = km.LinearPredictor(0.9 * np.eye(4), np.ones((4, 1)), np.eye(2, 4), lifting, 0.1, NAMES[:2], ["u"])
    with pytest.raises(km.errors.ShapeError, match="the reference is not of the state"):
        km.KoopmanMPC(lifted, km.Cost(Q=[1.0], R=0.1, Q_N=np.eye(2), of=km.State("theta")), limits, horizon=5)
