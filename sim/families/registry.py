"""Families of deformation models by name, after Table 1 of Tonutti, Gras, Yang 2017."""

from __future__ import annotations

from collections.abc import Iterable

from ..accuracy import TRAIN, Accuracy
from ..anatomy import Anatomy
from ..deformation import Deformer, Outcome
from ..effects import Effect
from ..errors import InputError

FAMILIES = {
    "kelvinlets": "regularised Kelvinlets: motions of an infinite body, brought back at some fixed vertices",
    "thin-plate": "thin-plate spline that continues the motion of the surface",
    "lattice": "free-form lattice of B-splines that continues the motion of the surface",
    "mass-spring": "springs along edges and volumes of tetrahedra, to equilibrium",
    "xpbd": "the same springs by position-based dynamics with a fixed number of iterations",
    "boundary-elements": "boundary elements with Kelvin's solution: linear, brain and tumour as two regions",
    "condensed": "linear finite elements, condensed to a compliance table",
    "explicit": "total Lagrangian explicit finite elements, damped to the equilibrium",
    "element-free": "total Lagrangian element-free Galerkin method with moving least squares",
}
"""Descriptions of the families by name; the finite elements of `Fem` are the reference."""

ELEMENTS_BY_FAMILY = {"mass-spring": "springs", "element-free": "element-free"}
"""Element types of the families that `Fem` solves; these families support contact, gravity, resection and more."""


def build_family(
    name: str, anatomy: Anatomy, effects: Iterable[Effect], device: str = "auto", accuracy: Accuracy = TRAIN
) -> Deformer:
    """Return a deformation model of the family `name` in `FAMILIES`.

    `device` and `accuracy` are arguments of `Fem`. Models with a compliance matrix use the CPU; only the element-free
    and the mass-spring model use `accuracy`.

    Raises
    ------
    InputError
        The name is unknown, the family does not support an effect, or `Fem` rejects the input.

    Examples
    --------
    >>> import numpy as np
    >>> from scenes import get_template_path
    >>> from sim import BRAIN, build_family, build_push_effects, open_cortex, push, read_anatomy
    >>> anatomy = read_anatomy(get_template_path())
    >>> place = open_cortex(anatomy).place(right_mm=0, up_mm=0)
    >>> model = build_family("condensed", anatomy, build_push_effects(anatomy, BRAIN))
    >>> result = model.deform(push(place.point, 0.1 * place.inward, footprint=7e-3), at=anatomy.tumour_nodes)
    >>> print(f"{1e3 * np.linalg.norm(result.displacement[0].mean(axis=0)):.1f} mm; {result.outcome[0].name}")
    0.3 mm; CONVERGED
    """
    if name not in tuple(FAMILIES):
        raise InputError(f"no family of models is called {name!r}: choose one of {', '.join(FAMILIES)}.")
    if name in ELEMENTS_BY_FAMILY:
        from ..resected_fem import build_fem

        return build_fem(anatomy, effects, accuracy, device, element=ELEMENTS_BY_FAMILY[name])
    from . import boundary_elements, condensed, explicit, geometric, xpbd
    from .models import LinearModel, RelaxationModel

    if name in ("explicit", "xpbd"):
        return RelaxationModel(name, anatomy, effects, explicit.EXPLICIT if name == "explicit" else xpbd.XPBD, device)
    respond, outcome = {
        "boundary-elements": (boundary_elements.compute_response, Outcome.CONVERGED),
        "condensed": (condensed.compute_response, Outcome.CONVERGED),
        "kelvinlets": (geometric.compute_kelvinlet_response, Outcome.GUESSED),
        "lattice": (geometric.compute_lattice_response, Outcome.GUESSED),
        "thin-plate": (geometric.compute_thin_plate_response, Outcome.GUESSED),
    }[name]
    return LinearModel(name, anatomy, effects, respond, outcome)
