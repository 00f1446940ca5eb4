"""The film that ships with the tests, who follows it, and a camera that gives its pictures."""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from ar.tracking.image_sequences import read_video
from scenes.tracked.calibration_file import read_calibration
from scenes.tracked.follower import Follower
from scenes.tracked.registration_file import read_registration
from scenes.tracked.tool_motion import ToolMotion
from scenes.tracked.tracked_tool import read_tool
from scenes.tracked.truth import read_truth
from sim.loads import Touching
from surrogate.model.learned import build_prediction

FILM = Path(__file__).parent / "data" / "film"


@dataclass(frozen=True)
class Recorded:
    """A deformer that knows what is true of the film: of the pose that is nearest to the one asked for."""

    anatomy: object
    vertices: np.ndarray
    poses: np.ndarray
    displacement: np.ndarray
    deeper: float = 0.0

    def deform(self, loads, start=None, at=None):
        cause = loads.get_only(Touching)
        row = np.abs(self.poses[:, :3, 3] - cause.pose[0, 0, :3, 3]).max(axis=1).argmin()
        return build_prediction(
            self.displacement[row][None], self.vertices, loads, [False], 0.0, np.full((2, 1), np.nan), ""
        )


def solve_reference_frames(stage):
    return read_truth(FILM / "truth.npz", stage.anatomy.digest, len(stage.tumour_vertices))


def follower_of(stage):
    truth = solve_reference_frames(stage)
    recorded = Recorded(stage.anatomy, stage.tumour_vertices, truth.T_scan_tool, truth.displacement)
    tool, registration = read_tool(FILM / "tool.json"), read_registration(FILM / "registration.json")
    return Follower(read_calibration(FILM / "camera.yaml"), registration, tool, ToolMotion(stage, recorded))


class Plugged:
    """A camera that gives some of the film's pictures, and then is unplugged."""

    def __init__(self, count):
        self.frames = [
            each.colour[..., ::-1] for each in islice(read_video(FILM / "film.mp4", 30.0, with_colour=True), count)
        ]
        self.released = False

    def isOpened(self):
        return True

    def read(self):
        return (True, self.frames.pop(0)) if self.frames else (False, None)

    def release(self):
        self.released = True
