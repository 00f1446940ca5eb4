"""Rendering of surfaces to images with a lamp, shadows and textures."""
