"""What the surgeon sees: triangles and cameras in, pixels out. Knows no brain."""

from .optics.camera import Camera, look_at, stereo_pair
from .optics.lens import Lens
from .overlay.composite import Overlaid, composite
from .page.browser import Browser
from .rendering.layer import Layer, Solid
from .rendering.rasteriser import rasterise
from .rendering.renderer import Lamp, Picture, Pictures, Renderer, lamp_beside, render
from .screen import read_png, write_png, write_video

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
