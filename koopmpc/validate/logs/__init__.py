"""Checks of logs before a model is fitted to them; each file holds one kind of evidence, and `audit` runs them all."""
