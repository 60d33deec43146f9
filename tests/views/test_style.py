"""One look for all figures; files that are the same each time; no state of pyplot."""

import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

import koopmpc as km
from tests.views.models import episodes, turning


def _drawn():
    return km.plot.rollout(turning(), episodes(1)[0], bands=np.full((30, 2), 0.3))


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_the_same_figure_is_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    first, second = tmp_path / "a" / "b" / f"one{suffix}", tmp_path / f"two{suffix}"
    km.plot.save(_drawn(), first)
    km.plot.save(_drawn(), second)
    assert first.read_bytes() == second.read_bytes()
    assert len(first.read_bytes()) > 1000


def test_pictures_of_lines_are_small_and_look_the_same(tmp_path: Path) -> None:
    made = _drawn()
    km.plot.save(made, tmp_path / "a.png")
    made.axes[0].scatter([], [], c=[])  # a picture with shades keeps all colours
    km.plot.save(made, tmp_path / "full.png")
    small, full = Image.open(tmp_path / "a.png"), Image.open(tmp_path / "full.png")
    assert (tmp_path / "a.png").stat().st_size < 0.6 * (tmp_path / "full.png").stat().st_size
    assert small.size == full.size
    assert small.info["dpi"] == pytest.approx((200, 200), abs=0.1)
    away = np.abs(np.asarray(small.convert("RGB"), float) - np.asarray(full.convert("RGB"), float))
    assert away.mean() < 0.5


def test_a_users_settings_change_nothing_and_come_back(tmp_path: Path) -> None:
    km.plot.save(_drawn(), tmp_path / "a.png")
    with mpl.rc_context({"lines.linewidth": 9.0, "font.size": 30.0}):
        km.plot.save(_drawn(), tmp_path / "b.png")
        assert (mpl.rcParams["lines.linewidth"], mpl.rcParams["font.size"]) == (9.0, 30.0)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(("width", "inches"), [("one column", 3.5), ("two columns", 7.16)])
def test_figures_are_as_wide_as_columns(width, inches: float) -> None:
    made = km.plot.rollout(turning(), episodes(1)[0], width=width)
    assert made.get_size_inches()[0] == pytest.approx(inches)


def test_curves_differ_in_more_than_colour() -> None:
    of = km.score(turning(0.9), episodes(), 10)
    panel = km.plot.error({f"model {i}": of for i in range(6)}).axes[0]
    curves = [curve for curve in panel.get_lines() if str(curve.get_label()).endswith("RMSE")]
    assert len(curves) == 6
    assert len({curve.get_marker() for curve in curves}) == 6
    assert len({curve.get_color() for curve in curves}) == 6
    assert len({str(curve._unscaled_dash_pattern) for curve in curves}) == 6


def test_neither_the_library_nor_its_figures_import_pyplot(tmp_path: Path) -> None:
    code = f"""
import sys
import koopmpc as km
model = km.LinearPredictor([[0.5]], [[1.0]], [[1.0]], km.State(), 0.1, ["x"], ["u"])
km.plot.spectrum
assert "matplotlib" not in sys.modules
km.plot.save(km.plot.spectrum(model), {str(tmp_path / "a.svg")!r})
assert "matplotlib.pyplot" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
