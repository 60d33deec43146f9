"""Predictive control on lifted linear models."""
