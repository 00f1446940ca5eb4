"""Report of the accuracy and computation time of deformation models."""
