"""What limits are made of: boxes, softness, and the checks of a user's numbers."""
