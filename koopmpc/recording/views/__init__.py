"""Views of the Rerun viewer: blueprint, scenes, curves, eigenvalues."""
