"""The closed loop: simulate, Run, metrics."""
