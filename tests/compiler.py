"""The C compiler that koopmpc finds, for tests that compile what it wrote or that need machine code."""

from koopmpc.plants.routines import find_compiler as find_compiler
