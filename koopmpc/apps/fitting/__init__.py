"""From logs to a model with its report."""
