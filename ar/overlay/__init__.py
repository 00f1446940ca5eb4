"""Overlay of the hidden surface on the image: styles, lines and text."""
