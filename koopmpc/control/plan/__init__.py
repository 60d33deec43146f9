"""What is asked, a model and a horizon → Program: all that is computed before the first step."""
