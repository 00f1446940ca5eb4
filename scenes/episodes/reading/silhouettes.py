"""The tumour's masks against its own surface, drawn again by the episode's camera."""

from __future__ import annotations

import h5py
import numpy as np

from ar.optics.camera import Camera
from ar.optics.lens import Lens
from ar.overlay.outlines import silhouette
from sim.anatomy import Anatomy
from sim.errors import InputError

from .bodies import surface_rows
from .contents import Contents
from .rows import numbers_in, picture_of

# Frames that are drawn again, spread evenly.
LOOKED_AT = 12
# Share of a silhouette's pixels that single precision and another machine may turn over, and so many always.
TURNED, FEW = 1e-3, 4


def mask_findings(file: h5py.File, contents: Contents, anatomy: Anatomy | None) -> tuple[list[str], list[str]]:
    """What is wrong with `tumour_mask`, and what could not be looked at, each a sentence."""
    shapes = contents.shapes
    missing = [
        name
        for name in ("tumour_mask", "tumour_predicted", "tumour_nodes", "K", "T_camera_world")
        if name not in shapes
    ]
    if missing:
        return [], [f"silhouettes: there is no {missing[0]!r}"]
    if anatomy is None:
        return [], ["silhouettes: its anatomy is neither the template nor in `bodies` beside it"]
    nodes = numbers_in(file, contents, "tumour_nodes")
    triangles = surface_rows(anatomy.tumour_surface, nodes)
    if len(triangles) < len(anatomy.tumour_surface):
        return ["'tumour_nodes' are not those of its anatomy."], []
    whole = np.ones(contents.frames, bool)
    if "tumour_left" in shapes:
        whole = numbers_in(file, contents, "tumour_left").all(axis=1)
    frames = np.flatnonzero(whole)
    left = [] if whole.all() else [f"silhouettes of {int((~whole).sum())} frames in which tumour is cut out"]
    for frame in frames[np.unique(np.linspace(0, len(frames) - 1, LOOKED_AT).astype(int))] if len(frames) else ():
        found = picture_of(file, contents, "tumour_mask", int(frame)) > 0
        at = numbers_in(file, contents, "tumour_predicted", range(frame, frame + 1))[0]
        try:
            truth = silhouette(camera_of(file, contents, int(frame)), at, triangles)
        except (ValueError, InputError) as error:
            return [f"frame {frame} has no camera that draws: {error}"], left
        off = int(np.count_nonzero(found != truth))
        if off > FEW + TURNED * np.count_nonzero(truth):
            return [
                f"'tumour_mask' of frame {frame} differs in {off} of {np.count_nonzero(truth)} pixels from the "
                "silhouette of 'tumour_predicted'."
            ], left
    return [], left


def camera_of(file: h5py.File, contents: Contents, frame: int) -> Camera:
    """The camera of a frame; ValueError where its numbers are none of a camera."""
    moves = "K_of_frame" in contents.shapes
    K = (
        numbers_in(file, contents, "K_of_frame", range(frame, frame + 1))[0]
        if moves
        else numbers_in(file, contents, "K")
    )
    pose = numbers_in(file, contents, "T_camera_world", range(frame, frame + 1))[0]
    lens = Lens(*numbers_in(file, contents, "distortion").tolist()) if "distortion" in contents.shapes else None
    return Camera(K, pose, *contents.size, lens)
