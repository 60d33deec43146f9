"""Snyder & Song (2021), reproduced."""

from koopmpc.papers.snyder.paper import paper as paper
