"""Tests run with every jaxtyping shape checked: the hook must come before the first import of koopmpc."""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

from hypothesis import settings
from jaxtyping import install_import_hook

import tests.typecheck  # noqa: F401  # the hook looks it up by name

if not os.environ.get("KOOPMPC_NO_TYPE_HOOK"):  # tests/speed measures what users run
    install_import_hook("koopmpc", "tests.typecheck.beartyped")

settings.register_profile("default", deadline=None, max_examples=30, derandomize=True)
settings.load_profile("default")
