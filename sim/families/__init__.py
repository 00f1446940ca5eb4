"""Families of deformation models other than finite elements, on the same anatomies, loads and effects."""
