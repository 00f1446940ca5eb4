"""Posture of the head, and drainage of its fluid."""

import numpy as np
import pytest
from theatres import player, sinking

from scenes.script.head_pose import SUPINE, HeadPose, build_drained_turn, get_supine_pose
from scenes.script.tool_paths import Touch


class TestLying:
    def test_fluid_drains_completely_before_the_head_turns(self):
        lie, angle = build_drained_turn(2.0, 1.0, 3.0, 0.5), 0.5
        assert lie(0.0) == HeadPose(SUPINE, 1.0) == get_supine_pose(7.0)
        assert lie(2.0) == HeadPose(SUPINE, 0.0) == lie(3.0) and 0.4 < lie(1.0).fluid < 0.6
        for time in (6.0, 9.0):
            assert lie(time).direction == pytest.approx((-np.sin(angle), -np.cos(angle), 0.0))
        levels = [lie(time).fluid for time in np.linspace(0.0, 2.0, 50)]
        assert (np.diff(levels) < 0.0).all()

    @pytest.mark.parametrize("direction", [SUPINE, (0.0, 0.0, -3.0), (-1.0, -1.0, 0.2)])
    def test_full_head_lies_in_fluid_and_drained_head_does_not(self, box, direction):
        nodes = box.mesh.nodes
        for fluid, wet in ((1.0, len(nodes)), (0.0, 0)):
            found = HeadPose(direction, fluid).build_posture(nodes)
            assert np.linalg.norm(found.direction) == pytest.approx(1.0)
            assert (-nodes @ found.direction[0] < found.csf_level[0]).sum() == wet

    def test_head_in_scan_posture_has_no_displacement(self, theatre):
        frame = player(theatre, sinking(), "fem").draw(0, 0.0, Touch())
        assert not frame.deformation.displacement.any()
