"""Reading of episode files: array specifications, windows of frames, and PyTorch data sets."""
