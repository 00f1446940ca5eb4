"""Necrosis of a tumour: a region with its own stiffness inside the tumour."""

from dataclasses import replace

import numpy as np
import pytest
from test_sim_head_masks import EDGE, TUMOUR, grid, head, nifti

from scenes.script.debulking import Debulking
from sim.anatomy import NECROSIS_LABEL, TUMOUR_LABEL
from sim.bodies.head_masks import MaskSources, read_head_masks
from sim.bodies.label_volume import build_masked_subject
from sim.bodies.meshfile import read_anatomy, write_anatomy
from sim.bodies.open_cortex import open_cortex
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.effects import Elasticity, Resection, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Resected, push
from sim.material import BRAIN
from sim.resected_fem import ResectedFem, build_fem

STIFF, SOFT = BRAIN.replace_constants(9000.0), BRAIN.replace_constants(300.0)


def hollowed(anatomy):
    """A body with necrosis in the tumour's tetrahedra that are nearest to its middle."""
    mesh = anatomy.mesh
    tumour = np.flatnonzero(mesh.region == TUMOUR_LABEL)
    middle = mesh.nodes[mesh.tets[tumour]].mean(axis=1)
    near = np.argsort(np.linalg.norm(middle - middle.mean(axis=0), axis=1), kind="stable")[: len(tumour) // 3]
    region = mesh.region.copy()
    region[tumour[near]] = NECROSIS_LABEL
    return replace(anatomy, mesh=replace(mesh, region=region))


@pytest.fixture(scope="module")
def hollow(small_box):
    return hollowed(small_box)


def pushed(anatomy, tissue):
    """How the tumour's vertices (n, 3) [m] move under a push on the open cortex."""
    place = open_cortex(anatomy).find_nearest(np.zeros(3))
    fem = Fem(anatomy, build_push_effects(anatomy, tissue), element="p1")
    return fem.deform(push(place.point, 0.1 * place.inward, footprint=7e-3), at=anatomy.tumour_nodes).displacement[0]


def necrotic(places):
    """A head with a ball in it, and in that another."""
    labels = head(places)
    labels[np.linalg.norm(places - TUMOUR - [1.5, -1.0, 0.5], axis=-1) < 8.0] = 6
    return labels


def necrotic_labels(folder):
    affine, places = grid()
    return nifti(folder / "own.nii", necrotic(places), affine)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Own labels, and the same as a mask of the brain and labels of BraTS."""
    folder = tmp_path_factory.mktemp("necrosis")
    necrotic_labels(folder)
    affine, places = grid()
    labels = necrotic(places)
    nifti(folder / "brain.nii", (labels > 0).astype(np.int16), affine)
    nifti(folder / "brats.nii", np.select([labels == 3, labels == 6], [4, 1], 0).astype(np.int16), affine)
    return folder


class TestLabels:
    """Of one's own, of a convention, and of a tumour in another file."""

    def test_necrosis_mask_is_equal_from_every_label_source(self, files):
        found = [
            read_head_masks(MaskSources(files / "own.nii", (1,), (3,), parts={"necrosis": (6,)})),
            read_head_masks(MaskSources(files / "own.nii", (1,), (3, 6), parts={"necrosis": (6,)})),
            read_head_masks(MaskSources(files / "brats.nii", convention="brats", mask=files / "brain.nii")),
            read_head_masks(
                MaskSources(files / "brain.nii", (1,), (4,), tumour_file=files / "brats.nii", parts={"necrosis": (1,)})
            ),
        ]
        for masks in found:
            for one, other in ((masks.tumour, found[0].tumour), (masks.parts["necrosis"], found[0].parts["necrosis"])):
                np.testing.assert_array_equal(one, other)
        assert (found[0].parts["necrosis"] & ~found[0].tumour).sum() == 0 < found[0].parts["necrosis"].sum()

    def test_necrosis_label_must_exist_and_differ_from_brain(self, files):
        with pytest.raises(InputError, match="label 1 is named by --brain and by --necrosis"):
            read_head_masks(MaskSources(files / "own.nii", (1,), (3,), parts={"necrosis": (1,)}))
        with pytest.raises(InputError, match="has no label 9"):
            read_head_masks(MaskSources(files / "own.nii", (1,), (3,), parts={"necrosis": (9,)}))

    def test_necrosis_region_has_mask_volume_and_keeps_tumour(self, files, tmp_path):
        masks = read_head_masks(MaskSources(files / "own.nii", (1,), (3,), parts={"necrosis": (6,)}))
        subject = build_masked_subject(masks, regions=("necrosis",))
        (part,) = subject.parts
        assert part.volume == pytest.approx(masks.parts["necrosis"].sum() * (1e-3 * EDGE) ** 3)
        anatomy = make_anatomy(subject, MeshPlan(nodes=2500))
        whole = make_anatomy(replace(subject, parts=()), MeshPlan(nodes=2500))
        assert anatomy.mesh.volumes[anatomy.mesh.mark_elements(NECROSIS_LABEL)].sum() == pytest.approx(
            part.volume, rel=0.03
        )
        assert set(np.unique(whole.mesh.region)) == {1, 2} and anatomy.digest != whole.digest
        write_anatomy(tmp_path / "a.vtu", anatomy)
        for name in ("in_tumour", "tumour_nodes", "tumour_surface"):
            for one in (anatomy, read_anatomy(tmp_path / "a.vtu")):
                np.testing.assert_array_equal(getattr(one, name), getattr(whole, name))


def test_necrosis_without_own_law_uses_tumour_law(small_box, hollow):
    """Necrosis softer than the tumour increases the tumour's strain."""
    np.testing.assert_array_equal(hollow.tumour_nodes, small_box.tumour_nodes)
    whole = pushed(small_box, Elasticity(BRAIN, {TUMOUR_LABEL: STIFF}))
    same = pushed(hollow, Elasticity(BRAIN, {TUMOUR_LABEL: STIFF}))
    brain = pushed(hollow, Elasticity(BRAIN, {TUMOUR_LABEL: STIFF, NECROSIS_LABEL: BRAIN}))
    soft = pushed(hollow, Elasticity(BRAIN, {TUMOUR_LABEL: STIFF, NECROSIS_LABEL: SOFT}))
    size = np.linalg.norm(whole, axis=1).max()
    assert np.abs(same - whole).max() < 1e-4 * size

    def strain(motion):
        """How far the tumour changes its shape: motion that no shift explains."""
        return np.linalg.norm(motion - motion.mean(axis=0))

    assert 1.02 * strain(whole) < strain(brain) < strain(soft)


def test_law_for_missing_region_is_rejected(small_box):
    with pytest.raises(InputError, match=r"a law is given for region 5 \(necrosis\), but the mesh has the regions"):
        Fem(small_box, build_push_effects(small_box, Elasticity(BRAIN, {NECROSIS_LABEL: SOFT})))


def test_resected_tumour_remainder_keeps_its_law(small_box):
    """Includes a resection of the whole tumour except its necrosis."""
    mesh = small_box.mesh
    right = mesh.nodes[mesh.tets].mean(axis=1)[:, 0] > 0.0
    halved = replace(mesh, region=np.where(small_box.in_tumour & right, NECROSIS_LABEL, mesh.region))
    cut = Resection((tuple(np.flatnonzero(halved.mark_elements(TUMOUR_LABEL)).tolist()),))
    effects = (*build_push_effects(small_box, Elasticity(BRAIN, {TUMOUR_LABEL: STIFF})), cut)
    operated = build_fem(replace(small_box, mesh=halved), effects, element="p1")
    assert isinstance(operated, ResectedFem)
    left = operated.get_remaining_body(1).anatomy
    assert set(left.mesh.region.tolist()) == {1, NECROSIS_LABEL}
    place = open_cortex(small_box).find_nearest(np.zeros(3))
    loads = push(place.point, 0.1 * place.inward, footprint=7e-3)
    cut_open = replace(loads, causes=(*loads.causes, Resected(np.array([1]))))
    after = operated.deform(cut_open, at=left.tumour_nodes).displacement[0]
    np.testing.assert_allclose(after, pushed(left, Elasticity(BRAIN, {NECROSIS_LABEL: STIFF})), atol=2e-7)
    assert np.abs(after - pushed(left, BRAIN)).max() > 2e-6


def test_debulking_removes_necrosis_with_the_tumour(hollow, small_box):
    assert Debulking((0.1, 0.2)).build_resection(hollow) == Debulking((0.1, 0.2)).build_resection(small_box)
