"""Elements, constraints, footprints, the Term protocol and the sum of terms, a problem."""
