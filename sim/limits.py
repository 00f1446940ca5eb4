"""How much a file may hold before it is refused: a file from outside decides nothing about memory."""

from __future__ import annotations

# Deflate, the packing of .npz, .nii.gz, .vtu and HDF5, makes at most 1,032 bytes of one: more is declared, not stored.
INFLATION = 1032
# One array [bytes]: quadratic tetrahedra (10 numbers of 8 bytes) of the finest brain meshes in use, 10 million, take
# 0.8 GB.
LARGEST_ARRAY = 2 * 1024**3
# All arrays of a mesh file, inflated [bytes]: nodes, cells, and a few fields beside them.
LARGEST_MESH = 4 * 1024**3
# All arrays of a model file, inflated [bytes]: the shipped one, of seven learners, has 0.04 GB.
LARGEST_MODEL = 2 * 1024**3
# Text that heads a model file [bytes]: the shipped one has 0.02 MB.
LARGEST_HEADER = 16 * 1024**2
# Voxels of one volume: a head of 200 mm at 0.25 mm has as many.
MOST_VOXELS = 2**29
