"""Estimate: where the lifted state is, and what disturbs it."""
