"""Families of deformation models other than finite elements, for the same anatomies, loads and effects."""
