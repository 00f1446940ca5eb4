"""Trained models: a deformer, its bounds, its training range, and its file."""
