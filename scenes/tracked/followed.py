"""One body followed through a film, in the camera's frame or beside the patient's reference."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.pictures import GIVE, Named, film_of
from ar.tracking.pose import Pose, Verdict
from ar.tracking.stamp import read_stamp
from ar.tracking.targets import all_targets
from ar.tracking.track import Tracked, Tracker
from sim.errors import InputError
from sim.runtime.outside_files import read_as

from .pose_file import TrackedRow

AT_REST = Pose(np.eye(4), np.zeros((6, 6)), 0.0, 1 << 16)
"""The camera in its own frame."""


def rows_of(film: Iterable[Named], calibration: Calibration, body: str, frame: str) -> Iterator[TrackedRow]:
    """A row for each picture: of `body` (tool, patient, board, camera) in the `frame` of one of them that is seen.

    Raises
    ------
    ValueError
        Pictures of another size than the camera was calibrated at.
    """
    targets = {each.name: each for each in all_targets()}
    wanted = [each for each in (body, frame) if each != "camera"]
    tracker = Tracker(calibration.camera(np.eye(4)), tuple(targets[name] for name in wanted))
    state: Tracked | None = None
    for picture in film:
        begun = time.perf_counter()
        state = tracker.track(picture.grey, state)
        verdict, pose, lacks = _known(state, wanted)
        if pose is not None and body == "camera":
            pose = AT_REST.seen_from(pose)
        yield TrackedRow(picture.time, verdict, pose, time.perf_counter() - begun, lacks)


def followed(path: Path, calibration: Calibration, body: str, frame: str, rate: float) -> Iterator[TrackedRow]:
    """A row for each picture: of `body` (tool, patient, board, camera) in the `frame` of one of them that is seen.

    Times are those that pictures hold, or else those of the film.

    Raises
    ------
    InputError
        What cannot be read, and pictures of another size than the camera was calibrated at.
    """
    count = 0
    with read_as(path, "a film", GIVE):
        try:
            for row in rows_of(map(_at_its_time, film_of(path, rate)), calibration, body, frame):
                count += 1
                yield row
        except ValueError as error:
            raise InputError(str(error)) from error
    if not count:
        raise InputError(f"{path}: holds no picture. {GIVE}")


def _at_its_time(picture: Named) -> Named:
    """A picture with the time that it holds, if it holds one."""
    stamp = read_stamp(picture.grey)
    return picture if stamp is None else replace(picture, time=stamp)


def _known(state: Tracked, wanted: list[str]) -> tuple[Verdict, Pose | None, str]:
    """The pose of the first target, beside the second if there are two; else what is known of the one that lacks."""
    for name in wanted:
        if name not in state.poses:
            return state.verdicts[name], None, name
    pose, *others = (state.poses[name] for name in wanted)
    return Verdict.GOOD, pose.seen_from(others[0]) if others else pose, ""
