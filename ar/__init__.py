"""Rendering, camera geometry and overlays for the surgeon's view, independent of brain anatomy."""

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
FORMER = {"lamp_beside": "build_lamp", "stereo_pair": "build_stereo_pair"}
"""Former names of public names, mapped to the current names; they work for one more release."""


def __getattr__(name):
    """Load a public name of this package by its current or its former name."""
    return _load(FORMER.get(name, name))
