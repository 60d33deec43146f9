"""Papers done again: one file a paper, each a list of figures, numbers and claims with a verdict."""
