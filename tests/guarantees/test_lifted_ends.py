"""Terminal weights in lifted coordinates: of a certificate, and of a user, in bilinear and nonlinear controllers."""

import numpy as np
import pytest

import koopmpc as km
from tests.guarantees.plants import library_task
from tests.searches import certify


@pytest.fixture(scope="module")
def manifold():
    """Return a bilinear model its limits, and a certificate of it."""
    _, model, data, limits, x, u = library_task("slow_manifold", episodes=400)
    return (
        model,
        limits,
        certify(model, data, limits, x=x, u=u, decay=0.995),
        x,
    )


def test_a_lifted_certificate_is_an_end_and_bilinear_and_nonlinear_plans_agree(manifold):
    model, limits, certificate, x = manifold
    weights = np.array([float(name in model.states) for name in model.lifting.names])
    cost = km.Cost(Q=weights, R=0.1, of=model.lifting, Q_N=certificate)
    assert cost.Q_N.shape == (model.nz, model.nz)
    row = model.lifting(x)
    plans = []
    for kind in (km.BilinearMPC, km.NonlinearMPC):
        mpc = kind(model, cost, limits, 6)
        move = mpc(certificate.sample(1)[0], row)
        assert move.status in (km.Status.OPTIMAL, km.Status.UNCONSTRAINED)
        plans.append(mpc.plan().U)
    assert plans[0] == pytest.approx(plans[1], abs=1e-4)


def test_a_weight_of_states_alone_means_the_same_in_lifted_coordinates(manifold):
    model, limits, certificate, x = manifold
    places = [model.lifting.names.index(name) for name in model.states]
    end = np.zeros((model.nz, model.nz))
    end[np.ix_(places, places)] = np.diag([3.0, 5.0])
    Q = np.zeros(model.nz)
    Q[places] = [1.0, 2.0]
    wide = km.BilinearMPC(model, km.Cost(Q=Q, R=0.1, of=model.lifting, Q_N=end), limits, 6)
    plain = km.BilinearMPC(model, km.Cost(Q=[1.0, 2.0], R=0.1, Q_N=np.diag([3.0, 5.0])), limits, 6)
    same = km.compiled(wide)
    for state in certificate.sample(4):
        for mpc in (wide, plain, same):
            mpc.reset()
        u = wide(state, model.lifting(x)).u
        assert u == pytest.approx(plain(state, x).u, abs=1e-6)
        assert u == pytest.approx(same(state, model.lifting(x)).u, abs=1e-6)


def test_ends_of_another_size_say_which(manifold):
    model, limits, *_ = manifold
    with pytest.raises(km.errors.ShapeError, match="for lifted coordinates let the cost track the lifting"):
        km.BilinearMPC(model, km.Cost(Q=1, R=1, Q_N=np.eye(model.nz)), limits, 6)
    with pytest.raises(km.errors.ShapeError, match=r"pass \(\d, \d\) on what the cost tracks"):
        km.BilinearMPC(model, km.Cost(Q=1, R=1, of=model.lifting, Q_N=np.eye(model.nx)), limits, 6)
