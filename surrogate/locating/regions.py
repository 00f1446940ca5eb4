"""Regions of known stiffness in a brain whose stiffness is not known."""

from collections.abc import Callable
from dataclasses import dataclass
from math import isclose
from numbers import Integral

from sim.anatomy import TUMOUR_LABEL, Anatomy, describe_missing_region, describe_region
from sim.effects import Elasticity
from sim.errors import InputError
from sim.material import IsotropicTissue, Material, Tissue

RATIO_TOLERANCE = 1e-6  # Relative tolerance for equal stiffness ratios.


@dataclass(frozen=True)
class Region:
    """Region with its known tissue parameters.

    Parameters
    ----------
    label
        Label of the region in the mesh.
    ratio
        Young's modulus of the region / that of the brain.
    poisson
        Poisson's ratio; None: that of the brain.

    Raises
    ------
    InputError
        The label is not an integer, or a parameter is outside the range of tissue.
    """

    label: int
    ratio: float
    poisson: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.label, Integral):
            raise InputError(f"a region's label is {self.label!r:.80}: give the whole number that the mesh has.")
        Material("linear", self.ratio, 0.25 if self.poisson is None else self.poisson)


def build_tissue(
    build_material: Callable[[float, float], Tissue], poisson: float, tumour_ratio: float, regions: tuple[Region, ...]
) -> Elasticity:
    """Build the elasticity of brain, tumour and known regions from the function `make_tissue(ratio, poisson)`.

    A ratio is the stiffness relative to the brain's. `poisson` is the brain's Poisson's ratio. `tumour_ratio` is the
    tumour's stiffness ratio, unless the tumour is a known region.
    """
    known = {one.label: build_material(one.ratio, poisson if one.poisson is None else one.poisson) for one in regions}
    return Elasticity(build_material(1.0, poisson), {TUMOUR_LABEL: build_material(tumour_ratio, poisson), **known})


def list_known_regions(elasticity: Elasticity) -> tuple[Region, ...]:
    """Return the regions whose tissue is given separately from the brain's.

    Raises
    ------
    InputError
        A tissue has no Young's modulus.
    """
    brain = elasticity.default
    if not elasticity.regions:
        return ()
    if not all(isinstance(tissue, IsotropicTissue) for tissue in (brain, *elasticity.regions.values())):
        raise InputError("a locator knows regions by their Young's modulus over the brain's: give them by --region.")
    assert isinstance(brain, IsotropicTissue)
    return tuple(
        Region(label, tissue.young / brain.young, None if tissue.poisson == brain.poisson else tissue.poisson)
        for label, tissue in sorted(elasticity.regions.items())
        if isinstance(tissue, IsotropicTissue)
    )


def check_regions(regions: tuple[Region, ...], anatomy: Anatomy) -> None:
    """Raise InputError for a region that is missing in the anatomy."""
    for one in regions:
        if missing := describe_missing_region(anatomy.mesh, one.label):
            raise InputError(missing)


def find_differing_regions(elasticity: Elasticity, known_regions: tuple[Region, ...]) -> tuple[int, ...]:
    """Return the labels of the regions whose tissue differs from that of `known_regions`.

    Regions without an entry count as brain. The tumour is excluded, as its stiffness may be unknown. If a tissue has no
    Young's modulus, the result is empty.
    """
    if not all(isinstance(tissue, IsotropicTissue) for tissue in (elasticity.default, *elasticity.regions.values())):
        return ()
    has, knows = ({one.label: one for one in some} for some in (list_known_regions(elasticity), known_regions))
    labels = {*has, *knows} - {TUMOUR_LABEL}
    as_brain = {label: Region(label, 1.0) for label in labels}
    pairs = {label: ({**as_brain, **has}[label], {**as_brain, **knows}[label]) for label in labels}
    return tuple(
        label
        for label, (one, other) in sorted(pairs.items())
        if one.poisson != other.poisson or not isclose(one.ratio, other.ratio, rel_tol=RATIO_TOLERANCE)
    )


def describe_regions(regions: tuple[Region, ...]) -> str:
    """Describe the known regions with their stiffness; empty if there are none."""
    return "; ".join(
        f"{describe_region(one.label)} {one.ratio:.3g} times as stiff as the brain"
        + ("" if one.poisson is None else f", Poisson's ratio {one.poisson:g}")
        for one in regions
    )
