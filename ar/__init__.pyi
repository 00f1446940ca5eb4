"""What the surgeon sees: triangles and cameras in, pixels out. Knows no brain."""

from .optics.camera import Camera, build_stereo_pair, look_at
from .optics.lens import Lens
from .overlay.composite import Overlaid, composite
from .page.browser import Browser
from .rendering.layer import Layer, Solid
from .rendering.rasteriser import rasterise
from .rendering.renderer import Lamp, Picture, Pictures, Renderer, build_lamp, render
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
    "build_lamp",
    "build_stereo_pair",
    "composite",
    "look_at",
    "rasterise",
    "read_png",
    "render",
    "write_png",
    "write_video",
]
