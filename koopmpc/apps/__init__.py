"""Whole tasks: bench, fit and check, papers, and the command line."""
