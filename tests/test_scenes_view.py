"""3-D view of the page: deformed tumour, and the comparison for a previous load."""

from dataclasses import replace

import numpy as np
import pytest
from theatres import small
from visitor import report, wait_for

from ar.page.elements import build_tabs
from ar.page.parts import SceneImage
from scenes.page.fem_worker import FemWorker
from scenes.page.view import FEM_COLOUR, STALE_COLOUR, build_page_bodies, build_static_bodies
from scenes.script.craniotomy_frame import HOLE_RATIO


def test_page_3d_view_shows_the_deformed_tumour(demo, theatre):
    demo.wish.set(plays=False, number=30)
    assert demo.run(1.0) >= 1
    tumour = np.asarray(demo.browser.meshes["tumour"].vertices)
    rest = demo.stage.build_tumour(theatre.anatomy.mesh.nodes).vertices
    assert wait_for(lambda: np.linalg.norm(demo.browser.meshes["tumour"].vertices - rest, axis=1).max() > 5e-4)
    meshes = demo.browser.meshes
    assert wait_for(
        lambda: (
            demo.run(0.3)
            and np.linalg.norm(meshes["finite elements"].vertices - meshes["tumour"].vertices, axis=1).max() < 3e-4
        )
    )
    assert tumour.shape == rest.shape


def test_comparison_of_previous_load_is_greyed_until_new_one(demo, monkeypatch):
    """After manual motion the last comparison is grey until the new FEM solution."""
    demo.wish.set(plays=False, number=60)
    assert wait_for(lambda: demo.run(0.3) and "|difference from FEM: mean" in report(demo))
    assert "previous load" not in report(demo)
    tints = []
    monkeypatch.setattr(demo.browser, "tint", lambda name, colour: tints.append(colour))
    asked = []
    monkeypatch.setattr(demo.fem_worker, "request_frame", lambda *request: asked.append(request[:2]))
    demo.wish.set_manual_input(x=0.004, force=0.25)
    demo.run(0.5)
    assert wait_for(lambda: "force 0.25 N" in report(demo))
    said = demo.browser.shown[2]
    assert '<p class="stale">previous load: difference from FEM' in said and "<p>difference from FEM" not in said
    assert tints[-1] == STALE_COLOUR and len(asked) == 1
    FemWorker.request_frame(demo.fem_worker, *asked[0])
    assert wait_for(lambda: demo.run(0.3) and "<p>difference from FEM" in demo.browser.shown[2])
    assert "previous load" not in report(demo) and tints[-1] == FEM_COLOUR


def test_page_3d_view_has_craniotomy_scan_and_slice_planes(theatre):
    stage = theatre.build_stage(small())
    bodies = {body.name: body for body in build_page_bodies(stage)}
    hole = HOLE_RATIO * theatre.site.clearance
    away = theatre.site.compute_axis_distance(bodies["edge"].vertices)
    assert away.min() == pytest.approx(hole, rel=0.05) and away.max() < hole + 3e-3
    assert len(bodies["cortex"].triangles) > len(bodies["sulci"].triangles) > 0
    assert np.array_equal(bodies["scan"].vertices, stage.tumour_at_rest.vertices)
    legend = build_tabs(surfaces=list(bodies.values())).partition('<p class="key">')[2].partition("</p>")[0]
    assert 'rgb(20% 94% 42%)">&#9632;</b> tumour now</span>' in legend and legend.count("<span>") == 3
    planes = [part for part in build_static_bodies(stage) if isinstance(part, SceneImage)]
    assert [plane.name for plane in planes] == ["axial", "coronal", "sagittal"]
    assert 0.05 < max((plane.image[..., 3] > 0).mean() for plane in planes) < 0.55
    for intensity, count in ((stage.intensity, 3), (None, 0)):  # a texture of vessels is no scan
        drawn = replace(stage.scene, look=replace(stage.scene.look, vessels=3))
        found = build_static_bodies(replace(stage, scene=drawn, intensity=intensity))[-3:]
        same = [np.array_equal(a.image, b.image) for a, b in zip(found, planes, strict=True) if hasattr(a, "image")]
        assert same == [True] * count
