"""Tissue mechanics: meshes, material laws, loads, and the FEM solver."""

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
FORMER = {
    "Torn": "DebondedSolution",
    "finite_elements": "build_fem",
    "posture": "build_posture",
    "pressure": "compute_pressure",
    "pushed_effects": "build_push_effects",
    "refined": "refine",
    "stacked": "stack",
    "template_subject": "build_template_subject",
    "torn": "solve_with_debonding",
    "volume_subject": "build_volume_subject",
}
"""New name of each renamed public object, by its former name; former names work for one more release."""


def __getattr__(name):
    """Return the public object `name` and import its module on first use; former names are accepted too."""
    return _load(FORMER.get(name, name))
