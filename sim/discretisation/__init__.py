"""Elements, constraints, footprints, the Term interface, and the problem as a sum of terms."""
