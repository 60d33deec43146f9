"""The site, built once for all tests that read it."""

import os
import subprocess
import sys

import pytest

from koopmpc.control.solvers import SOLVERS
from koopmpc.data.files import formats
from tests.docs.page import DOCS


@pytest.fixture(autouse=True)
def registries_of_pages(monkeypatch):
    """Forget what the blocks of a page register: other tests of the process would meet it."""
    formats.list_suffixes()  # the library's own are registered now
    monkeypatch.setattr(formats, "_FORMATS", dict(formats._FORMATS))
    solvers = dict(SOLVERS)
    yield
    SOLVERS.clear()
    SOLVERS.update(solvers)


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """Return the folder of the site, built strictly."""
    pytest.importorskip("material", reason="the extra docs is not installed")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    subprocess.run(command, cwd=DOCS.parent, check=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    return folder
