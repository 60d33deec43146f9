"""What changes from step to step: limits as rows, and the right-hand sides that follow from them."""
