"""Printed targets: their layout, detection in camera images, and poses of camera and tool computed from images."""
