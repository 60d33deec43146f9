"""Plants: dynamics, integrators, step maps."""
