"""Regions of known stiffness in a brain of unknown stiffness: locators, files and checks."""

from dataclasses import replace

import numpy as np
import pytest
from locators import in_a_skull
from test_sim_conformance import YEOH

from sim.anatomy import PART_LABELS
from sim.effects import Elasticity
from sim.errors import InputError
from sim.material import BRAIN, Material, Ogden
from surrogate.fitting.fit import list_fitted_regions
from surrogate.fitting.responses import build_force_loads, solve_responses
from surrogate.locating.causes import Causes, build_groups
from surrogate.locating.ensemble import compute_surface_motion, solve_members
from surrogate.locating.locator_store import load_locator, make_locator, save_locator
from surrogate.locating.observation import Observation
from surrogate.locating.regions import (
    Region,
    check_regions,
    describe_regions,
    find_differing_regions,
    list_known_regions,
)

OEDEMA = PART_LABELS["oedema"]
STIFF = Region(OEDEMA, 20.0)
FEW = Causes(
    poisson=(0.45, 0.48),
    tools=(6, 2),
    drainages=2,
    levels=(0.4,),
    swellings=(0.04, -0.02),
    tumour_swellings=(0.2,),
    reaches=(0, 0),  # no oedema
)


@pytest.fixture(scope="module")
def body():
    """A slab of another region lies between the open cortex and the tumour."""
    box = in_a_skull()
    middle = box.mesh.nodes[box.mesh.tets[:, :4]].mean(axis=1)
    tumour = box.mesh.nodes[box.tumour_nodes]
    near = np.abs(middle[:, :2] - tumour[:, :2].mean(axis=0)).max(axis=1) < 14e-3
    slab = near & (middle[:, 2] > tumour[:, 2].max() - 1e-3) & ~box.in_tumour
    assert slab.any()
    return replace(box, mesh=replace(box.mesh, region=np.where(slab, OEDEMA, box.mesh.region)))


@pytest.fixture(scope="module")
def locators(body):
    """One that knows the slab, and one that takes it for brain."""
    both = (replace(FEW, regions=(STIFF,)), FEW)
    return [make_locator(body, causes=causes, device="cpu", count=60) for causes in both]


def test_known_stiff_region_reduces_the_locator_error(body, locators):
    """Motions of new draws with the slab, observed without error at all nodes of the open cortex."""
    nodes, off = np.unique(body.open_surface), []
    for group in build_groups(body, seed=5, causes=replace(FEW, regions=(STIFF,)))[:2]:
        motion, _ = solve_members(body, group, seed=5, device="cpu", causes=FEW)
        for one in motion[:6] * (3e-3 / compute_surface_motion(body, motion[:6]))[:, None, None]:
            seen = Observation(body.mesh.nodes[nodes] + one[nodes], body.mesh.nodes[nodes], rigid=0.0)
            truth = one[body.tumour_nodes]
            off.append(
                [np.linalg.norm(each.locate(seen).compute_motion(body.tumour_nodes) - truth) for each in locators]
            )
    knowing, other = np.median(off, axis=0)
    assert knowing < 0.7 * other, (knowing, other)


def test_known_region_is_in_every_group_and_force_solve(body):
    """Its stiffness is relative to the brain's; its Poisson's ratio is its own if given."""
    known = (replace(STIFF, poisson=0.3),)
    for group in build_groups(body, causes=replace(FEW, regions=known)):
        tissue = group.build_effects(FEW.swellings)[0]
        assert isinstance(tissue, Elasticity)
        slab, brain = tissue.regions[OEDEMA], tissue.default
        assert isinstance(slab, Ogden) and isinstance(brain, Ogden)
        (mu, lam), (soft, _) = slab.lame, brain.lame
        assert mu * (1.0 + 0.3) == pytest.approx(20.0 * soft * (1.0 + group.poisson))
        assert lam / (2.0 * (lam + mu)) == pytest.approx(0.3)
    loads = build_force_loads(body, body.mesh.nodes[np.unique(body.open_surface)][:1], np.array([6e-3]))
    stiff, plain = (solve_responses(body, loads, "cpu", regions=regions) for regions in (known, ()))
    assert stiff.regions == known and np.abs(stiff.motion["slide"] - plain.motion["slide"]).max() > 1e-6


def test_locator_file_stores_the_known_regions(body, locators, tmp_path):
    knowing, other = locators
    for name, locator in (("knows.npz", knowing), ("not.npz", other)):
        save_locator(tmp_path / name, locator)
        assert load_locator(tmp_path / name, body).regions == locator.regions
    assert knowing.regions == (STIFF,) and knowing.restrict().regions == (STIFF,) and other.regions == ()


def test_fitted_regions_exclude_the_tumour(locators):
    both = replace(locators[0], regions=(Region(2, 3.0), STIFF))
    assert list_fitted_regions(both) == (STIFF,)


def test_known_regions_are_listed_and_checked(body):
    soft = Material("neo-hookean", 1500.0, 0.45)
    assert list_known_regions(Elasticity(BRAIN, {OEDEMA: soft, 2: BRAIN.replace_constants(9000.0)})) == (
        Region(2, 3.0), Region(OEDEMA, 0.5, 0.45),
    )  # fmt: skip
    assert list_known_regions(Elasticity(BRAIN)) == ()
    assert describe_regions((Region(OEDEMA, 0.5, 0.45),)) == (
        "region 3 (oedema) 0.5 times as stiff as the brain, Poisson's ratio 0.45"
    )
    with pytest.raises(InputError, match="--region"):
        list_known_regions(Elasticity(BRAIN, {2: YEOH.Yeoh(500.0, 0.0, 1e4)}))
    with pytest.raises(InputError, match=r"no region 4 \(ventricles\)"):
        check_regions((Region(PART_LABELS["ventricles"], 0.5),), body)
    for bad in ((2, -1.0), (2, float("nan")), (2, 1.0, 0.6), ([2], 1.0), (2.5, 1.0)):
        with pytest.raises(InputError):
            Region(*bad)


def test_scene_regions_are_compared_with_the_locator(body):
    """The tumour is ignored; a region as stiff as the brain does not count."""
    own, tumour = Region(OEDEMA, 0.5, 0.45), Region(2, 3.0)
    scene = Elasticity(BRAIN, {OEDEMA: Material("neo-hookean", 1500.0, 0.45), 2: BRAIN.replace_constants(5000.0)})
    assert not find_differing_regions(scene, (own,)) and not find_differing_regions(scene, (own, tumour))
    assert not find_differing_regions(Elasticity(BRAIN, {OEDEMA: BRAIN}), (tumour,))
    for known in ((), (STIFF,), (replace(own, poisson=None),)):
        assert find_differing_regions(scene, known) == (OEDEMA,)
    assert find_differing_regions(Elasticity(BRAIN), (own,)) == (OEDEMA,)


def test_locator_file_with_list_as_label_is_rejected(body, locators, tmp_path):
    spoilt = replace(STIFF)
    object.__setattr__(spoilt, "label", [OEDEMA])
    save_locator(tmp_path / "list.npz", replace(locators[0], regions=(spoilt,)))
    with pytest.raises(InputError, match=r"a region's label is \[3\]: give the whole number"):
        load_locator(tmp_path / "list.npz", body)
