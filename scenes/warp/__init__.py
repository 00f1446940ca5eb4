"""Deformed brains in the files of other programs: fields, images, meshes, markups, segmentations."""
