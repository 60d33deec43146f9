"""States chosen by index or by name."""

import numpy as np
import pytest

from koopmpc.control.cost import Cost
from koopmpc.control.koopman_mpc import KoopmanMPC
from koopmpc.control.limits import Limits
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.fourier import Fourier
from koopmpc.lifting.state import State
from koopmpc.predict.linear import LinearPredictor
from koopmpc.values import from_data, to_data
from tests.lifting.families import NAMES


@pytest.mark.parametrize("given", ["omega", "omega [rad/s]", 1, -2, [1], ["omega"]])
def test_one_state_by_name_or_index(given) -> None:
    lifting = State(given).bind(NAMES)
    X = np.random.default_rng(0).normal(size=(5, 3))
    assert lifting.names == ("omega [rad/s]",)
    assert np.array_equal(lifting(X), X[:, [1]])
    assert Fourier(1, given).bind(NAMES).names == ("sin(omega)", "cos(omega)")
    assert from_data(to_data(lifting)) == lifting


def test_a_part_of_the_state_joins_the_whole() -> None:
    assert (State(["p", 0]) + State()).bind(NAMES).names == ("p [m]", "theta [rad]", "omega [rad/s]")


def test_what_is_no_state() -> None:
    with pytest.raises(
        DataError, match=r"State is asked for state 'phi'; the states are theta \[rad\], omega"
    ):
        State("phi").bind(NAMES)
    with pytest.raises(DataError, match=r"Fourier is asked for state 3; the states are .* or 0 … 2"):
        Fourier(1, 3).bind(NAMES)


def test_a_cost_of_one_state_tracks_it() -> None:
    A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    model = LinearPredictor(A, B, np.eye(2), State(), 0.1, NAMES[:2], ["u"])
    part = KoopmanMPC(model, Cost(Q=3.0, R=0.1, of=State("theta")), Limits(u_min=-9, u_max=9), horizon=30)
    whole = KoopmanMPC(model, Cost(Q=[3.0, 0.0], R=0.1), Limits(u_min=-9, u_max=9), horizon=30)
    for controller in (part, whole):
        controller.reset()
    x = np.array([0.3, -0.2])
    assert part(x, np.array([0.1])).u == pytest.approx(whole(x, np.array([0.1, 0.0])).u, abs=1e-8)
    lifting, limits = State() + Fourier(1, 0), Limits(u_min=-9, u_max=9)
    lifted = LinearPredictor(0.9 * np.eye(4), np.ones((4, 1)), np.eye(2, 4), lifting, 0.1, NAMES[:2], ["u"])
    with pytest.raises(ShapeError, match="the reference is not of the state"):
        KoopmanMPC(lifted, Cost(Q=[1.0], R=0.1, Q_N=np.eye(2), of=State("theta")), limits, horizon=5)
