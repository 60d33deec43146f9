"""Fits whose matrices are bounded: by priors on their entries, or inside a circle."""
