"""Derivatives of an equilibrium by the adjoint method: one linear solve for any number of parameters."""
