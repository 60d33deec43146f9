"""What is asked of a controller: cost, limits, levels, terminal sets. Frozen data that knows no model."""
