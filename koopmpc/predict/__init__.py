"""Lifted predictors, their spectrum and their score."""
