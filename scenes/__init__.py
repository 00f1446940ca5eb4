"""Scenes: scripted tools, the loop that plays them, and the command line."""

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
FORMER = {
    "Lying": "HeadPose",
    "Sight": "PointObservation",
    "Site": "CraniotomyFrame",
    "StereoSight": "StereoObservation",
    "Theatre": "PatientSetup",
    "idle": "keep_idle",
    "site_of": "build_craniotomy_frame",
    "template_path": "get_template_path",
    "wander": "stroke_cortex",
}
"""Former names of public names, for one release."""


def __getattr__(name):
    """Load a public name, also by its former name."""
    return _load(FORMER.get(name, name))
