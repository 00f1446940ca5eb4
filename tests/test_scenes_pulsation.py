"""Built-in scene of a ball on a pulsating brain."""

from dataclasses import replace

import numpy as np
from test_scenes_palpate import small
from theatres import player

from scenes.play.reference import solve_reference_frames
from sim.effects import Pulsation


class TestPulsation:
    def test_tool_force_correlates_with_the_pulsation(self, theatre):
        scene = replace(small("pulsation"), duration=3.0)
        frames = list(player(theatre, scene, "fem").play_frames(3))
        reads = np.array([-frame.deformation.reaction[0, 0, 2] for frame in frames if frame.time >= 1.0])
        swells = Pulsation().compute_swelling(np.array([frame.time for frame in frames if frame.time >= 1.0]))
        assert np.corrcoef(reads, swells)[0, 1] > 0.95
        assert reads.max() > 1.05 * reads.min() > 0.0

    def test_reference_frames_converge_in_sequence(self, theatre):
        scene = small("pulsation")
        loads = [scene.build_loads(theatre.site, scene.path(time), time) for time in (0.0, 0.8, 1.25, 1.6)]
        truth = solve_reference_frames(theatre, scene, loads)
        assert all(outcome.good for outcome in truth.outcome) and truth.displacement[3].any()
