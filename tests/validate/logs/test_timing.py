"""Input timing: a row moved by one is named, a record in time is never, and under feedback the audit cannot say."""

from functools import cache

import numpy as np
import pytest
from scipy import signal

import koopmpc as km

DRIVES = ("noise", "prbs", "held", "smooth", "multisine")
SETPOINTS = ("noise", "held", "smooth")
SNR = 20.0  # [dB]
ROWS = 1500


def signal_of(kind, rng, rows=ROWS + 200):
    """Return a test signal of about unit size."""
    if kind == "prbs":
        return np.repeat(rng.choice([-1.0, 1.0], rows), rng.integers(1, 6))[:rows]
    if kind == "held":
        return np.repeat(rng.uniform(-1, 1, rows), rng.integers(2, 12))[:rows]
    if kind == "smooth":
        return signal.lfilter([1], [1, -rng.uniform(0.3, 0.95)], rng.normal(size=rows))
    if kind == "multisine":
        lines = rng.permutation(np.arange(1, rows // 2))[: rows // 4]
        phases = rng.uniform(0, 2 * np.pi, len(lines))
        return np.cos(2 * np.pi * np.outer(np.arange(rows), lines) / rows + phases).sum(axis=1)
    return rng.normal(size=rows)


def plant_of(rng, u):
    """Return a(q), b(q) of a random stable plant whose first Markov parameter shows beside the noise."""
    while True:
        poles = list(rng.uniform(0.3, 0.95, rng.integers(0, 3)))
        if rng.random() < 0.5 or not poles:
            pole = rng.uniform(0.4, 0.95) * np.exp(1j * rng.uniform(0.1, 1.5))
            poles += [pole, pole.conj()]
        a, b = np.real(np.poly(poles)), rng.normal(size=len(poles))
        y = signal.lfilter(np.r_[0, b], a, u)
        if abs(b[0]) * np.diff(u).std() > 0.2 * y.std():
            return a, b / y.std()


@cache
def record(seed, late=False, feedback=None):
    """Return one record with noise; `late` has the input column one row late, `feedback` is P or PI."""
    rng = np.random.default_rng([seed, 28])
    drive = DRIVES[seed % 5] if feedback is None else SETPOINTS[seed % 3]
    r = signal_of(drive, rng)
    a, b = plant_of(rng, r)
    noise = 10 ** (-SNR / 20) * rng.normal(size=len(r))
    if feedback is None:
        x = signal.lfilter(np.r_[0, b], a, r)
        x = x + rng.choice([0.0, 0.1]) * x**3
        y, u = x + x.std() * noise, r
    else:
        y, u = next(
            run for gain in np.geomspace(2, 0.05, 16) if (run := loop(a, b, r, noise, gain, feedback)) is not None
        )
    y, u = y[200:], u[200:]
    X, U = (y[1:], u[:-2]) if late else (y[:-1], u[:-2])
    return km.Episodes([km.Episode(X=X[:, None], U=U[:, None])], 0.1, ["y"], ["u"])


@cache
def disturbed(seed, kind, set_points):
    """Return one record under feedback which disturbances of the output drive: set points are that many times as large."""
    rng = np.random.default_rng([seed, 77])
    r = set_points * rng.normal(size=ROWS + 200)
    a, b = plant_of(rng, rng.normal(size=len(r)))
    d = signal.lfilter([1], [1, -rng.choice([0.0, rng.uniform(0.5, 0.98)])], rng.normal(size=len(r)))
    gains = np.geomspace(2, 0.05, 16)
    y, u = next(run for gain in gains if (run := loop(a, b, r, d / d.std(), gain, kind, 1.0)) is not None)
    return km.Episodes([km.Episode(X=y[200:-1, None], U=u[200:-2, None])], 0.1, ["y"], ["u"])


def loop(a, b, r, noise, gain, kind, size=None):
    """Return y and u under u = K (r − y) + Kᵢ Σ (r − y) + D Δ(r − y), or None where the loop is unstable."""
    K, n = gain * np.sign(b.sum() / a.sum()), len(b)
    integral, slope = 0.1 * K * ("I" in kind), 0.5 * K * ("D" in kind)
    x, y, u, total, last = np.zeros(len(r)), np.zeros(len(r)), np.zeros(len(r)), 0.0, 0.0
    size = r.std() if size is None else size
    for k in range(len(r)):
        x[k] = sum(b[i - 1] * u[k - i] - a[i] * x[k - i] for i in range(1, min(n, k) + 1))
        if abs(x[k]) > 100:
            return None
        y[k] = x[k] + size * noise[k]
        total += r[k] - y[k]
        u[k] = K * (r[k] - y[k]) + integral * total + slope * (r[k] - y[k] - last)
        last = r[k] - y[k]
    return y, u


def same_row(data):
    report = km.validate.audit(data)
    return report.same_row == ("u",) and "input in its own row" in report.kinds


def test_a_late_input_column_is_named_and_the_true_one_is_not():
    named = sum(same_row(record(seed, late=True)) for seed in range(10))
    assert named >= 9
    assert sum(same_row(record(seed)) for seed in range(10)) == 0


@pytest.mark.parametrize("seed", [1002, 1007, 1058, 1101])
def test_what_looks_like_a_feedback_that_drives_the_output_away_is_a_late_column(seed):
    assert same_row(record(seed, late=True))


@pytest.mark.parametrize(("seed", "kind"), [(1055, "P"), (1082, "PI")])
def test_an_effect_within_the_row_that_a_feedback_can_make_is_not_named(seed, kind):
    assert not same_row(record(seed, feedback=kind))


@pytest.mark.parametrize("kind", ["P", "PI", "PD", "PID"])
@pytest.mark.parametrize("set_points", [0.0, 0.1])
def test_a_feedback_that_disturbances_drive_is_not_named(kind, set_points):
    assert not any(same_row(disturbed(seed, kind, set_points)) for seed in (2, 3))


@pytest.mark.parametrize("which", [(0, "PI", 0.1), (8, "PID", 1.0), (18, "PI", 1.0), (27, "PID", 0.1)])
def test_a_controller_whose_law_is_known_up_to_its_set_points_is_not_named(which):
    assert not same_row(disturbed(*which))


def held(seed, rows, gain=0.0, noise=0.0):
    """Return a nonlinear plant's log: an input held for so many rows is drawn, or −gain times the first output."""
    rng = np.random.default_rng([seed, 5])
    levels, noises, u, X = (
        rng.normal(size=3000),
        noise * rng.normal(size=(3000, 2)),
        np.zeros(3000),
        np.zeros((3000, 2)),
    )
    X[0] = noises[0]
    for k in range(2999):
        u[k] = u[k - 1] if k % rows else -gain * X[k, 0] if gain else levels[k // rows]
        x = X[k] - noises[k]
        slow = np.array([[0.95, 0.05], [-0.05, 0.9]]) @ x + np.array([0.05, 0.1]) * u[k]
        X[k + 1] = slow + 0.02 * np.tanh(3 * x[::-1]) + noises[k + 1]
    return km.Episodes([km.Episode(X=X, U=u[:-1, None])], 1.0)


@pytest.mark.parametrize(("seed", "rows"), [(5, 10), (11, 10), (12, 10), (16, 10), (0, 5), (1, 5), (2, 3), (20, 10)])
def test_a_held_input_that_nobody_computes_from_the_outputs_is_no_feedback(seed, rows):
    """Its few jumps hold all that its past does not tell; when the next one comes, a nonlinear plant tells."""
    (timing,) = km.validate.audit(held(seed, rows)).timing
    assert not timing.feedback


@pytest.mark.parametrize(("seed", "rows"), [(0, 2), (0, 5), (1, 2), (1, 5)])
def test_a_controller_that_holds_its_input_is_a_feedback(seed, rows):
    (timing,) = km.validate.audit(held(seed, rows, gain=2.0, noise=0.05)).timing
    assert timing.feedback


@pytest.mark.slow
def test_counts_of_records_whose_feedback_disturbances_drive():
    tasks = [(seed, kind, r) for seed in range(30) for kind in ("P", "PI", "PD", "PID") for r in (0.0, 0.1, 1.0)]
    assert sum(same_row(disturbed(*task)) for task in tasks) <= len(tasks) // 100


@pytest.mark.slow
def test_counts_of_open_loop_records_at_20_db():
    assert sum(same_row(record(seed, late=True)) for seed in range(100)) >= 95
    assert sum(same_row(record(seed)) for seed in range(300)) == 0


@pytest.mark.parametrize("kind", ["P", "PI"])
@pytest.mark.parametrize(
    "seeds", [range(4), pytest.param(range(4, 54), marks=pytest.mark.slow)], ids=["a few", "fifty"]
)
def test_under_feedback_the_audit_cannot_say(kind, seeds):
    for seed in seeds:
        report = km.validate.audit(record(seed, feedback=kind))
        assert [one.timing.name for one in report.timing] == ["UNKNOWN"], (seed, report.timing)
        assert report.same_row == ()


def test_under_feedback_the_report_says_so_and_what_to_record():
    report = km.validate.audit(record(1, feedback="P"))
    text = " ".join(str(report).split())
    assert "cannot say whether u acts within its own row" in text
    assert "record it once without the controller, or with a test signal of your own added to it" in text


def test_the_test_is_exact_whatever_the_noise_and_the_units():
    """White noise of any size on y leaves the t value of an input in time small, and scales change nothing."""
    rng = np.random.default_rng(4)
    u = rng.normal(size=2000)
    x = signal.lfilter([0, 1.0, 0.5], [1, -1.2, 0.4], u)
    for size in (0.0, 0.1, 3.0):
        y = x + size * rng.normal(size=len(u))
        for scale in (1.0, 1e6):
            data = km.Episodes([km.Episode(X=scale * y[:, None], U=u[:-1, None] / scale)], 1.0)
            (timing,) = km.validate.audit(data).timing
            assert timing.timing.name == "NEXT_ROW" if size else timing.timing.name != "SAME_ROW"
            late = km.Episodes([km.Episode(X=scale * y[1:, None], U=u[:-2, None] / scale)], 1.0)
            (timing,) = km.validate.audit(late).timing
            assert timing.timing.name == "SAME_ROW"


def test_a_record_of_one_sensor_whose_input_is_late_is_audited():
    """Its only input is found late; no other signal is left that could be late too."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=1500)
    y = signal.lfilter([0, 0, 0, 1.0], [1, -0.8], u) + 0.5 * signal.lfilter([1], [1, -0.9], rng.normal(size=1500))
    (fault,) = km.validate.audit(km.Episodes([km.Episode(X=y[:, None], U=u[:-1, None])], 1.0)).faults
    assert (fault.name, fault.steps) == ("input delay", 2)
