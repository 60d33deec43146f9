"""What people look at: figures and recordings."""
