"""Stereo vision: rectification, disparity and depth, and tracking of points between images."""
