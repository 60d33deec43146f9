"""README's first command: pip installs koopmpc from git into a fresh environment, and the second one runs there."""

import json
import os
import shutil
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


@pytest.mark.parametrize(
    ("source", "told"),
    [
        (
            {"url": "https://example.org/k.git", "vcs_info": {"vcs": "git", "commit_id": "0"}},
            "'koopmpc[fmu] @ git+https://example.org/k.git'",
        ),
        (None, "'koopmpc[fmu]'"),
    ],
)
def test_a_hint_installs_an_extra_from_where_koopmpc_came(
    source: dict[str, object] | None, told: str, tmp_path: Path
) -> None:
    skipped = shutil.ignore_patterns("__pycache__", "measured.json", "*.c")
    shutil.copytree(ROOT / "koopmpc", tmp_path / "koopmpc", ignore=skipped)
    about = tmp_path / "koopmpc-0.1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: koopmpc\nVersion: 0.1.0\n")
    if source is not None:
        (about / "direct_url.json").write_text(json.dumps(source))
    code = (
        "import sys; sys.path.insert(0, '.'); sys.modules['fmpy'] = None\nimport koopmpc as km\n"
        "try:\n    km.plants.fmu('a.fmu')\nexcept ImportError as error:\n    print(error)"
    )
    assert f"which is not installed: pip install {told}\n" in _run(sys.executable, "-c", code, within=tmp_path)
