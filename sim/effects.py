"""What a scene may ask for: descriptions only. `compile` turns each into a term or a constraint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from .anatomy import Anatomy
from .material import BRAIN, Tissue


@dataclass(frozen=True)
class Elasticity:
    """Tissue resists deformation. `regions` names the law of each region label; the rest obeys `default`.

    `default=None` makes a region without a law an error.
    """

    default: Tissue | None = BRAIN
    regions: Mapping[int, Tissue] = field(default_factory=dict)


@dataclass(frozen=True)
class Held:
    """Components marked in `Anatomy.held` do not move, or move as `Prescribed` loads say."""


@dataclass(frozen=True)
class Slide:
    """Nodes with a normal in `Anatomy.slide_normal` do not move along it; tangentially they are free."""


@dataclass(frozen=True)
class ToolForce:
    """A tool pushes with a known force: `Pushed` loads become dead tractions on its footprint."""


@dataclass(frozen=True)
class ToolDisplacement:
    """A tool moves the tissue under its footprint by a known vector: `Displaced` loads are constraints."""


@dataclass(frozen=True)
class NodalForce:
    """Dead forces at the mesh's own nodes: `Nodal` loads."""


Effect = Elasticity | Held | Slide | ToolForce | ToolDisplacement | NodalForce
"""Everything that a scene may ask for."""


def pushed_effects(anatomy: Anatomy, tissue: Tissue) -> tuple[Effect, ...]:
    """What a tool that pushes on a body of this tissue calls for; sliding where the anatomy has it."""
    slide = (Slide(),) if anatomy.slide_normal.any() else ()
    return (Elasticity(tissue), Held(), *slide, ToolForce())
