"""Export of deformed brains to other programs: displacement fields, images, meshes, markups, segmentations."""
