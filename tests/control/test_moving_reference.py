"""A reference that moves enters the plan by one product with it, or part by part: both give the same inputs."""

import numpy as np
import pytest

import koopmpc as km
from tests.control.models import linear

A, B = np.array([[1.0, 0.1], [0.15, 0.98]]), np.array([[0.005], [0.1]])
N = 12
COSTS = {
    "equilibria as targets": km.Cost([1, 0.1], 0.1),
    "no target": km.Cost([1, 0.1], 0.1, u_target="zero"),
    "given targets": km.Cost([1, 0.1], 0.1, u_target=0.3 * np.sin(np.arange(25.0))[:, None]),
    "rates": km.Cost([1, 0.1], 0.1, R_delta=0.4),
}
LIMITS = {"wide": km.Limits(-50, 50), "narrow": km.Limits(-1, 1, x_min=[-0.5, -5], x_max=[0.5, 5])}


def preview(kind, k):
    rows = 0.6 * np.sin(0.3 * (k + np.arange(N + 2)))[:, None] * [1.0, 0.0]
    return {"rows": rows, "few rows": rows[:3], "many rows": np.vstack([rows, rows]), "one row": rows[0]}[kind]


@pytest.mark.parametrize("offset_free", [False, True])
@pytest.mark.parametrize("latency", [0, 1])
@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("cost", COSTS)
def test_one_product_gives_the_inputs_of_its_parts(cost, limits, latency, offset_free, monkeypatch):
    options = {"estimator": km.LiftedDisturbance() if offset_free else None, "latency": latency}
    at_once = km.KoopmanMPC(linear(A, B), COSTS[cost], LIMITS[limits], N, **options)
    monkeypatch.setattr("koopmpc.control.linear.plan._LARGEST", 0)
    by_parts = km.KoopmanMPC(linear(A, B), COSTS[cost], LIMITS[limits], N, **options)
    assert at_once._map.moving is not None
    assert by_parts._map.moving is None
    rng, statuses = np.random.default_rng(0), []
    for kind in ("rows", "few rows", "many rows", "one row"):
        x = np.array([0.2, 0.0])
        for mpc in (at_once, by_parts):
            mpc.reset(x)
        for k in range(20):
            reference = preview(kind, k // 2)  # each row stays for two steps
            move, other = at_once(x, reference), by_parts(x, reference)
            assert move.status is other.status
            np.testing.assert_allclose(move.u, other.u, atol=1e-9)
            statuses.append(move.status)
            x = A @ x + B @ move.u + 0.002 * rng.normal(size=2)
    assert (km.Status.UNCONSTRAINED in statuses) or limits == "narrow"
    assert limits == "wide" or len(set(statuses)) > 1


def test_a_moving_reference_that_is_not_finite_ends_in_bad_measurement():
    mpc = km.KoopmanMPC(linear(A, B), COSTS["no target"], LIMITS["wide"], N)
    rows = preview("rows", 0)
    assert mpc([0, 0], rows).status is km.Status.UNCONSTRAINED
    for bad in (np.nan, np.inf, 1e31, 1e308):
        rows = rows.copy()
        rows[3, 0] = bad
        assert mpc([0, 0], rows).status is km.Status.BAD_MEASUREMENT
        rows[3, 0] = 0.0
        assert mpc([0, 0], rows).status is km.Status.UNCONSTRAINED
