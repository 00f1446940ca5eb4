"""Printed targets: what they look like, where a camera sees them, and what that says of camera and tool."""
