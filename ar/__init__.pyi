"""What the surgeon sees: triangles and cameras in, pixels out. Knows no brain."""

from .browser import Browser
from .camera import Camera, look_at
from .layer import Layer, Solid
from .overlay import composite
from .rasteriser import rasterise
from .renderer import Picture, render
from .screen import read_png, write_png, write_video

__all__ = [
    "Browser",
    "Camera",
    "Layer",
    "Picture",
    "Solid",
    "composite",
    "look_at",
    "rasterise",
    "read_png",
    "render",
    "write_png",
    "write_video",
]
