"""What regressions share: the frame of a fit, Levenberg-Marquardt, variable projection."""
