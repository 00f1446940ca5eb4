"""Arguments from which a term is built: anatomy, discretisation, surface and device."""

from dataclasses import dataclass

from ..anatomy import Anatomy
from ..runtime.device import Device
from .footprint import ContactSurface
from .space import Discretisation


@dataclass(frozen=True, eq=False)
class Body:
    """Discretised body with N nodes; the mesh vertices come first.

    `space.count` is N; `space.nodes` (N, 3) [m] are undeformed; `skin` is the surface for tools; `device` allocates
    arrays and launches kernels. Resection creates a new body with the same vertices. Preconditioners may use another
    element.
    """

    anatomy: Anatomy
    space: Discretisation
    skin: ContactSurface
    device: Device
