"""Bodies: a state, one step, the surface read-out."""
