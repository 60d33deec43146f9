"""README's first command: pip installs koopmpc from git into a fresh environment, and the second one runs there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CONTROLLERS = ("koopman-mpc", "nonlinear-mpc")


def _run(*command: str | Path, within: Path) -> str:
    """Return what a command prints; PYTHONPATH is left out, which would let it find this checkout."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHONPATH", "KOOPMPC_"))}
    done = subprocess.run([str(c) for c in command], cwd=within, env=clean, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="this is no git checkout")
def test_the_package_is_installed_from_git_with_pip_and_its_problems_come_with_it(tmp_path: Path) -> None:
    _run(sys.executable, "-m", "venv", tmp_path / "venv", within=tmp_path)
    tools = tmp_path / "venv" / ("Scripts" if sys.platform == "win32" else "bin")
    _run(tools / "python", "-m", "pip", "install", "--quiet", f"git+{ROOT.as_uri()}", within=tmp_path)
    known = set(_run(tools / "koopmpc", "list", within=tmp_path).split())
    assert {path.stem for path in (ROOT / "problems").glob("*.py")} <= known
    chosen = [argument for name in CONTROLLERS for argument in ("-c", name)]
    table = _run(tools / "koopmpc", "run", "pendulum:upright", *chosen, within=tmp_path)
    assert all(name in table for name in CONTROLLERS)
    assert len(list((tmp_path / "logs").glob("*/*.rrd"))) == len(CONTROLLERS)
    said = _run(tools / "python", "-c", "import koopmpc as km; print(km.errors.install('video'))", within=tmp_path)
    assert said == "pip install 'koopmpc[video]'\n"
    found = _run(tools / "python", "-m", "pip", "install", "--dry-run", "koopmpc[video]", within=tmp_path)
    assert "Would install imageio-ffmpeg" in found  # pip adds to the koopmpc that came from git
