"""Distance from a resting tool's tip to the tumour: measured at the drawn position of the tool."""

import numpy as np
import pytest
import trimesh

from sim.bodies.open_cortex import open_cortex
from sim.bodies.tip_distance import build_tip_gauge
from sim.errors import InputError
from sim.loads import Touching
from sim.tools import Ball
from surrogate.data.indentation import get_only_pushes
from surrogate.data.tool_loads import draw
from surrogate.data.tool_poses import draw_poses


@pytest.fixture(scope="module")
def gauge(box):
    return build_tip_gauge(box)


def surface(positions, triangles):
    return trimesh.Trimesh(positions, triangles, process=False)


def test_tip_distance_is_measured_from_resting_ball(box, pretender, gauge):
    loads = draw("palpation", box, 6, 3)
    answer = pretender.deform(loads)
    pushed, axis = get_only_pushes(loads), open_cortex(box).axis
    found = gauge.compute_distances(loads, answer.displacement, answer.nodes)
    lifted = gauge.compute_distances(loads, answer.displacement, answer.nodes, lift=2e-3)
    for row in range(6):
        moved = box.mesh.nodes + answer.displacement[row]
        cortex = surface(box.mesh.nodes, box.open_surface)
        at, _, triangle = trimesh.proximity.closest_point_naive(cortex, pushed.point[row][None])
        share = trimesh.triangles.points_to_barycentric(cortex.triangles[triangle], at)[0]
        middle = share @ moved[box.open_surface[triangle[0]]]
        # Bisection: as far down as the ball enters nothing.
        high, low, radius = -0.05, 0.02, pushed.footprint[row]
        after = surface(moved, box.open_surface)
        for _ in range(40):
            half = 0.5 * (high + low)
            away = trimesh.proximity.closest_point_naive(after, (middle + half * axis)[None])[1][0]
            high, low = (half, low) if away > radius else (high, half)
        tip = middle + (high + radius) * axis
        tumour = surface(moved, box.tumour_surface)
        to = trimesh.proximity.closest_point_naive(tumour, np.stack([tip, tip - 2e-3 * axis]))[1]
        assert found[row] == pytest.approx(to[0], abs=1e-8) and lifted[row] == pytest.approx(to[1], abs=1e-8)


def test_tip_distance_of_posed_tool_uses_its_pose(box, gauge):
    loads = draw_poses("palpation", box, 5, 0, Ball(6e-3))
    still = np.zeros((5, len(gauge.nodes), 3))
    touching = loads.get(Touching)
    assert touching is not None
    pose = touching.pose[:, 0]
    tip = pose[:, :3, 3] + 6e-3 * pose[:, :3, 2] + 6e-3 * open_cortex(box).axis
    away = trimesh.proximity.closest_point_naive(surface(box.mesh.nodes, box.tumour_surface), tip)[1]
    assert gauge.compute_distances(loads, still, gauge.nodes, Ball(6e-3)) == pytest.approx(away, abs=1e-12)
    with pytest.raises(InputError, match="no tip"):
        gauge.compute_distances(loads, still, gauge.nodes)
