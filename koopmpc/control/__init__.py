"""LQR, Koopman MPC, nonlinear MPC."""
