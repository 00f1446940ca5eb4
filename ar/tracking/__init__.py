"""Printed targets: layout, detection in camera images, and poses of camera and tool computed from them."""
