"""What the surgeon sees: triangles and cameras in, pixels out. Knows no brain."""

from .browser import Browser
from .camera import Camera, look_at
from .layer import Layer, Solid
from .lens import Lens
from .overlay import Overlaid, composite
from .rasteriser import rasterise
from .renderer import Lamp, Picture, Pictures, Renderer, lamp_beside, render
from .screen import read_png, write_png, write_video
from .stereo import stereo_pair

__all__ = [
    "Browser",
    "Camera",
    "Lamp",
    "Layer",
    "Lens",
    "Overlaid",
    "Picture",
    "Pictures",
    "Renderer",
    "Solid",
    "composite",
    "lamp_beside",
    "look_at",
    "rasterise",
    "read_png",
    "render",
    "stereo_pair",
    "write_png",
    "write_video",
]
