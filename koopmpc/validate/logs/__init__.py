"""What is wrong with logs before a model is fitted to them: a kind of evidence a file; `audit` runs all checks."""
