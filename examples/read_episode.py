"""An episode read in windows: how far the tumour moves while a tool presses, and how deep its picture is.

`collect` writes what `sulcus collect` writes. `read_episodes` decodes pictures, and gives a window of frames at a time.
Use `EpisodeDataset` in its place for PyTorch: both take a folder too, and give windows in the same order.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from scenes import Viewpoint, collect, find_scene, get_template_path, open_theatre, read_episodes

small = Viewpoint(width=160, height=120)
scene = replace(find_scene("press"), viewpoint=small, duration=1.0, frames_per_second=10.0)
theatre = open_theatre(get_template_path(), device="cpu")
collect(Path("press.h5"), theatre, theatre.build_player("series-gp", scene), "series-gp", iter)

windows = read_episodes("press.h5", ["colour", "depth", "tumour_predicted", "tumour_rest"], window=5, stride=5)
print(f"{len(windows)} windows of {windows.window} frames")

last = windows[-1]
motion = 1e3 * np.linalg.norm(last["tumour_predicted"] - last["tumour_rest"], axis=2).mean(axis=1)
seen = last["depth"][last["depth"] > 0.0]
print(f"frames {last['frame'].tolist()}: the tumour has moved by {motion.round(2).tolist()} mm")
print(f"what is seen lies {seen.min():.3f} to {seen.max():.3f} m before the camera")
assert last["colour"].shape == (5, 120, 160, 3) and motion[-1] > 0.5
