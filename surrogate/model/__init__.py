"""Learned models: a deformer, its bounds, its range, and its file."""
