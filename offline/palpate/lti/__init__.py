"""Linear time-invariant systems in pole-residue form."""
