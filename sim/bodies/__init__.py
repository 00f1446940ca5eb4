"""Anatomies from an image, a label volume, the template or a mesh file."""
