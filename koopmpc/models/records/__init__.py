"""Fits for measured records: few outputs, a past instead of a state; structures chosen by free runs."""
