"""Terminal sets: where a plan has to end, as a polytope or an ellipsoid of the lifted state."""
