"""A model's log: what it shows can be read back, to the bit."""

from functools import cache
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

import koopmpc as km
from koopmpc.views.figures.eigenvalues import evaluate_eigenfunctions, make_plane
from koopmpc.views.figures.style import SEQUENTIAL
from koopmpc.views.recording.eigenvalues import draw_eigenvalues
from koopmpc.views.recording.model import load_model_log
from koopmpc.views.recording.reader import LogColumns, read_columns
from tests.views.models import DT, INPUTS, STATES, episodes, turning
from tests.views.viewing import drawn

DATA = episodes(24, noise=0.05)
BILINEAR = km.BilinearPredictor(
    turning().A, turning().B, np.zeros((1, 2, 2)), np.eye(2), km.State(), DT, STATES, INPUTS
)
DEFECTIVE = km.LinearPredictor([[0.9, 1.0], [0.0, 0.9]], [[0.0], [1.0]], np.eye(2), km.State(), DT, STATES, INPUTS)


@pytest.fixture(scope="module")
def report() -> km.validate.TrustReport:
    return km.trust(turning(0.9), DATA, 12)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, report: km.validate.TrustReport) -> Path:
    path = tmp_path_factory.mktemp("model") / "deep" / "model.rrd"
    km.recording.record_model(turning(0.9), DATA, path, report=report, which=[0], rollouts=2)
    return path


@cache
def _whole(path: Path, written: int) -> LogColumns:
    return read_columns(path, ("/**",))


def _read(path: Path) -> LogColumns:
    """Return the columns of a log, which are read once."""
    return _whole(path, path.stat().st_mtime_ns)


def test_forecasts_are_read_back_to_the_bit(log: Path, report: km.validate.TrustReport) -> None:
    for r in range(2):
        ahead = km.validate.forecast(turning(0.9), DATA[r], 12, bands=report.band)
        found = _read(log)
        for i in range(2):
            curves = found.vectors(f"/rollout/{r}/state/{i}")
            wanted = [ahead.predicted, ahead.low, ahead.high, ahead.truth]
            assert np.array_equal(curves, np.column_stack([one[:, i] for one in wanted]))
        assert np.array_equal(found.vectors(f"/rollout/{r}/inputs"), ahead.U)
    assert not len(_read(log).vectors("/rollout/2/state/0"))


def test_the_error_is_the_score(log: Path, report: km.validate.TrustReport) -> None:
    for i in range(2):
        k, values = _read(log).matrix(f"/error/{i}")
        assert np.array_equal(k, np.arange(1, 13))
        s = report.score
        assert np.array_equal(values, np.column_stack([s.rmse[:, i], s.low[:, i], s.high[:, i]]))


def _all(path: Path, entity: str, component: str) -> list:
    """Return every instance of a static component."""
    return _read(path).rows(entity, component)[2].to_pylist()


def _points(path: Path, entity: str) -> np.ndarray:
    return np.array(_all(path, entity, "positions"), dtype=float)


def test_eigenvalues_stand_upright_with_their_residuals(log: Path, report: km.validate.TrustReport) -> None:
    at = _points(log, "/model/eigenvalues")
    found = report.residuals.eigenvalues
    assert at[:, 0] - 1j * at[:, 1] == pytest.approx(found, abs=1e-6)  # y is down
    labels = _all(log, "/model/eigenvalues", "labels")
    assert all(f"residual {r:.2g}" in text for r, text in zip(report.residuals.residuals, labels, strict=True))
    spurious = report.residuals.spurious
    assert spurious.all()
    assert len(_points(log, "/model/spurious")) == spurious.sum()
    (turn,) = (np.array(strip) for strip in _all(log, "/model/circle", "strips"))
    assert np.hypot(*turn.T) == pytest.approx(1.0, abs=1e-6)


def test_points_are_darker_the_smaller_their_residual_over_the_whole_scale() -> None:
    shares = np.array([1e-3, 1e-2, 10**-0.5, 10.0, 1e3])  # of the tolerance; below 1/100 and above 10 nothing changes
    found = km.validate.ResidualDMD(0.1j * np.arange(5), 0.2 * shares, tolerance=0.2, samples=9)
    drawn = draw_eigenvalues(turning(0.9), found)["model/eigenvalues"]
    colors = np.array(drawn.colors.as_arrow_array().to_pylist(), dtype=np.uint32)
    shades = mpl.colormaps[SEQUENTIAL](0.85 * np.array([0.0, 0.0, 0.5, 1.0, 1.0]), bytes=True)
    np.testing.assert_array_equal(colors >> 8, shades[:, :3] @ [1 << 16, 1 << 8, 1])


def test_pictures_are_the_eigenfunctions_with_the_second_state_upwards(log: Path) -> None:
    plane = make_plane(STATES, (0, 1), DATA, points=181)
    (phi,) = evaluate_eigenfunctions(turning(0.9), 0, plane)
    scaled = {"magnitude": ("viridis", np.abs(phi)), "phase": ("twilight", np.angle(phi) / (2 * np.pi) + 0.5)}
    for part, (scale, values) in scaled.items():
        entity = f"/eigenfunction/0/{part}/picture"
        (pixels,) = [_read(log).static(entity, "buffer")]
        drawn = np.asarray(pixels, dtype=np.uint8).reshape(181, 181, 3)
        assert np.array_equal(drawn[::-1], mpl.colormaps[scale](values, bytes=True)[..., :3])
        words = _all(log, f"/eigenfunction/0/{part}/axes", "labels")
        assert set(STATES) <= set(words)


def test_the_report_is_a_page(log: Path, report: km.validate.TrustReport) -> None:
    page = _read(log).static("/report", "text")
    assert str(report) in page
    assert f"| observables | 2: {', '.join(STATES)} |" in page


def test_a_whole_log_is_read_without_another_process_and_a_damaged_one_is_not(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def started(*_: object, **__: object) -> None:
        raise ChildProcessError

    content, damaged = log.read_bytes(), tmp_path / "damaged.rrd"
    value = np.float64(load_model_log(log).forecasts[0, 0][0][5]).tobytes()
    assert content.count(value) == 1
    damaged.write_bytes(content.replace(value, np.float64(0.5).tobytes()))
    with pytest.raises(km.errors.LogError, match="no longer holds what was written"):
        load_model_log(damaged)
    monkeypatch.setattr("koopmpc.views.recording.rrd.subprocess.run", started)
    assert load_model_log(log).states == STATES


def test_a_log_of_a_model_that_lost_its_end_is_never_read_in_silence(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.rrd", tmp_path / "cut.rrd"
    km.recording.record_model(turning(), episodes(3, noise=0.05), whole)
    content = whole.read_bytes()
    cut.write_bytes(content[: len(content) // 2])  # behind all curves, before the checksum
    with pytest.warns(UserWarning, match="its end is cut"):
        assert load_model_log(cut).states == STATES
    cut.write_bytes(content[: -len(content) // 20])
    with pytest.raises(km.errors.LogError, match="no longer holds what was written"):
        load_model_log(cut)


def test_without_a_report_the_band_is_that_of_the_errors(tmp_path: Path) -> None:
    data = episodes(3, noise=0.05)
    km.recording.record_model(turning(), data, tmp_path / "a.rrd")
    errors = km.score(turning(), data, 30)
    ahead = km.validate.forecast(turning(), data[2], 30, bands=errors)
    curves = _read(tmp_path / "a.rrd").vectors("/rollout/2/state/1")
    assert np.array_equal(curves[:, 1], ahead.low[:, 1])
    assert len(_points(tmp_path / "a.rrd", "/model/eigenvalues")) == 2


def test_what_has_no_eigenfunctions_says_so(tmp_path: Path) -> None:
    data = episodes(2)
    for model, words in ((BILINEAR, "has no eigenfunctions"), (DEFECTIVE, "A is defective")):
        km.recording.record_model(model, data, tmp_path / "a.rrd", horizon=5)
        assert words in _read(tmp_path / "a.rrd").static("/report", "text")
    one = km.LinearPredictor([[0.9]], [[1.0]], [[1.0]], km.State(), DT, STATES[:1], INPUTS)
    small = km.Episodes([type(e)(X=e.X[:, :1], U=e.U) for e in data], DT, STATES[:1], INPUTS)
    km.recording.record_model(one, small, tmp_path / "b.rrd", horizon=5)
    assert "has one state" in _read(tmp_path / "b.rrd").static("/report", "text")


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
    page = _read(tmp_path / "a.rrd").static("/report", "text")
    assert r"angle^2, angle\*rate, rate^2" in page


def test_a_model_that_runs_away_is_recorded_too(tmp_path: Path) -> None:
    data = episodes(3)
    wild = turning(1e12)
    km.recording.record_model(wild, data, tmp_path / "a.rrd", rollouts=1)
    curves = _read(tmp_path / "a.rrd").vectors("/rollout/0/state/0")
    assert np.array_equal(curves[:, [0, -1]], _two(km.validate.forecast(wild, data[0], 30)), equal_nan=True)
    assert np.isnan(curves[-1, 1])


def _two(ahead) -> np.ndarray:
    return np.column_stack([ahead.predicted[:, 0], ahead.truth[:, 0]])
