"""Closed loops on surrogates of the plant: those that judge candidates, and fresh ones after the choice."""
