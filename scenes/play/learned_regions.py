"""Tissue of a scene's regions, given the tissue that the models of its anatomy were trained on."""

from collections.abc import Collection
from dataclasses import replace

from sim.effects import Elasticity
from sim.material import Material, Ogden, Tissue


def find_trained_regions(
    tissue: Elasticity, trained_tissue: Elasticity | None, excluded: Collection[int] = frozenset()
) -> dict[int, Tissue]:
    """Return tissues by label of the regions that a scene with tissue `tissue` takes from the models.

    These are regions of the models' training without a tissue in the scene that are not among the `excluded`. Their
    stiffness relative to the brain is kept.
    """
    brain = tissue.default
    if trained_tissue is None or brain is None or trained_tissue.default is None:
        return {}
    others = {label: one for label, one in trained_tissue.regions.items() if label not in {*tissue.regions, *excluded}}
    return {label: _scale_tissue(brain, one, trained_tissue.default) for label, one in others.items()}


def _scale_tissue(brain: Tissue, region: Tissue, learned: Tissue) -> Tissue:
    """Return a region's tissue in a scene of this brain, scaled from the trained one; other laws: the brain's."""
    if isinstance(region, Material | Ogden) and _remove_relaxation(brain) == _remove_relaxation(learned):
        return replace(region, prony=brain.prony)
    if not isinstance(brain, Material) or not isinstance(region, Material) or not isinstance(learned, Material):
        return brain
    poisson = brain.poisson if region.poisson == learned.poisson else region.poisson
    return replace(brain, young=brain.young * region.young / learned.young, poisson=poisson)


def _remove_relaxation(tissue: Tissue) -> Tissue:
    """Return a tissue without its relaxation."""
    return replace(tissue, prony=()) if isinstance(tissue, Material | Ogden) else tissue
