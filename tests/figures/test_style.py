"""One look for all figures; files that are the same each time; no state of pyplot."""

import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

import koopmpc as km
from koopmpc.figures.style import WIDTHS, band, figure, line, styled


@styled
def _drawn():
    made, axes = figure(2, 1)
    x = np.linspace(0, 1, 50)
    axes[0, 0].plot(x, x**2, **line(0, 50))
    band(axes[1, 0], x, x - 1, x + 1, 1)
    return made


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_the_same_figure_is_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    first, second = tmp_path / "a" / "b" / f"one{suffix}", tmp_path / f"two{suffix}"
    km.figures.save(_drawn(), first)
    km.figures.save(_drawn(), second)
    assert first.read_bytes() == second.read_bytes()
    assert len(first.read_bytes()) > 1000


def test_pictures_of_lines_are_small_and_look_the_same(tmp_path: Path) -> None:
    made = _drawn()
    km.figures.save(made, tmp_path / "a.png")
    styled(lambda: made.savefig(tmp_path / "full.png"))()
    small, full = Image.open(tmp_path / "a.png"), Image.open(tmp_path / "full.png")
    assert (tmp_path / "a.png").stat().st_size < 0.6 * (tmp_path / "full.png").stat().st_size
    assert small.size == full.size
    assert small.info["dpi"] == pytest.approx((200, 200), abs=0.1)
    away = np.abs(np.asarray(small.convert("RGB"), float) - np.asarray(full.convert("RGB"), float))
    assert away.mean() < 0.5


def test_a_users_settings_change_nothing_and_come_back(tmp_path: Path) -> None:
    km.figures.save(_drawn(), tmp_path / "a.png")
    with mpl.rc_context({"lines.linewidth": 9.0, "font.size": 30.0}):
        km.figures.save(_drawn(), tmp_path / "b.png")
        assert mpl.rcParams["lines.linewidth"] == 9.0
        assert styled(lambda: mpl.rcParams["font.size"])() == 8.0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("width", list(WIDTHS))
def test_figures_are_as_wide_as_columns(width) -> None:
    assert figure(width=width, height=2.0)[0].get_size_inches() == pytest.approx([WIDTHS[width], 2.0])


def test_curves_differ_in_more_than_colour() -> None:
    looks = [line(i, 40) for i in range(6)]
    assert len({str(look["linestyle"]) for look in looks}) == 6
    assert len({look["marker"] for look in looks}) == 6
    assert len({look["color"] for look in looks}) == 6


def test_neither_the_library_nor_its_figures_import_pyplot(tmp_path: Path) -> None:
    code = f"""
import sys
import koopmpc.figures.style as style
assert "matplotlib" not in sys.modules
made, axes = style.figure()
axes[0, 0].plot([0, 1], [0, 1])
style.save(made, {str(tmp_path / "a.svg")!r})
assert "matplotlib.pyplot" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
