"""Volume that passes through the closed skull: the surface's vectors, and the share that results report."""

import numpy as np
import pytest
import trimesh
from boxes import box, integrate_surface_normals, quadratic
from scipy.spatial import Delaunay

from sim.accuracy import TRAIN
from sim.anatomy import Anatomy
from sim.diagnostics.skull_leak import SkullLeak
from sim.discretisation.element import build_quadratic_elements
from sim.discretisation.space import discretise
from sim.effects import build_push_effects
from sim.fem import MID_EDGE_KEY, Fem
from sim.geometry.surface import compute_vertex_normals, normalise_vectors
from sim.geometry.tetmesh import TetMesh, orient_tetrahedra
from sim.loads import push
from sim.material import BRAIN
from sim.runtime.device import find_device

GRADIENT = 1e-3 * np.array([[3.0, 1.0, -2.0], [0.5, -1.0, 4.0], [2.0, -3.0, 5.0]])


@pytest.mark.parametrize("kind", ["linear", "quadratic", "curved"])
def test_surface_flux_agrees_with_volume_change(kind):
    """A uniform strain gives the volume times its trace; the positions themselves give three times the volume."""
    mesh = box((3, 2, 2), distortion=0.2)
    if kind != "linear":
        mesh = quadratic(mesh)
    if kind == "curved":
        nodes = mesh.nodes + 0.3 * mesh.nodes[:, [1, 2, 0]] ** 2 / mesh.nodes.max()
        mesh = TetMesh(nodes, mesh.tets, mesh.region, mesh.middles)
    space = discretise(mesh, "p1" if kind == "linear" else "p2")
    every = np.ones(len(mesh.tets), bool)
    volume = mesh.volumes.sum()
    if kind != "linear":
        volume = build_quadratic_elements(space.nodes, space.table, every).weight.sum()
    vectors = integrate_surface_normals(space.nodes, space.surface)
    assert np.abs(vectors.sum(axis=0)).max() < 1e-15
    assert np.einsum("ni,ni->", vectors, space.nodes) == pytest.approx(3.0 * volume, rel=1e-12)
    swept = np.einsum("ni,ni->", vectors, space.nodes @ GRADIENT.T)
    assert swept == pytest.approx(volume * np.trace(GRADIENT), rel=1e-9)


@pytest.fixture(scope="module")
def egg():
    """An egg of 80 to 100 mm whose upper cap is open, its lowest nodes held; the rest slides along its own normals."""
    shell = trimesh.creation.icosphere(subdivisions=3, radius=0.045).vertices
    grid = np.stack(np.meshgrid(*[np.arange(-0.04, 0.041, 0.013)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = np.vstack([shell, grid[np.linalg.norm(grid, axis=1) < 0.037]])
    tets, _ = orient_tetrahedra(nodes, Delaunay(nodes).simplices)
    nodes = nodes * [0.9, 1.1, 1.0]
    size = np.abs(np.linalg.det(nodes[tets[:, 1:]] - nodes[tets[:, :1]]))
    thick = size > 1e-3 * np.median(size)
    mesh = TetMesh(nodes, tets[thick], np.ones(thick.sum(), int))
    surface = np.zeros(len(nodes), bool)
    surface[mesh.surface] = True
    opened, held = surface & (nodes[:, 2] > 0.033), surface & (nodes[:, 2] < -0.04)
    normal = np.where((surface & ~opened & ~held)[:, None], compute_vertex_normals(nodes, mesh.surface), 0.0)
    return Anatomy(mesh, np.repeat(held[:, None], 3, axis=1), normal, opened)


def pressed(anatomy, element):
    fem = Fem(anatomy, build_push_effects(anatomy, BRAIN, "slide"), TRAIN, "cpu", element=element)
    top = anatomy.mesh.nodes[anatomy.mesh.nodes[:, 2].argmax()]
    return fem.deform(push(top, np.array([0.05, 0.0, -0.15]), 8e-3))


@pytest.mark.parametrize("tilt", [0.0, 0.15])
def test_leak_is_positive_flux_through_averaged_facets(egg, tilt):
    """Computed again facet by facet: mean displacement times vector area, averaged over 7 mm of covered facets."""
    slides = egg.slide_normal.any(axis=1)
    tilted = normalise_vectors(egg.slide_normal + tilt * np.random.default_rng(1).normal(size=egg.slide_normal.shape))
    other = Anatomy(egg.mesh, egg.fixed, np.where(slides[:, None], tilted, 0.0), egg.craniotomy)
    answer = pressed(other, "p1")
    corners, u = egg.mesh.nodes[egg.mesh.surface], answer.displacement[0][egg.mesh.surface].mean(axis=1)
    vector = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flux, area, middle = np.einsum("si,si->s", vector, u), np.linalg.norm(vector, axis=1), corners.mean(axis=1)
    covered = (slides | egg.fixed.all(axis=1))[egg.mesh.surface].all(axis=1)
    passed = 0.0
    for row in np.flatnonzero(covered):
        near = covered & (np.linalg.norm(middle - middle[row], axis=1) <= 7e-3)
        passed += max(0.0, area[row] * flux[near].sum() / area[near].sum())
    assert answer.leaked[0] == pytest.approx(passed / np.abs(flux[~covered]).sum(), rel=1e-4)
    assert answer.leaked[0] > 0.005


@pytest.mark.parametrize("element", ["p1", "smoothed", "p2"])
def test_leak_shrinks_with_its_averaging_radius(egg, element):
    """Sums at nodes vanish by construction on the surface's own normals; means over facets do not."""
    answer, space = pressed(egg, element), discretise(egg.mesh, element)
    u = space.interpolate_field(answer.displacement[0])
    if element == "p2":
        u[len(egg.mesh.nodes) :] += answer.memory[MID_EDGE_KEY][0]
    else:
        swept = np.einsum("ni,ni->n", integrate_surface_normals(egg.mesh.nodes, egg.mesh.surface), u)
        assert swept[egg.slide_normal.any(axis=1)].max() < 1e-5 * np.abs(swept[egg.craniotomy]).sum()
    device = find_device("cpu", "float64")
    shares = [
        SkullLeak(egg, space, device, around).compute_fraction(device.upload(u.reshape(-1, 1)))[0]
        for around in (1e-6, 12e-3, 0.05)
    ]
    assert shares[0] > 1.5 * shares[1] > 1.5 * shares[2] > 0.0


def test_leak_includes_mid_edge_nodes(egg):
    answer = pressed(egg, "p2")
    space = discretise(egg.mesh, "p2")
    u = space.interpolate_field(answer.displacement[0])
    u[len(egg.mesh.nodes) :] += answer.memory[MID_EDGE_KEY][0]
    device = find_device("cpu", "float64")
    assert SkullLeak(egg, space, device).compute_fraction(device.upload(u.reshape(-1, 1)))[0] == pytest.approx(
        answer.leaked[0], rel=1e-3
    )
    swept = np.einsum("ni,ni->n", integrate_surface_normals(space.nodes, space.surface), u)
    assert np.abs(swept[: len(egg.mesh.nodes)]).max() < 1e-12 < np.abs(swept).max()


def test_body_at_rest_has_no_leak(egg):
    device = find_device("cpu", "float64")
    leak = SkullLeak(egg, discretise(egg.mesh, "p1"), device)
    assert leak.compute_fraction(device.allocate(3 * len(egg.mesh.nodes), 2)).tolist() == [0.0, 0.0]


def test_leak_of_skull_without_opening_is_nan(egg):
    """The whole surface is covered: the share has a zero denominator."""
    whole = np.unique(egg.mesh.surface)
    normal = np.zeros_like(egg.slide_normal)
    normal[whole, 2] = 1.0
    closed = Anatomy(egg.mesh, egg.fixed, normal, np.zeros(len(normal), bool))
    device, space = find_device("cpu", "float64"), discretise(egg.mesh, "p1")
    grown = device.upload((0.01 * egg.mesh.nodes).reshape(-1, 1))
    leak = SkullLeak(closed, space, device)
    assert (
        np.isnan(leak.compute_fraction(grown)).all()
        and (leak.compute_fraction(device.allocate(*grown.shape)) == 0.0).all()
    )
