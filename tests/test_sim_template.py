"""The built-in brain: quality of its mesh, its tumour, its boundary."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree

from sim.anatomy import TUMOUR_LABEL
from sim.bodies.mesher import Meshing
from sim.bodies.subject import MeshPlan, choose_diameter, make_anatomy
from sim.bodies.template import HeadScaling, Tumour, build_template_subject
from sim.errors import InputError
from sim.geometry.geodesic import compute_geodesic_distances
from sim.geometry.tetmesh import compute_dihedral_angles


@pytest.fixture(scope="module")
def subject():
    return build_template_subject(Tumour())


@pytest.fixture(scope="module")
def anatomy(subject):
    return make_anatomy(subject, MeshPlan())


def distances_to_voxel_faces(points, mask, affine):
    """Exact distances (n,) [m] of points to the boundary squares of a mask of cubic voxels, by brute force nearby."""
    centres, axes = [], []
    for axis in range(3):
        place = np.argwhere(np.diff(mask.astype(np.int8), axis=axis)).astype(float)
        place[:, axis] += 0.5
        centres.append(place)
        axes.append(np.full(len(place), axis))
    centre, axis = np.concatenate(centres), np.concatenate(axes)
    inverse = np.linalg.inv(affine)
    index = points @ inverse[:3, :3].T + inverse[:3, 3]
    near = KDTree(centre).query(index, k=12)[1]
    offset = np.abs(index[:, None] - centre[near])
    half = np.where(axis[near][..., None] == np.arange(3), 0.0, 0.5)
    return np.linalg.norm(np.maximum(offset - half, 0.0), axis=2).min(axis=1) * np.linalg.norm(affine[:3, 0])


def spread_points(mesh, count):
    rng = np.random.default_rng(0)
    corners = mesh.nodes[mesh.surface]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = rng.choice(len(corners), count, p=area / area.sum())
    return np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), count), corners[chosen])


def test_template_mesh_at_17k_nodes_meets_quality_bounds():
    subject = build_template_subject(Tumour(shape="lobed", seed=7))
    mesh = make_anatomy(subject, MeshPlan(nodes=17_000)).mesh
    assert abs(len(mesh.nodes) - 17_000) <= 1_700
    assert compute_dihedral_angles(mesh.nodes, mesh.tets).min() >= 10.0
    assert mesh.volumes[mesh.region == TUMOUR_LABEL].sum() == pytest.approx(4 / 3 * np.pi * 0.012**3, rel=0.02)
    grey, affine = subject.intensity.values, subject.intensity.affine
    distance = distances_to_voxel_faces(
        spread_points(mesh, 20_000), ndimage.binary_fill_holes(grey > 0.2 * grey.max()), affine
    )
    assert distance.mean() < 3e-4
    assert np.percentile(distance, 95) < 1e-3


def test_mesh_search_stops_at_the_number_of_trials_of_the_plan(subject):
    meshing = Meshing(max_trials=1, max_deviation=0.0)
    with pytest.raises(InputError, match="3000 nodes are not possible for this anatomy"):
        make_anatomy(subject, MeshPlan(3000, meshing=meshing))


def test_template_has_the_volume_of_a_human_brain(anatomy):
    assert anatomy.mesh.volumes.sum() == pytest.approx(HeadScaling().volume, rel=0.005)
    assert abs(len(anatomy.mesh.nodes) - 5300) <= 530


def test_tumour_lies_at_its_requested_depth():
    for cover in (0.003, 0.025):
        subject = build_template_subject(Tumour(cover=cover, shape="lobed", seed=1))
        inward = subject.tumour.middle - subject.site
        inward /= np.linalg.norm(inward)
        assert subject.tumour((subject.site + cover * inward)[None])[0] == pytest.approx(0.0, abs=1e-6)
        assert subject.brain(subject.site[None])[0] == pytest.approx(0.0, abs=5e-5)


def test_tumour_and_craniotomy_are_where_requested():
    subject = build_template_subject(Tumour(middle=(-0.030, 0.010, 0.040), radius=0.010))
    np.testing.assert_array_equal(subject.tumour.middle, [-0.030, 0.010, 0.040])
    assert [piece.volume for piece in subject.pieces] == [subject.tumour_volume]
    arm = subject.site - subject.tumour.middle
    assert subject.site[0] < -0.02 and 0.01 < np.linalg.norm(arm) < 0.04
    with pytest.raises(InputError, match=r"at 0, 0, 200 mm reaches out"):
        build_template_subject(Tumour(middle=(0.0, 0.0, 0.2)))
    with pytest.raises(InputError, match="finite"):
        Tumour(middle=(0.0, float("nan"), 0.0))


def test_seeds_vary_the_lobed_shape_but_not_its_volume():
    first, again, other = (build_template_subject(Tumour(shape="lobed", seed=seed)).tumour for seed in (1, 1, 2))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(50_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_array_equal(first.compute_radius(directions), again.compute_radius(directions))
    assert np.abs(first.compute_radius(directions) - other.compute_radius(directions)).max() > 1e-3
    for shape in (first, other):
        assert (shape.compute_radius(directions) ** 3).mean() == pytest.approx(0.012**3, rel=5e-3)
        assert np.ptp(shape.compute_radius(directions)) > 3e-3


def test_craniotomy_is_wider_than_the_tumour(subject):
    assert choose_diameter(subject, MeshPlan()) == 0.05 and choose_diameter(subject, MeshPlan(craniotomy=0.03)) == 0.03
    sizes = [choose_diameter(build_template_subject(Tumour(radius=each)), MeshPlan()) for each in (0.02, 0.03)]
    assert sizes == pytest.approx([0.06, 0.08], abs=1e-3)


def test_template_boundary_is_stem_skull_and_craniotomy(subject, anatomy):
    mesh = anatomy.mesh
    outer = np.unique(mesh.surface)
    stem, skull = anatomy.fixed.all(axis=1), anatomy.slide_normal.any(axis=1)
    sets = np.stack([stem, skull, anatomy.craniotomy])
    assert (sets.sum(axis=0)[outer] == 1).all() and not np.delete(sets, outer, axis=1).any()
    # 50 mm across, along the cortex, and at least the 90 nodes that the seed's experiment leaves free.
    along = compute_geodesic_distances(mesh.nodes, mesh.surface, subject.site, 0.06)
    np.testing.assert_array_equal(anatomy.craniotomy, along <= 0.025)
    assert anatomy.craniotomy.sum() >= 90
    # The held nodes are the medulla's: lowest, in the midline.
    held = mesh.nodes[stem]
    assert stem.sum() >= 6 and held[:, 2].max() < mesh.nodes[:, 2].min() + 0.022 and np.abs(held[:, 0]).max() < 0.022
    # Normals point outwards: away from the middle on the convexity.
    top = skull & (mesh.nodes[:, 2] > 0.05)
    assert (
        np.einsum("ni,ni->n", anatomy.slide_normal[top], mesh.nodes[top] - mesh.nodes.mean(axis=0)) > 0
    ).mean() > 0.95


def test_skull_normals_agree_with_integrals_of_shape_gradients(anatomy):
    """Sum over the volume: linear shape functions have a constant gradient in each tetrahedron."""
    mesh, skull = anatomy.mesh, anatomy.slide_normal.any(axis=1)
    a, *others = np.moveaxis(mesh.nodes[mesh.tets], 1, 0)
    edges = np.stack([other - a for other in others], axis=2)
    slope = np.linalg.inv(edges)
    gradient = np.concatenate([-slope.sum(axis=1, keepdims=True), slope], axis=1) * mesh.volumes[:, None, None]
    total = np.zeros_like(mesh.nodes)
    np.add.at(total, mesh.tets, gradient)
    wanted = total[skull] / np.linalg.norm(total[skull], axis=1, keepdims=True)
    np.testing.assert_allclose(anatomy.slide_normal[skull], wanted, atol=1e-9)


def test_invalid_tumour_or_mesh_plan_is_rejected(subject):
    for values, reason in (
        ({"radius": 0.05}, "radius of 50 mm is outside"),
        ({"cover": float("nan")}, "cover of nan mm"),
        ({"site": "nowhere"}, "no site is called"),
        ({"shape": "cube"}, "no tumour shape"),
        ({"seed": -1}, "negative"),
    ):
        with pytest.raises(InputError, match=reason):
            Tumour(**values)
    with pytest.raises(InputError, match="reaches out of the brain"):
        build_template_subject(Tumour(radius=0.035, cover=0.06, site="frontal"))
    for values, reason in (({"nodes": 100}, "100 nodes are outside"), ({"craniotomy": 0.2}, "outside 15 to 120 mm")):
        with pytest.raises(InputError, match=reason):
            MeshPlan(**values)
