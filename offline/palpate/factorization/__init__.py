"""Sparse symmetric factorization: one interface to the direct solvers that are installed."""

from palpate.factorization.symmetric import SymmetricFactor, factorize, solver_name

__all__ = ["SymmetricFactor", "factorize", "solver_name"]
