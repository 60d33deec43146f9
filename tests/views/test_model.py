"""A model's log: what it shows can be read back, to the bit."""

from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

import koopmpc as km
from tests.views.logged import Logged
from tests.views.models import BILINEAR, DEFECTIVE, DT, INPUTS, STATES, episodes, turning
from tests.views.viewing import drawn

DATA = episodes(24, noise=0.05)


@pytest.fixture(scope="module")
def report() -> km.validate.TrustReport:
    return km.trust(turning(0.9), DATA, 12)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, report: km.validate.TrustReport) -> Path:
    path = tmp_path_factory.mktemp("model") / "deep" / "model.rrd"
    km.recording.record_model(turning(0.9), DATA, path, report=report, which=[0], rollouts=2)
    return path


@pytest.fixture(scope="module")
def logged(log: Path) -> Logged:
    return Logged(log)


def test_forecasts_are_read_back_to_the_bit(logged: Logged, report: km.validate.TrustReport) -> None:
    for r in range(2):
        ahead = km.validate.forecast(turning(0.9), DATA[r], 12, bands=report.band)
        for i in range(2):
            _, curves = logged.matrix(f"rollout/{r}/state/{i}")
            wanted = [ahead.predicted, ahead.low, ahead.high, ahead.truth]
            assert np.array_equal(curves, np.column_stack([one[:, i] for one in wanted]))
        assert np.array_equal(logged.matrix(f"rollout/{r}/inputs")[1], ahead.U)
    assert "rollout/2/state/0" not in logged.entities


def test_the_error_is_the_score(logged: Logged, report: km.validate.TrustReport) -> None:
    for i in range(2):
        k, values = logged.matrix(f"error/{i}")
        assert np.array_equal(k, np.arange(1, 13))
        s = report.score
        assert np.array_equal(values, np.column_stack([s.rmse[:, i], s.low[:, i], s.high[:, i]]))


def _points(log: Logged, entity: str) -> np.ndarray:
    return np.array(log.static(entity, "positions"), dtype=float)


def test_eigenvalues_stand_upright_with_their_residuals(logged: Logged, report: km.validate.TrustReport) -> None:
    at = _points(logged, "model/eigenvalues")
    found = report.residuals.eigenvalues
    assert at[:, 0] - 1j * at[:, 1] == pytest.approx(found, abs=1e-6)  # y is down
    labels = logged.static("model/eigenvalues", "labels")
    assert all(f"residual {r:.2g}" in text for r, text in zip(report.residuals.residuals, labels, strict=True))
    spurious = report.residuals.spurious
    assert spurious.all()
    assert len(_points(logged, "model/spurious")) == spurious.sum()
    (turn,) = (np.array(strip) for strip in logged.static("model/circle", "strips"))
    assert np.hypot(*turn.T) == pytest.approx(1.0, abs=1e-6)


def test_points_are_darker_the_smaller_their_residual_over_the_whole_scale(
    tmp_path: Path, report: km.validate.TrustReport
) -> None:
    shares = np.array([1e-3, 1e-2, 10**-0.5, 10.0, 1e3])  # of the tolerance; below 1/100 and above 10 nothing changes
    found = km.validate.ResidualDMD(0.1j * np.arange(5), 0.2 * shares, tolerance=0.2, samples=9)
    km.recording.record_model(turning(0.9), DATA, tmp_path / "a.rrd", report=replace(report, residuals=found))
    colors = np.array(Logged(tmp_path / "a.rrd").static("model/eigenvalues", "colors"), dtype=np.uint32)
    shades = mpl.colormaps["viridis"](0.85 * np.array([0.0, 0.0, 0.5, 1.0, 1.0]), bytes=True)
    np.testing.assert_array_equal(colors >> 8, shades[:, :3] @ [1 << 16, 1 << 8, 1])


def test_pictures_are_the_eigenfunctions_with_the_second_state_upwards(logged: Logged) -> None:
    X = np.vstack([episode.X for episode in DATA])
    across, up = np.meshgrid(*(np.linspace(*ends, 181) for ends in zip(X.min(axis=0), X.max(axis=0), strict=True)))
    phi = np.stack([across, up], axis=-1) @ turning(0.9).left_eigenvectors[0]  # ψ(x) = x
    magnitude, turns = np.abs(phi) / np.abs(phi).max(), np.angle(phi) / (2 * np.pi) + 0.5
    for part, scale, values in (("magnitude", "viridis", magnitude), ("phase", "twilight", turns)):
        (pixels,) = logged.static(f"eigenfunction/0/{part}/picture", "buffer")
        drawn = np.asarray(pixels, dtype=np.uint8).reshape(181, 181, 3)[::-1]
        near = [mpl.colormaps[scale](values + off, bytes=True)[..., :3] for off in (0.0, -1e-12, 1e-12)]
        assert np.any([(drawn == shades).all(axis=-1) for shades in near], axis=0).all()  # rounding at a shade's edge
        assert set(STATES) <= set(logged.static(f"eigenfunction/0/{part}/axes", "labels"))


def test_the_report_is_a_page(logged: Logged, report: km.validate.TrustReport) -> None:
    (page,) = logged.static("report", "text")
    assert str(report) in page
    assert f"| observables | 2: {', '.join(STATES)} |" in page


def test_a_damaged_log_of_a_model_and_one_that_lost_its_end_are_told(log: Path, tmp_path: Path) -> None:
    content, path = log.read_bytes(), tmp_path / "model.rrd"
    value = np.float64(km.validate.forecast(turning(0.9), DATA[0], 12).predicted[5, 0]).tobytes()
    assert content.count(value) == 1
    for data, told in (
        (content.replace(value, np.float64(0.5).tobytes()), "no longer holds what was written"),
        (content[: len(content) // 10], "was cut before it"),
    ):
        path.write_bytes(data)
        (found,) = km.bench.inspect_logs([path])
        assert told in found.refused


def test_without_a_report_the_band_is_that_of_the_errors(tmp_path: Path) -> None:
    data = episodes(3, noise=0.05)
    km.recording.record_model(turning(), data, tmp_path / "a.rrd")
    errors = km.score(turning(), data, 30)
    ahead = km.validate.forecast(turning(), data[2], 30, bands=errors)
    log = Logged(tmp_path / "a.rrd")
    assert np.array_equal(log.matrix("rollout/2/state/1")[1][:, 1], ahead.low[:, 1])
    assert len(_points(log, "model/eigenvalues")) == 2


def test_what_has_no_eigenfunctions_says_so(tmp_path: Path) -> None:
    data = episodes(2)
    for model, words in ((BILINEAR, "has no eigenfunctions"), (DEFECTIVE, "A is defective")):
        km.recording.record_model(model, data, tmp_path / "a.rrd", horizon=5)
        assert words in Logged(tmp_path / "a.rrd").static("report", "text")[0]
    one = km.LinearPredictor([[0.9]], [[1.0]], [[1.0]], km.State(), DT, STATES[:1], INPUTS)
    small = km.Episodes([type(e)(X=e.X[:, :1], U=e.U) for e in data], DT, STATES[:1], INPUTS)
    km.recording.record_model(one, small, tmp_path / "b.rrd", horizon=5)
    assert "has one state" in Logged(tmp_path / "b.rrd").static("report", "text")[0]


@pytest.mark.slow
def test_the_viewer_draws_every_view(log: Path, tmp_path: Path) -> None:
    views = drawn(log, tmp_path / "model.png", at=0.5)
    assert {v.name for v in views} >= {STATES[0], INPUTS[0], "Eigenvalues, unit circle", "Report"}
    assert [v for v in views if v.reports] == []
    assert (tmp_path / "model.png").stat().st_size > 20_000


def test_names_that_markdown_would_change_stand_as_they_are(tmp_path: Path) -> None:
    data = episodes(2)
    model = km.edmd(data, km.State() + km.State() * km.State())
    km.recording.record_model(model, data, tmp_path / "a.rrd", horizon=5)
    page = Logged(tmp_path / "a.rrd").static("report", "text")[0]
    assert r"angle^2, angle\*rate, rate^2" in page


def test_a_model_that_runs_away_is_recorded_too(tmp_path: Path) -> None:
    data = episodes(3)
    wild = turning(1e12)
    km.recording.record_model(wild, data, tmp_path / "a.rrd", rollouts=1)
    curves = Logged(tmp_path / "a.rrd").matrix("rollout/0/state/0")[1]
    ahead = km.validate.forecast(wild, data[0], 30)
    both = np.column_stack([ahead.predicted[:, 0], ahead.truth[:, 0]])
    assert np.array_equal(curves[:, [0, -1]], both, equal_nan=True)
    assert np.isnan(curves[-1, 1])
