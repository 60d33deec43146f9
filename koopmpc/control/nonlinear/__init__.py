"""Predictive control on nonlinear maps."""
