"""Views of a board: which are sharp, differ, and cover the picture."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_scenes import FACE, HEIGHT, WIDTH, K, picture, poses, views
from test_ar_intrinsics import BOARD

from ar.tracking.board_views import chosen, covered, directions, find_board


def test_directions_are_angles_between_planes():
    focal = max(WIDTH, HEIGHT)  # as it is assumed
    one, other = views(poses(2, tilt=20.0), 0.0)
    (R, _), (S, _) = ((T[:3, :3], T) for T in poses(2, tilt=20.0))
    true = np.arccos(R[:, 2] @ S[:, 2])
    assert abs(K[0, 0] - focal) / focal < 0.15 and directions([one, other], WIDTH, HEIGHT) == pytest.approx(
        true, rel=0.2
    )


def test_sharp_views_that_differ_are_chosen():
    places = poses(12)
    some = [replace(view, name=str(number)) for number, view in enumerate(views(places, 0.0))]
    again = [replace(view, name=f"{view.name} again") for view in some for _ in range(4)]
    blurred = replace(some[0], name="blurred", sharpness=0.3)
    assert len(chosen([*again, *some, blurred], FACE, 100)) == 60
    few = chosen([*again, blurred], FACE, 12)
    assert len({view.name for view in few}) == 12  # none twice
    assert chosen([], FACE, 12) == []


def test_blur_is_seen_in_whichever_direction():
    plain = picture(poses(1, tilt=0.0)[0])
    sharp = find_board(BOARD, "sharp", plain).sharpness
    for size in ((5, 1), (1, 5)):
        assert find_board(BOARD, "moved", cv2.blur(plain, size)).sharpness < 0.6 * sharp
    dark = find_board(BOARD, "dark", (0.3 * plain).astype(np.uint8)).sharpness
    assert dark == pytest.approx(sharp, rel=0.1)


def test_the_board_is_not_seen_where_there_is_too_little_of_it():
    plain = picture(poses(12)[3])
    assert find_board(BOARD, "grey", np.full_like(plain, 120)) is None
    assert find_board(BOARD, "noise", np.random.default_rng(0).integers(0, 256, plain.shape, np.uint8)) is None
    frontal = picture(poses(1, tilt=0.0)[0])
    whole = find_board(BOARD, "whole", frontal)
    heights = [whole.pixels[whole.points[:, 1] == row, 1].mean() for row in np.unique(whole.points[:, 1])]
    for rows in (2, 3):  # all below is hidden
        hidden = frontal.copy()
        hidden[int(0.1 * heights[rows - 1] + 0.9 * heights[rows]) :] = 120
        view = find_board(BOARD, "hidden", hidden)
        assert view is None if rows == 2 else len(view.pixels) == 3 * (FACE.columns - 1)


def test_covered_is_what_lies_between_corners():
    (one,) = views(poses(1, tilt=0.0), 0.0)
    box = replace(one, pixels=np.array([[0.0, 0.0], [319.0, 0.0], [319.0, 239.0], [0.0, 239.0], [100.0, 50.0]]))
    other = replace(box, pixels=box.pixels + [320.0, 0.0])
    assert covered([box, box], WIDTH, HEIGHT) == pytest.approx(0.25)
    assert covered([box, other], WIDTH, HEIGHT) == pytest.approx(0.5)
