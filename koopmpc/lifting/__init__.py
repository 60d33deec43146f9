"""Observables ψ(x): one family a file."""
