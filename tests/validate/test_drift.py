"""find_drift: what changed is named, what did not is not, and what cannot be seen is said."""

import numpy as np
import pytest
from scipy.linalg import expm

import koopmpc as km

SIGMA = 0.005  # noise of the sensors as a share of the states' spread


def sample(A, B, dt):
    n, m = B.shape
    M = np.zeros((n + m, n + m))
    M[:n, :n], M[:n, n:] = A, B
    E = expm(M * dt)
    return E[:n, :n], E[:n, n:]


def log(A, B, episodes, steps, rng, sigma, *, amplitude=1.0, u0=0.0, load=0.0, gain=1.0, sensor=1.0):
    F, G = sample(A, B, 0.1)
    gain, sensor = np.ones(B.shape[1]) * gain, np.ones(len(A)) * sensor
    made = []
    for _ in range(episodes):
        U = u0 + amplitude * np.repeat(rng.uniform(-1, 1, (steps // 5, B.shape[1])), 5, axis=0)
        X = [np.zeros(len(A))]
        for u in U:
            X.append(F @ X[-1] + G @ (gain * u) + load)
        made.append(km.Episode(X=np.array(X) * sensor + sigma * rng.standard_normal((len(X), len(A))), U=U))
    return km.Episodes(made, 0.1)


def draw_plant(rng):
    nx = int(rng.integers(1, 4))
    nu = int(rng.integers(1, 3)) if nx > 1 else 1
    A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
    A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(nx)
    size = log(A, B, 1, 400, rng, 0.0)[0].X.std(axis=0)
    return A, B, size


SPRING = np.array([[0.0, 1.0], [-2.0, -0.6]]), np.array([[0.0], [1.5]])


@pytest.fixture(scope="module")
def old():
    return log(*SPRING, 6, 150, np.random.default_rng(0), 0.003)


def test_an_unchanged_plant_is_not_named_with_another_set_point_and_load(old):
    for seed in range(6):
        new = log(*SPRING, 1, 500, np.random.default_rng(10 + seed), 0.003, u0=0.2, amplitude=0.7, load=[0.0, 0.01])
        assert km.validate.find_drift(old, new).verdict == "unchanged"


@pytest.mark.parametrize("share", [0.8, 1.2])
def test_gains_and_coefficients_are_named_with_their_size(old, share):
    rng, (A, B) = np.random.default_rng(3), SPRING
    stiff = A.copy()
    stiff[1, 0] *= share
    for name, new in {
        "the gain of u0": log(A, B, 1, 500, rng, 0.003, gain=share),
        "the sensor of x0": log(A, B, 1, 500, rng, 0.003, sensor=[share, 1.0]),
        "the coefficient of x0 in the change of x1": log(stiff, B, 1, 500, rng, 0.003),
    }.items():
        report = km.validate.find_drift(old, new)
        assert report.verdict == "changed"
        found = {one.name: one.share for one in report.changes}
        assert name in found, str(report)
        assert found[name] == pytest.approx(share - 1, abs=0.06)


def test_sensor_and_input_of_one_loop_are_named_as_a_pair():
    A, B, rng = np.array([[-0.5]]), np.array([[1.0]]), np.random.default_rng(1)
    report = km.validate.find_drift(
        log(A, B, 6, 150, rng, 0.005), log(A, B, 1, 500, rng, 0.005, sensor=1.2, amplitude=0.7)
    )
    assert {"the gain of u0", "the sensor of x0"} <= {one.name for one in report.changes}
    assert "these cannot be told apart" in str(report)


def test_quiet_logs_and_logs_elsewhere_say_nothing(old):
    rng = np.random.default_rng(2)
    quiet = km.validate.find_drift(old, log(*SPRING, 1, 300, rng, 0.003, amplitude=0.005))
    assert quiet.verdict == "cannot say"
    assert "a change of a fifth in the gain of u0 would not be seen" in quiet.sentences[0]
    away = km.validate.find_drift(old, log(*SPRING, 1, 300, rng, 0.003, u0=20.0))
    assert away.verdict == "cannot say"
    assert "0 of 300 new rows are inside" in str(away) or away.inside < 40


def test_data_at_rest_say_nothing(old):
    rest = km.Episodes([km.Episode(X=np.zeros((80, 2)), U=np.zeros((79, 1)))] * 3, 0.1)
    assert km.validate.find_drift(rest, old).verdict == "cannot say"


def test_a_change_of_units_changes_no_verdict(old):
    new = log(*SPRING, 1, 500, np.random.default_rng(5), 0.003, gain=0.8)

    def scale(data):
        return data.with_episodes([km.Episode(X=e.X * [1000, 0.01], U=e.U * 60) for e in data])

    one, other = km.validate.find_drift(old, new), km.validate.find_drift(scale(old), scale(new))
    assert [c.name for c in one.changes] == [c.name for c in other.changes]
    assert [c.share for c in one.changes] == pytest.approx([c.share for c in other.changes], abs=1e-3)


def test_audit_reports_what_changed_against_other_data(old):
    new = log(*SPRING, 1, 500, np.random.default_rng(6), 0.003, gain=0.8)
    report = km.validate.audit(new, against=old)
    assert report.drift.verdict == "changed"
    assert "the gain of u0 is 80 % of what it was" in str(report).replace("\n", " ") or "gain of u0" in str(report)


def test_logs_of_other_signals_or_steps_are_refused(old):
    other = km.Episodes([km.Episode(X=np.zeros((9, 1)), U=np.zeros((8, 1)))], 0.1)
    with pytest.raises(km.errors.ShapeError, match="the new logs have 1 states"):
        km.validate.find_drift(old, other)
    with pytest.raises(km.errors.DataError, match="resample one of them"):
        km.validate.find_drift(old, km.Episodes(list(old), 0.2))
    with pytest.raises(km.errors.DataError, match="too few rows"):
        km.validate.find_drift(km.Episodes([km.Episode(X=old[0].X[:9], U=old[0].U[:8])], 0.1), old)


@pytest.mark.slow
def test_of_400_unchanged_plants_none_is_named_and_of_100_changes_at_least_90():
    rng, named, right, silent = np.random.default_rng(7), 0, 0, 0
    for i in range(400):
        A, B, size = draw_plant(rng)
        sigma = SIGMA * size
        old = log(A, B, 6, 150, rng, sigma)
        load = rng.uniform(-0.05, 0.05, len(A)) * size * (i % 2)
        new = log(A, B, 1, 500, rng, sigma, u0=rng.uniform(-0.3, 0.3) * (i % 3 > 0), load=load, amplitude=0.8)
        named += km.validate.find_drift(old, new).verdict == "changed"
        if i >= 100:
            continue
        share, kind, C = rng.choice([0.8, 1.2]), i % 3, A.copy()
        gain, sensor = np.ones(B.shape[1]), np.ones(len(A))
        if kind == 0:
            j = int(rng.integers(B.shape[1]))
            gain[j], name = share, f"the gain of u{j}"
        elif kind == 1:
            j = int(rng.integers(len(A)))
            sensor[j], name = share, f"the sensor of x{j}"
        else:
            a, b = np.unravel_index(int(np.argmax(np.abs(A))), A.shape)
            C[a, b] *= share
            name = f"the coefficient of x{b} in the change of x{a}"
        report = km.validate.find_drift(old, log(C, B, 1, 500, rng, sigma, gain=gain, sensor=sensor, load=load))
        right += name in {one.name for one in report.changes}
        quiet = log(A, B, 1, 300, rng, sigma, amplitude=0.005)
        silent += km.validate.find_drift(old, quiet).verdict == "cannot say"
    assert named == 0
    assert right >= 90
    assert silent >= 99
