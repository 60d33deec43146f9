"""What a cost, limits and a KoopmanMPC refuse, by the words that say what is wrong."""

import numpy as np
import pytest

import koopmpc as km
from tests.control.models import linear, with_disturbances

MODEL, COST = linear(np.array([[1.1, 0.3], [0.1, 0.9]]), np.array([[0.1], [1.0]])), km.Cost(1, 0.1)
WIDE = linear(MODEL.A, MODEL.B, constant=[0, 0])


def make(*limits, cost=COST, model=MODEL, **options):
    return km.KoopmanMPC(model, cost, *limits, **options)


def step(*arguments, mpc=None, **options):
    return (mpc or make())(*arguments, **options)


DATA = {
    "horizon is 0": lambda: make(horizon=0),
    "OSQP refuses the problem or its settings": lambda: make(solver="osqp", settings={"eps": 1}),
    "DAQP has no setting 'eps'; it has primal_tol": lambda: make(settings={"eps": 1}),
    "moves is 6, the horizon 5": lambda: make(horizon=5, moves=6),
    "moves is 0; it must be at least 1": lambda: make(moves=0),
    "sum to 4, the horizon is 5": lambda: make(horizon=5, moves=(2, 2)),
    "a block of moves is 0": lambda: make(horizon=5, moves=(5, 0)),
    "w was passed, but the predictor has no E": lambda: step([0, 0], [0, 0], w=[0]),
    "slack has both weights zero at index 1": lambda: make(km.Limits(x_max=1, slack=([1, 0], 0))),
    "rate limits cross at index 0": lambda: km.Limits(du_min=1, du_max=-1),
    "du_max is -1.0; an input must be free to stay": lambda: km.Limits(du_max=-1),
    "du_min is 0.5; an input must be free to stay": lambda: km.Limits(du_min=0.5),
    "Q holds 1 NaN or inf, the first at (1,)": lambda: km.Cost(Q=[1, np.nan], R=1),
    "Q is not an array of numbers: got str": lambda: km.Cost(Q="much", R=1),
    "Q must be a weight, got None": lambda: km.Cost(Q=None, R=1),
    "of is a NoneType, expected a Lifting": lambda: km.Cost(1, 1, of=None),
    "u_target is not an array of numbers: got NoneType": lambda: km.Cost(1, 1, u_target=None),
    "rows is None; pass a tuple": lambda: km.Limits(rows=None),
    "Q_N and tail = 1 are given": lambda: km.Cost(1, 1, tail=1, Q_N=1),
    "input limits cross at index 0: lower 1 is above upper -1": lambda: km.Limits(u_min=1, u_max=-1),
    "state limits cross at index 1: lower 2 is above upper 1": lambda: km.Limits(x_min=[0, 2], x_max=1),
    "output limits cross at index 0": lambda: km.Limits(of=km.State(), y_min=1, y_max=0),
    "say which with of=": lambda: km.Limits(y_max=1),
    "u_min is +inf or u_max is −inf somewhere": lambda: km.Limits(u_min=np.inf),
    "x_min is +inf or x_max is −inf": lambda: km.Limits(x_max=[1, -np.inf]),
    "u_min holds NaN; use ±inf": lambda: km.Limits(u_min=np.nan),
    "slack is (-1.0, 0.0); pass weights (linear, quadratic) ≥ 0": lambda: km.Limits(slack=(-1.0, 0.0)),
    "slack is (0.0, 0.0); pass weights": lambda: km.Limits(slack=(0.0, 0.0)),
    "the linear weight of slack holds NaN": lambda: km.Limits(slack=(np.nan, 1.0)),
    "quadratic weight of slack holds 1 NaN or inf": lambda: km.Limits(slack=(1.0, np.inf)),
    "dwell and level_steps are of inputs on levels": lambda: km.Limits(dwell=[2]),
}
SHAPE = {
    "Q has shape (3,), expected (2, 2) or its diagonal": lambda: make(cost=km.Cost([1, 1, 1], 1)),
    "R has shape (2, 2), expected (1, 1)": lambda: make(cost=km.Cost(1, np.eye(2))),
    "R has shape (3,), expected (2, 2) or its diagonal": lambda: km.Cost(1, [1, 1, 1]).matrices(2, 2),
    "Q has shape (2, 3), expected a square matrix": lambda: km.Cost(Q=np.ones((2, 3)), R=1),
    "expected (2, 2) on the state or (3, 3) on z": lambda: make(cost=km.Cost(1, 1, Q_N=np.eye(4)), model=WIDE),
    "the reference is not of the state; pass (3, 3)": lambda: make(
        cost=km.Cost(1, 1, Q_N=np.eye(2), of=km.State() + km.Constant()), model=WIDE
    ),
    "u_max has shape (3,), expected (1,) or a scalar": lambda: make(km.Limits(u_max=[1, 1, 1])),
    "x_max has shape (3,), expected (2,) or a scalar": lambda: km.Limits(x_max=[1, 1, 1]).states(2),
    "x_min has shape (2,) and x_max (3,); pass one limit a row": lambda: km.Limits(x_min=[0, 0], x_max=[1, 1, 1]),
    "y has shape (3,), expected (2,), one value a state": lambda: step([0, 0, 0], [0, 0]),
    "expected (2,), or rows of 2 for steps k … k+20": lambda: step([0, 0], [0, 0, 0]),
    "to track fewer outputs pass Cost(of=km.State": lambda: step([0, 0], [0]),
    "reference has shape (0,), expected (2,)": lambda: step([0, 0], []),
    "u_prev has shape (2,), expected (1,)": lambda: make().reset(u_prev=[0, 0]),
    "w has shape (3,), expected (2,), or rows of 2 for steps k … k+4": lambda: step(
        [0, 0], [0, 0], w=[0, 0, 0], mpc=make(model=with_disturbances(MODEL, np.ones((2, 2))), horizon=5)
    ),
    "applied has shape (2,), expected (1,)": lambda: step([0, 0], [0, 0], [0, 0], mpc=make(km.Limits(du_max=1))),
    "R_delta has shape (2,), expected (1, 1)": lambda: make(cost=km.Cost(1, 1, R_delta=[1, 1])),
    "slack has a weight of shape (3,), expected (2,)": lambda: make(km.Limits(x_max=1, slack=([1, 1, 1], 1))),
    "du_slack has a weight of shape (2,)": lambda: make(km.Limits(du_max=1, du_slack=([1, 1], 1))),
    "E has shape (3, 1), expected (2, any)": lambda: with_disturbances(MODEL, np.ones((3, 1))),
}
DEFINITENESS = {
    "R + BᵀPB is not positive definite": lambda: make(cost=km.Cost(Q=0, R=0)),
    "R_delta is indefinite": lambda: km.Cost(1, 1, R_delta=-1),
    "Q is indefinite: its least eigenvalue is -1; weights must be ⪰ 0": lambda: km.Cost(Q=[1, -1], R=1),
    "R is indefinite: its least eigenvalue is -1": lambda: km.Cost(Q=1, R=[[1, 2], [2, 1]]),
    "Q is not symmetric; pass (M + Mᵀ)/2": lambda: km.Cost(Q=[[1, 1], [0, 1]], R=1),
    "R is not symmetric": lambda: km.Cost(Q=1, R=[[1, 0.5], [0, 1]]),
    "Q_N is indefinite": lambda: km.Cost(Q=1, R=1, Q_N=-1),
}
OBSERVABLE = {
    "the lifting lacks 'sin(x0)'; add it to the lifting": lambda: make(
        cost=km.Cost(1, 1, of=km.Fourier(1, states=["x0"]))
    ),
    "the lifting lacks 'sin(x1)'": lambda: make(km.Limits(of=km.Fourier(1, states=["x1"]), y_max=0.5)),
}
REFUSED = [
    (error, words, call)
    for error, table in (
        (km.errors.DataError, DATA),
        (km.errors.ShapeError, SHAPE),
        (km.errors.DefinitenessError, DEFINITENESS),
        (km.errors.ObservableError, OBSERVABLE),
    )
    for words, call in table.items()
]


@pytest.mark.unhooked
@pytest.mark.parametrize(("error", "words", "call"), REFUSED, ids=[words for _, words, _ in REFUSED])
def test_what_is_refused_is_named(error, words, call):
    with pytest.raises(error) as raised:
        call()
    assert words in str(raised.value)
