"""What the surgeon sees: triangles and cameras in, pixels out. Knows no brain."""
