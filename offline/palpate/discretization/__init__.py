"""Discretizations of linear elasticity on a node cloud; they assemble, and solve nothing."""
