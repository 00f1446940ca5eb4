"""Fine cortex on the FEM surface of any anatomy: gyri, sulci and vessels."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from theatres import coarse_brain, small, template_theatre

from scenes.play.fine_cortex import CROWN_DEPTH, build_fine_cortex
from scenes.play.stage import CORTEX, Stage
from scenes.script.craniotomy_frame import build_craniotomy_frame
from scenes.script.scene import SCENES, find_scene
from scenes.script.viewpoint import PLAIN_APPEARANCE, Appearance


@pytest.fixture(scope="module")
def stage():
    theatre = template_theatre()
    return Stage(small(), theatre.site, theatre.intensity)


def test_craniotomy_of_the_template_has_60000_triangles(stage):
    fine = stage.fine_cortex
    is_open = np.isin(fine.vertices, np.unique(stage.anatomy.open_surface)).astype(float)
    whole = fine.surface.interpolate(is_open[:, None])[:, 0] > 1.0 - 1e-9
    assert 60_000 <= whole[fine.surface.triangles].all(axis=1).sum() < 90_000


def test_scenes_of_a_patient_share_cortex_and_drape(stage):
    other = replace(stage, scene=find_scene("draw"))
    rest = stage.anatomy.mesh.nodes
    drapes = [one.build_layers(rest, None)[1] for one in (stage, other, stage.without_fine_cortex)]
    assert other.fine_cortex is stage.fine_cortex and drapes[0] is drapes[1] is not drapes[2]


def test_visual_displacement_is_the_fem_surface_displacement(stage):
    rest, fine = stage.anatomy.mesh.nodes, stage.fine_cortex
    shift = np.array([1e-3, -2e-3, 3e-3])
    build = stage.build_visible_cortex
    assert np.allclose(build(rest + shift).vertices - shift, build(rest).vertices)
    turn = Rotation.from_rotvec([0.2, 0.1, -0.3])
    assert np.allclose(build(turn.apply(rest.copy())).vertices, turn.apply(build(rest).vertices))
    # Anything else: depth below the interpolated FEM surface is what the relief and the rounding say.
    dent = rest + 5e-3 * np.exp(-((stage.site.compute_axis_distance(rest) / 8e-3) ** 2))[:, None] * stage.site.axis
    base = fine.surface.interpolate(dent[fine.vertices])
    away = np.linalg.norm(stage.build_visible_cortex(dent).vertices - base, axis=1)
    assert (away <= fine.surface.depth + 1.5e-3).all() and np.median(np.abs(away - fine.surface.depth)) < 0.1e-3


def test_sulci_are_a_few_millimetres_deep_and_darker(stage):
    fine = stage.fine_cortex
    depth = fine.surface.depth - CROWN_DEPTH
    inside = stage.site.compute_axis_distance(fine.surface.interpolate(stage.anatomy.mesh.nodes[fine.vertices]))
    inside = inside < stage.site.clearance
    assert depth.min() >= 0.0 and 2e-3 < depth[inside].max() < 5e-3
    assert np.median(depth[inside]) < 0.5e-3  # most of it is crowns
    deep, crown = inside & (depth > 1.5e-3), inside & (depth < 0.3e-3)
    assert deep.sum() > 300 and fine.colour[deep].mean() < 0.7 * fine.colour[crown].mean()


def test_fine_vertices_stay_below_the_drape_and_inside_the_brain(stage):
    fine = stage.fine_cortex
    base = fine.surface.interpolate(stage.anatomy.mesh.nodes[fine.vertices])
    found = stage.build_visible_cortex(stage.anatomy.mesh.nodes).vertices
    inside = stage.site.compute_axis_distance(base) < stage.site.clearance
    assert ((found - base) @ stage.site.axis)[inside].min() > -1e-9


def test_cortex_without_scan_has_gyri():
    anatomy = coarse_brain()
    site = build_craniotomy_frame(anatomy)
    stage = Stage(small(), site)
    picture = stage.render(stage.scene.viewpoint.build_camera(site), anatomy.mesh.nodes, None)
    cortex = picture.colour[picture.segmentation == CORTEX].astype(float)
    assert np.percentile(cortex[:, 1], 5) < 0.6 * np.percentile(cortex[:, 1], 75)
    first, again = (build_fine_cortex(site, anatomy.mesh, anatomy.open_surface, None) for _ in range(2))
    assert first.colour.tobytes() == again.colour.tobytes()


def test_walls_of_a_cavity_have_no_gyri():
    theatre, scene = template_theatre(), small("resection")
    stage = Stage(scene, theatre.site, theatre.intensity)
    loads = scene.build_loads(theatre.site, scene.path(5.0), 5.0)
    after = stage.select_stage(loads)
    assert after is not stage and len(after.anatomy.mesh.tets) < len(stage.anatomy.mesh.tets)
    fine, nodes = after.fine_cortex, after.anatomy.mesh.nodes
    cut = ~np.isin(fine.vertices, stage.anatomy.mesh.surface)
    share = fine.surface.interpolate(cut[:, None].astype(float))[:, 0]
    assert (share == 1.0).sum() > 50 and fine.surface.depth[share == 1.0] == pytest.approx(CROWN_DEPTH)
    assert np.ptp(fine.colour[share == 1.0], axis=0).max() < 1e-6
    assert np.isfinite(after.build_visible_cortex(nodes).vertices).all()


def test_data_set_scenes_use_the_plain_appearance(stage):
    theatre = template_theatre()
    assert not PLAIN_APPEARANCE.natural and not Appearance(vessels=3).natural
    assert {name for name in SCENES if not find_scene(name).look.natural} == {"microscope"}
    plain = Stage(replace(small(), look=PLAIN_APPEARANCE), theatre.site, theatre.intensity)
    layer = plain.build_visible_cortex(theatre.anatomy.mesh.nodes)
    assert layer.solid is not None
    assert np.array_equal(layer.vertices, theatre.anatomy.mesh.nodes[plain.visible_vertices])


def test_smooth_outline_stays_close_to_the_fem_tumour(stage):
    rough = stage.tumour_at_rest
    smooth = stage.smooth_tumour(rough)
    surface = stage.rounded_tumour
    away = np.linalg.norm(smooth.vertices - surface.interpolate(rough.vertices), axis=1)
    assert np.median(away) < 0.15e-3 and away.max() < 0.4e-3 and len(smooth.triangles) > 4 * len(rough.triangles)
