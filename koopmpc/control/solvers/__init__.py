"""QP solvers behind one small interface."""
