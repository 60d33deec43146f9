"""Episodes: excitation, collection, files."""
