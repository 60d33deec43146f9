"""Program and reading → Move: what a controller does at each step, of arrays and numbers alone."""
