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
"""Former names of public names, for one release."""


def __getattr__(name):
    """Load a public name, also by its former name."""
    return _load(FORMER.get(name, name))
