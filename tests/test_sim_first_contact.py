"""First contact of a ball moving towards a surface: contact without penetration, and known cases."""

import numpy as np
import pytest

from sim.errors import InputError
from sim.geometry.first_contact import find_resting_tip, find_resting_tips

DOWN = np.array([0.0, 0.0, -1.0])
RADIUS = 7e-3
CORNERS = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.05, 0.0]])
ONE = np.array([[0, 1, 2]])


def landscape(seed, cells=12, size=0.06, height=4e-3):
    """A bumpy square of triangles around the origin, [m]."""
    random = np.random.default_rng(seed)
    line = np.linspace(-0.5 * size, 0.5 * size, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    nodes = np.column_stack([x.ravel(), y.ravel(), random.normal(scale=height, size=x.size)])
    nodes[:, :2] += random.uniform(-0.3, 0.3, (len(nodes), 2)) * size / cells
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = first, first + cells + 1, first + cells + 2, first + 1
    return nodes, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def samples(nodes, triangles, rows):
    """Points all over the triangles."""
    i, j = np.meshgrid(np.arange(rows + 1), np.arange(rows + 1), indexing="ij")
    share = np.stack([i, j, rows - i - j], axis=-1)[i + j <= rows] / rows
    return np.einsum("qc,fci->fqi", share, nodes[triangles]).reshape(-1, 3)


def sampled_tip(points, through, inward, radius):
    """Where the ball first touches one of many points."""
    arm = points - through
    along = arm @ inward
    room = radius**2 - (np.einsum("pi,pi->p", arm, arm) - along**2)
    return through + (np.min((along - np.sqrt(np.maximum(room, 0.0)))[room >= 0.0]) + radius) * inward


@pytest.mark.parametrize("seed", range(6))
def test_resting_ball_touches_surface_without_penetration(seed):
    nodes, triangles = landscape(seed)
    random = np.random.default_rng(seed)
    points = samples(nodes, triangles, 40)
    for _ in range(8):
        inward = DOWN + random.normal(scale=0.3, size=3)
        inward /= np.linalg.norm(inward)
        through = np.append(random.uniform(-0.01, 0.01, 2), 0.0) + random.uniform(-0.2, 0.2) * inward
        radius = random.uniform(1e-3, 8e-3)
        tip = find_resting_tip(nodes, triangles, through, inward, radius)
        assert np.linalg.norm(np.cross(tip - through, inward)) < 1e-12  # it stays on its line
        deepest = radius - np.linalg.norm(points - (tip - radius * inward), axis=1).min()
        assert -2e-5 < deepest < 1e-12  # samples are a tenth of a millimetre apart
        # What is sampled is less of a surface: the ball would come farther, if at all.
        assert -1e-12 < (sampled_tip(points, through, inward, radius) - tip) @ inward < 1e-4


def test_ball_tip_rests_on_plane():
    through = np.array([0.015, 0.015, 0.2])
    assert find_resting_tip(CORNERS, ONE, through, DOWN, RADIUS) == pytest.approx([0.015, 0.015, 0.0], abs=1e-15)
    assert find_resting_tip(CORNERS, ONE[:, ::-1], through, DOWN, RADIUS)[2] == pytest.approx(0.0, abs=1e-15)
    # Aslant: the ball touches before its tip is there, by r / cos - r.
    inward = np.array([0.6, 0.0, -0.8])
    tip = find_resting_tip(CORNERS, ONE, np.array([0.015, 0.015, 0.0]) - 0.2 * inward, inward, 3e-3)
    assert tip[2] == pytest.approx(3e-3 - 3e-3 * 0.8, abs=1e-15)


def test_ball_rests_on_edge_or_vertex_outside_the_face():
    beside = 4e-3
    down = RADIUS - np.sqrt(RADIUS**2 - beside**2)
    for through in ([0.02, -beside, 0.1], [-beside, 0.02, 0.1], [-0.6 * beside, -0.8 * beside, 0.1]):
        tip = find_resting_tip(CORNERS, ONE, np.array(through), DOWN, RADIUS)
        assert tip == pytest.approx([*through[:2], -down], abs=1e-15)
    # A steep edge between two roofs that fall off faster than the ball.
    ridge = np.array([[0.0, -0.05, 0.0], [0.0, 0.05, 0.02], [0.01, 0.0, -0.09], [-0.01, 0.0, -0.09]])
    roofs = np.array([[0, 2, 1], [0, 1, 3]])
    slope = np.hypot(0.1, 0.02) / 0.1  # 1 / cos of the ridge
    tip = find_resting_tip(ridge, roofs, np.array([0.0, 0.0, 0.1]), DOWN, RADIUS)
    assert tip[2] == pytest.approx(0.01 + RADIUS * (slope - 1.0), abs=1e-15)


def test_ball_on_sphere_rests_at_analytic_height():
    size, beside = 0.03, 0.012
    theta, phi = np.meshgrid(np.linspace(0.0, np.pi, 181), np.linspace(0.0, 2.0 * np.pi, 361)[:-1], indexing="ij")
    nodes = size * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    first = (np.arange(180)[:, None] * 360 + np.arange(360)).ravel()
    after = first - first % 360 + (first + 1) % 360
    triangles = np.concatenate(
        [np.stack(t, axis=1) for t in ((first, first + 360, after + 360), (first, after + 360, after))]
    )
    tip = find_resting_tip(nodes.reshape(-1, 3), triangles, np.array([beside, 0.0, 0.0]), DOWN, RADIUS)
    assert tip[2] == pytest.approx(np.sqrt((size + RADIUS) ** 2 - beside**2) - RADIUS, abs=size * 1e-4)


def test_ball_rests_on_hole_narrower_than_itself():
    wall = np.array(
        [
            [-0.05, -0.05, 0.0],
            [-5e-3, -0.05, 0.0],
            [-5e-3, 0.05, 0.0],
            [5e-3, -0.05, 0.0],
            [0.05, 0.0, 0.0],
            [5e-3, 0.05, 0.0],
        ]
    )
    tip = find_resting_tip(wall, np.array([[0, 1, 2], [3, 4, 5]]), np.array([0.0, 0.0, 0.1]), DOWN, RADIUS)
    assert tip[2] == pytest.approx(-(RADIUS - np.sqrt(RADIUS**2 - 5e-3**2)), abs=1e-15)


def test_degenerate_triangles_act_as_edges_or_points():
    flat = np.array([[-0.05, 0.0, 0.0], [0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    line = np.array([0.01, 3e-3, 0.1])
    down = RADIUS - np.sqrt(RADIUS**2 - 3e-3**2)
    assert find_resting_tip(flat, ONE, line, DOWN, RADIUS)[2] == pytest.approx(-down, abs=1e-15)
    assert find_resting_tip(np.zeros((3, 3)), ONE, np.array([0.0, 3e-3, 0.1]), DOWN, RADIUS)[2] == pytest.approx(-down)


def test_ball_that_misses_the_surface_is_reported():
    with pytest.raises(InputError, match="misses the surface"):
        find_resting_tip(CORNERS, ONE, np.array([0.02, -0.008, 0.1]), DOWN, RADIUS)


def test_several_balls_rest_at_positions_of_single_balls():
    """Separate surfaces, lines and radii; one ball misses its surface."""
    nodes, triangles = landscape(4)
    random = np.random.default_rng(4)
    surfaces = nodes + random.normal(scale=1e-3, size=(9, *nodes.shape))
    through = np.append(random.uniform(-0.01, 0.01, (9, 2)), random.uniform(-0.1, 0.1, (9, 1)), axis=1)
    radius = random.uniform(1e-3, 8e-3, 9)
    tips = find_resting_tips(surfaces, triangles, through, DOWN, radius)
    alone = [
        find_resting_tip(*each, DOWN, r) for *each, r in zip(surfaces, [triangles] * 9, through, radius, strict=True)
    ]
    assert tips == pytest.approx(np.array(alone), abs=1e-15)
    through[7, 0] = 1.0
    with pytest.raises(InputError, match=rf"the ball of radius {1e3 * radius[7]:.3g} mm through .* misses the surface"):
        find_resting_tips(surfaces, triangles, through, DOWN, radius)
