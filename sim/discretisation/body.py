"""Arguments from which a term is built: anatomy, discretisation, surface and device."""

from dataclasses import dataclass

from ..anatomy import Anatomy
from ..runtime.device import Device
from .footprint import ContactSurface
from .space import Discretisation


@dataclass(frozen=True, eq=False)
class Body:
    """Discretised anatomy with N nodes; the mesh vertices are the first nodes.

    `space.count` is N; `space.nodes` (N, 3) [m] are the undeformed positions; `skin` is the surface that tools touch;
    `device` allocates arrays and launches kernels. Resection creates a new body with the same vertices. Preconditioners
    may use another element type.
    """

    anatomy: Anatomy
    space: Discretisation
    skin: ContactSurface
    device: Device
