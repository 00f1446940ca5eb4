"""Overlay of a hidden surface on a camera image: styles, lines and text."""
