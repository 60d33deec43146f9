"""One regression a file."""
