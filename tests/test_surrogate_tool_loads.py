"""Loads of surgical tools on the open cortex, and rejected nominal loads."""

import numpy as np
import pytest

from sim.errors import InputError
from sim.loads import Pushed
from surrogate.data.tool_loads import (
    MAX_PRESSURE,
    PLANE_MODULUS,
    TOOLS,
    PublishedSettings,
    compute_rejected_share,
    describe_rejected_loads,
    draw,
    pick_far_points,
)


def pushes(*args):
    return draw(*args).get(Pushed)


@pytest.mark.parametrize("name", TOOLS)
def test_tool_loads_stay_in_their_ranges(box, patch, name):
    tool, loads = TOOLS[name], pushes(name, box, 200, 1)
    force = np.linalg.norm(loads.force, axis=1)
    pressure = force / (np.pi * loads.footprint**2)
    cosine = -loads.force[:, 2] / force  # the open top faces +z
    assert (loads.footprint >= tool.radius_range[0]).all() and (loads.footprint <= tool.radius_range[1]).all()
    assert (force >= tool.force_range[0] * (1 - 1e-12)).all() and (force <= tool.force_range[1] * (1 + 1e-12)).all()
    assert pressure.max() <= MAX_PRESSURE and pressure.min() >= tool.pressure_range[0]
    assert (3 * force / (4 * PLANE_MODULUS * loads.footprint)).max() <= tool.max_depth
    assert cosine.min() >= np.cos(tool.max_angle) - 1e-12
    assert (patch.compute_edge_distance(loads.point) >= loads.footprint).all()


def test_load_points_directions_and_forces_are_uniform(box, patch):
    loads = pushes("bipolar", box, 4000, 0)
    inner = np.linalg.norm(loads.point[:, :2], axis=1) < 10e-3
    allowed = patch.compute_coverage(np.zeros((1, 3)), 10e-3) * patch.areas.sum()
    pressable = (
        patch.areas.sum()
        - 0.85e-3 * np.linalg.norm(patch.boundary_edges[:, 1] - patch.boundary_edges[:, 0], axis=1).sum()
    )
    assert inner.mean() == pytest.approx(allowed / pressable, rel=0.12)
    loads = pushes("palpation", box, 4000, 0)
    force = np.linalg.norm(loads.force, axis=1)
    cosine = -loads.force[:, 2] / force
    # No draw below 0.25 N is too deep: the octaves below it are equally full.
    assert (force < 0.1).sum() == pytest.approx(((force >= 0.1) & (force < 0.2)).sum(), rel=0.1)
    assert np.mean(cosine) == pytest.approx((1 + np.cos(np.pi / 4)) / 2, abs=0.01)


def test_load_depends_only_on_seed_and_number(box):
    for preset in ("palpation", "mixed", "seed"):
        few, many = pushes(preset, box, 7, 5), pushes(preset, box, 40, 5)
        assert np.array_equal(few.point, many.point[:7]) and np.array_equal(few.force, many.force[:7])
    assert not np.array_equal(pushes("palpation", box, 7, 6).point, few.point)


def test_mixed_preset_uses_every_tool(box):
    radii = pushes("mixed", box, 200, 0).footprint
    for tool in TOOLS.values():
        assert ((radii >= tool.radius_range[0]) & (radii <= tool.radius_range[1])).sum() > 20


def test_seed_preset_follows_the_published_protocol(box):
    loads = pushes("seed", box, 100_000, 0)
    centre = box.mesh.nodes[box.tumour_nodes].mean(axis=0)
    distance = np.linalg.norm(loads.point - centre, axis=1)
    magnitude = np.linalg.norm(loads.force, axis=1)
    assert len(loads.point) == 11 * 100 * 20
    assert len(np.unique(loads.point, axis=0)) == 11 and distance.min() >= 20e-3 and distance.max() <= 28e-3
    assert np.allclose(np.unique(magnitude.round(9)), np.arange(0.10, 1.051, 0.05))
    assert (loads.footprint == PublishedSettings.radius).all()
    rows = np.column_stack([loads.point, loads.force]).round(9)
    assert len(np.unique(rows, axis=0)) == len(rows)


@pytest.mark.parametrize(
    ("preset", "count", "seed", "words"),
    [("hammer", 5, 0, "palpation"), ("palpation", 0, 0, "--count"), ("palpation", 5, -1, "--seed")],
)
def test_invalid_draw_parameters_are_rejected(box, preset, count, seed, words):
    with pytest.raises(InputError, match=words):
        draw(preset, box, count, seed)


def test_tool_too_large_for_the_patch_is_rejected(make_small_opening):
    with pytest.raises(InputError, match="--craniotomy"):
        draw("spatula", make_small_opening, 3, 0)


@pytest.fixture
def make_small_opening(box):
    from sim.anatomy import Anatomy

    near = box.craniotomy & (np.linalg.norm(box.mesh.nodes, axis=1) < 9e-3)
    return Anatomy(box.mesh, box.fixed | ~near[:, None], box.slide_normal, near)


def test_spread_selects_points_far_from_each_other():
    points = np.random.default_rng(0).random((400, 3)) * [1, 1, 0]
    chosen = points[pick_far_points(points, 9)]
    gaps = np.linalg.norm(chosen[:, None] - chosen, axis=2) + np.eye(9) * 9
    assert gaps.min() > 0.3  # a 3 x 3 grid has 0.33-0.5


def test_covered_share_equals_disc_area_share(box, patch):
    assert patch.compute_coverage(np.zeros((1, 3)), 12e-3) == pytest.approx(
        np.pi * 12e-3**2 / patch.areas.sum(), rel=0.03
    )


@pytest.mark.parametrize("name", TOOLS)
def test_rejected_share_matches_random_recount(name):
    """Counted again with random loads and the limits written in this test."""
    tool, random = TOOLS[name], np.random.default_rng(0)
    radius = random.uniform(*tool.radius_range, 40_000)
    force = np.exp(random.uniform(*np.log(tool.force_range), 40_000))
    pressure, depth = force / (np.pi * radius**2), 3.0 * force / (4.0 * PLANE_MODULUS * radius)
    refused = (pressure < tool.pressure_range[0]) | (pressure > tool.pressure_range[1]) | (depth > tool.max_depth)
    assert compute_rejected_share(name) == pytest.approx(refused.mean(), abs=0.01)


def test_rejected_share_is_described_in_words():
    assert describe_rejected_loads("palpation").startswith("10 % of the nominal loads of palpation")
    assert compute_rejected_share("mixed") == pytest.approx(np.mean([compute_rejected_share(name) for name in TOOLS]))
    assert compute_rejected_share("seed") == compute_rejected_share("anything") == 0.0
    assert describe_rejected_loads("seed") == ""
