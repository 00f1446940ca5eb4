"""Stereo vision: rectification, disparity and depth, tracked points."""
