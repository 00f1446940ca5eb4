"""Episodes out of files: what each array is, windows of frames, and the same for PyTorch."""
