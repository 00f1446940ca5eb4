"""What a term is built from: a body, its discretisation and its surface on one device."""

from __future__ import annotations

from dataclasses import dataclass

from ..anatomy import Anatomy
from ..runtime.device import Device
from .footprint import ContactSurface
from .space import Discretisation


@dataclass(frozen=True, eq=False)
class Body:
    """A body as the solver has it: N nodes, of which the mesh's own vertices come first.

    `space.count` is N; `space.nodes` (N, 3) [m] are at rest; `skin` is what tools press; `device` makes arrays and
    launches kernels. Resection makes a new body of the same vertices, and preconditioners may ask for one of another
    element.
    """

    anatomy: Anatomy
    space: Discretisation
    skin: ContactSurface
    device: Device
