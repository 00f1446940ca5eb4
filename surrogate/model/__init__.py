"""Trained models: the deformer, its error bounds, its training range, and its file format."""
