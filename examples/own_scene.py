"""A scene of your own, with its own path of the tool: it circles over the tumour.

`sulcus demo own_scene.py` plays it on the page, `sulcus render own_scene.py --out frames` as pictures. Run as a script
it plays a few frames without a screen; the shipped model says where the tumour is in each.
"""

import math

from scenes import Scene, Touch, Viewpoint, open_theatre

TURN = 2.0  # [s]


def circle(time: float) -> Touch:
    """Push with 0.15 N at a time [s] on a circle of 6 mm round the middle of the open cortex; start softly."""
    angle = 2.0 * math.pi * time / TURN
    return Touch(6e-3 * math.cos(angle), 6e-3 * math.sin(angle), force=0.15 * min(1.0, time / 0.5))


SCENE = Scene("circle", __doc__ or "", circle, duration=TURN, viewpoint=Viewpoint(width=320, height=240))

if __name__ == "__main__":
    theatre = open_theatre(device="cpu")
    frames = list(theatre.build_player(theatre.select_best(SCENE), SCENE).play_frames(every=15))
    for frame in frames:
        assert frame.deformation.outcome[0].good and frame.distance is not None
        moved, away = 1e3 * frame.moved, 1e3 * frame.distance
        print(f"{frame.time:.1f} s: the tumour moved {moved:.2f} mm and is {away:.1f} mm from the tip")
    assert 0.4e-3 < min(frame.moved for frame in frames[1:]) < 0.7e-3
