"""Discretizations of linear elasticity on a node cloud: the conservative one for organs, the paper's for comparison."""
