"""Elements, constraints, tool footprints, the interface `Term`, and boundary value problems as sums of terms."""
