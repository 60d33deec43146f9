"""Snyder & Song (2021), reproduced."""
