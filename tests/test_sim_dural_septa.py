"""Falx and tentorium as walls: no edge of the mesh crosses the sheet, and tissue beyond it moves less."""

import json
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from test_sim_head_masks import MIDDLE, grid, head, nifti

from scenes.cli import main
from sim.bodies.boundary_conditions import add_boundary_conditions
from sim.bodies.dural_septa import Septum, find_fixed_vertices, synthesise_falx
from sim.bodies.head_masks import MaskSources, read_head_masks
from sim.bodies.label_volume import build_masked_subject
from sim.bodies.meshfile import read_anatomy
from sim.bodies.open_cortex import open_cortex
from sim.bodies.subject import MeshPlan
from sim.effects import build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import push
from sim.material import BRAIN

PLAN = MeshPlan(nodes=2100, craniotomy=0.050)


@pytest.fixture(scope="module")
def labels(tmp_path_factory):
    """A head with a falx of 1.5 voxels in the middle, but for the lower part."""
    affine, places = grid()
    marked = head(places)
    marked[(np.abs(places[..., 0] - MIDDLE[0]) < 2.3) & (places[..., 2] > MIDDLE[2] - 5.0) & (marked == 1)] = 7
    return nifti(tmp_path_factory.mktemp("septa") / "a.nii", marked, affine)


@pytest.fixture(scope="module")
def subject(labels):
    return build_masked_subject(read_head_masks(MaskSources(labels, (1,), (3,), parts={"falx": (7,)})))


@pytest.fixture(scope="module")
def said(labels):
    """What the command says of it; the anatomy lies beside."""
    out = labels.with_name("a.vtu")
    words = ["anatomy", "--labels", str(labels), "--brain", "1", "--tumour", "3", "--falx", "7", "--out", str(out)]
    with redirect_stdout(StringIO()) as printed:
        assert main([*words, "--nodes", str(PLAN.nodes), "--json"]) == 0
    return json.loads(printed.getvalue())


@pytest.mark.parametrize("edge", [0.5e-3, 2e-3])
def test_edge_across_septum_has_a_held_end(box, edge):
    """Voxels finer and coarser than the mesh; the sheet stands at x = 1 mm above z = -20 mm, and is oblique."""
    nodes, tets = box.mesh.nodes, box.mesh.tets
    steps = np.arange(-40e-3, 40e-3, edge)
    y, z = np.meshgrid(steps, steps[steps > -20e-3], indexing="ij")
    sheet = np.column_stack([1e-3 + 0.2 * y.ravel(), y.ravel(), z.ravel()])
    reach = 0.5 * np.sqrt(3.0) * edge
    held = find_fixed_vertices(box.mesh, Septum("falx", sheet, reach))
    side = nodes[:, 0] - 1e-3 - 0.2 * nodes[:, 1]
    a, b = tets[:, [0, 0, 0, 1, 1, 2]].ravel(), tets[:, [1, 2, 3, 2, 3, 3]].ravel()
    share = side[a] / np.where(side[a] == side[b], 1.0, side[a] - side[b])
    crossing = nodes[a] + share[:, None] * (nodes[b] - nodes[a])
    cut = (side[a] * side[b] < 0.0) & (crossing[:, 2] > -18e-3)
    assert cut.sum() > 500 and (held[a[cut]] | held[b[cut]]).all()
    away = np.abs(side[held]) / np.hypot(1.0, 0.2)
    assert away.max() < 0.5 * 6e-3 * np.sqrt(3.0) + reach and not held[nodes[:, 2] < -25e-3].any()
    assert not find_fixed_vertices(box.mesh, Septum("falx", sheet + [1.0, 0.0, 0.0], edge)).any()


def test_synthetic_falx_lies_in_midline_with_requested_depth():
    """In an ellipsoid: upright in the midline, at the requested depth, above half of the height, without gaps."""
    directions = np.random.default_rng(1).normal(size=(4000, 3))
    radii, middle = np.array([70e-3, 90e-3, 65e-3]), np.array([3e-3, -20e-3, 10e-3])
    cortex = middle + radii * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    falx = synthesise_falx(cortex, 30e-3)
    assert falx.name == "falx" and np.abs(falx.points[:, 0] - middle[0]).max() < 1e-3
    y, z = ((falx.points - middle) / radii)[:, 1:].T
    assert z.min() > -0.02 and 0.97 < np.hypot(y, z).max() < 1.0
    top = falx.points[np.abs(falx.points[:, 1] - middle[1]) < 1e-3, 2]
    assert top.max() - top.min() == pytest.approx(30e-3, abs=2e-3)
    area = 0.5 * np.pi * (np.prod(radii[1:]) - np.prod(radii[1:] - 30e-3))
    assert len(falx.points) * 1e-6 == pytest.approx(area, rel=0.05)
    for depth in (9e-3, 61e-3, np.nan):
        with pytest.raises(InputError, match="is outside 10 to 60 mm"):
            synthesise_falx(cortex, depth)


def test_brain_beyond_falx_moves_less(said, labels, subject):
    """The other hemisphere; the tumour still moves. Without a falx in the labels only the stem is held."""
    walls = read_anatomy(labels.with_name("a.vtu"))
    mesh = walls.mesh
    plain = add_boundary_conditions(mesh, subject.site, PLAN.craniotomy, PLAN.placement)
    assert said["septa_nodes"] == {"falx": walls.fixed.all(axis=1).sum() - plain.fixed.all(axis=1).sum()}
    assert not walls.slide_normal[walls.fixed.any(axis=1)].any() and not (walls.fixed.T & walls.craniotomy).any()
    place = open_cortex(plain).find_nearest(open_cortex(plain).origin)
    loads = push(place.point, 0.2 * place.inward, footprint=8e-3)
    far, moved = mesh.nodes[:, 0] < 1e-3 * MIDDLE[0] - 8e-3, []
    for anatomy in (plain, walls):
        fem = Fem(anatomy, build_push_effects(anatomy, BRAIN, "slide"), device="cpu", element="p1")
        size = np.linalg.norm(fem.deform(loads).displacement[0], axis=1)
        moved.append((size[far].mean(), size[anatomy.tumour_nodes].mean()))
    (free, tumour), (less, kept) = moved
    assert less < 0.6 * free and 0.5 * tumour < kept < tumour


def test_craniotomy_over_falx_is_free(said, labels, subject):
    mesh = read_anatomy(labels.with_name("a.vtu")).mesh
    over = replace(subject, site=1e-3 * (MIDDLE + [0.0, 0.0, 42.0]))
    anatomy = add_boundary_conditions(mesh, over.site, PLAN.craniotomy, PLAN.placement, septa=subject.septa)
    assert anatomy.craniotomy.sum() > 6 and not anatomy.fixed[anatomy.craniotomy].any()


def test_falx_and_tentorium_labels_count_as_brain(labels, subject, tmp_path, capsys):
    assert subject.notes == () and [septum.name for septum in subject.septa] == ["falx"]
    with pytest.raises(InputError, match="label 3 is named by --tumour and by --tentorium"):
        read_head_masks(MaskSources(labels, (1,), (3,), parts={"tentorium": (3,)}))
    for other in ("tentorium", "ventricles"):
        with pytest.raises(InputError, match=f"label 7 is named by --falx and by --{other}: give it to one of them"):
            read_head_masks(MaskSources(labels, (1,), (3,), parts={"falx": (7,), other: (7,)}))
    assert main(["anatomy", "--falx", "7", "--out", str(tmp_path / "a.vtu")]) == 2
    assert "--falx belongs to a label volume" in capsys.readouterr().err
    words = ["patient", str(labels), "--tumour", "3", "--out", str(tmp_path / "a.vtu"), "--inspect"]
    assert main([*words, "--brain", "1", "--falx", "7"]) == 0
    printed = capsys.readouterr().out
    assert "ml: a wall, which does not move\n" in printed and "the falx" not in printed
    assert main([*words, "--force", "--brain", "7", "--tentorium", "1"]) == 0
    printed = capsys.readouterr().out
    assert "the tumour touches the tentorium" in printed and "a tentorium of 4" in printed
