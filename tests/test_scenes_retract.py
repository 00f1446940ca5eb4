"""Built-in scene of a held blade."""

import numpy as np
import pytest
from test_scenes_palpate import small
from theatres import player

from scenes.script.tool_paths import IDLE_HEIGHT, Touch
from sim.deformation import Outcome
from sim.loads import Retracted
from sim.tools import compute_distances


class TestRetract:
    def test_force_on_held_blade_decreases_with_relaxation(self, theatre):
        frames = list(player(theatre, small("retract"), "fem").play_frames(15))
        (cause,) = frames[-1].loads.causes
        assert isinstance(cause, Retracted)
        reads = np.array([np.linalg.norm(frame.deformation.reaction[0, 0, :3]) for frame in frames])
        held = np.array([frame.time for frame in frames]) >= 1.5
        assert (np.diff(reads[held]) < 0.0).all() and reads[-1] < 0.9 * reads[held][0]
        outcomes = [frame.deformation.outcome[0] for frame in frames]  # so small a body is strained beyond 50 %
        assert reads[0] == 0.0 and all(one.good or one is Outcome.OVERSTRAINED for one in outcomes)

    @pytest.mark.parametrize(
        "touch", [Touch(depth=-IDLE_HEIGHT), Touch(depth=3e-3), Touch(0.0, 0.0, 0.0, (0.5, 0.0), 3e-3)]
    )
    def test_blade_starts_above_the_tissue_and_moves_to_its_pose(self, theatre, touch):
        scene, site = small("retract"), theatre.site
        cause = scene.build_loads(site, touch, 0.0).get(Retracted)
        apart = compute_distances(scene.tool.shape, cause.pose[0], theatre.anatomy.mesh.nodes)
        upright = site.compute_direction(touch) @ site.axis
        assert apart.min() == pytest.approx(IDLE_HEIGHT * upright, abs=0.3e-3)
        moved = cause.pose[0].copy()
        moved[:3, 3] += cause.displacement[0]
        np.testing.assert_allclose(moved, scene.compute_pose(site, touch), atol=1e-15)
        assert cause.displacement[0] == pytest.approx((IDLE_HEIGHT + touch.depth) * site.compute_direction(touch))
