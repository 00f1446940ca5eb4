"""Tissue of a scene's regions, derived from the tissue that the models of the anatomy were trained on."""

from collections.abc import Collection
from dataclasses import replace

from sim.effects import Elasticity
from sim.material import IsotropicTissue, Tissue


def find_trained_regions(
    tissue: Elasticity, trained_tissue: Elasticity | None, excluded: Collection[int] = frozenset()
) -> dict[int, Tissue]:
    """Return tissues, by region label, that a scene with tissue `tissue` takes from the models' training.

    The regions are those of `trained_tissue` that are neither in `tissue` nor in `excluded`. The ratio of a region's
    stiffness to the brain's stiffness is kept.
    """
    brain = tissue.default
    if trained_tissue is None or brain is None or trained_tissue.default is None:
        return {}
    others = {label: one for label, one in trained_tissue.regions.items() if label not in {*tissue.regions, *excluded}}
    return {label: _scale_tissue(brain, one, trained_tissue.default) for label, one in others.items()}


def _scale_tissue(brain: Tissue, region: Tissue, learned_brain: Tissue) -> Tissue:
    """Scale a trained region's tissue to the scene's `brain`; return `brain` if the material laws cannot be scaled."""
    if isinstance(region, IsotropicTissue) and _remove_relaxation(brain) == _remove_relaxation(learned_brain):
        return replace(region, prony=brain.prony)
    if not (
        isinstance(brain, IsotropicTissue)
        and isinstance(region, IsotropicTissue)
        and isinstance(learned_brain, IsotropicTissue)
    ):
        return brain
    poisson = brain.poisson if region.poisson == learned_brain.poisson else region.poisson
    return brain.replace_constants(brain.young * region.young / learned_brain.young, poisson)


def _remove_relaxation(tissue: Tissue) -> Tissue:
    """Return a tissue without its relaxation (Prony terms)."""
    return replace(tissue, prony=()) if isinstance(tissue, IsotropicTissue) else tissue
