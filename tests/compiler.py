"""The C compiler that koopmpc finds, for tests that compile what it wrote or that need machine code."""

import pytest

from koopmpc.plants.routines import find_compiler as find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
