"""From a controller to C: `export` writes the sources, `compiled` runs them behind the Controller protocol."""
