"""Episodes of a few small frames, written by code: a box with a tumour, a tool that turns, and a camera."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from ar.optics.camera import Camera
from ar.overlay.outlines import compute_silhouette
from scenes.episodes.reading.bodies import find_surface_rows
from scenes.episodes.reading.schema import ARRAYS
from sim.anatomy import Anatomy
from sim.bodies.meshfile import write_anatomy

WIDTH, HEIGHT, SCALE = 40, 30, 1e-5


@dataclass(frozen=True, eq=False)
class Wanted:
    """What an episode shall hold; `every` is the distance between frames that were solved, 0 of the former format."""

    frames: int = 7
    every: int = 0
    seed: int = 0
    family: str = "press"
    width: int = WIDTH


def poses(frames: int) -> np.ndarray:
    """Of a tool that moves and turns, (frames, 4, 4)."""
    found = np.tile(np.eye(4), (frames, 1, 1))
    found[:, :3, :3] = Rotation.from_rotvec(np.linspace([0.1, 0, 0], [0.4, 0.5, -0.2], frames)).as_matrix()
    found[:, :3, 3] = np.linspace([0.0, 0.0, 0.05], [0.01, -0.02, 0.04], frames)
    return found


def read_episode_camera(anatomy: Anatomy, width: int = WIDTH) -> Camera:
    """A camera that looks down on the middle of the tumour."""
    middle = anatomy.mesh.nodes[anatomy.tumour_nodes].mean(axis=0)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = -T[:3, :3] @ (middle + [0.0, 0.0, 0.3])
    K = np.array([[150.0, 0.0, 0.5 * width], [0.0, 150.0, 0.5 * HEIGHT], [0.0, 0.0, 1.0]])
    return Camera(K, T, width, HEIGHT)


def read_images(anatomy: Anatomy, wanted: Wanted, tumour: np.ndarray) -> dict[str, np.ndarray]:
    """Pictures as they were before they are packed, each (frames, H, W, ...)."""
    draws = np.random.default_rng(wanted.seed)
    shape = (wanted.frames, HEIGHT, wanted.width)
    triangles = find_surface_rows(anatomy.tumour_surface, anatomy.tumour_nodes)
    camera = read_episode_camera(anatomy, wanted.width)
    return {
        "colour": np.repeat(draws.integers(0, 255, (wanted.frames, 1, 1, 3), np.uint8), HEIGHT, 1).repeat(shape[2], 2),
        "depth": draws.integers(0, 60000, shape).astype(np.uint16),
        "segmentation": draws.integers(0, 4, shape).astype(np.uint8),
        "tumour_mask": np.stack([compute_silhouette(camera, at, triangles) for at in tumour]).astype(np.uint8),
    }


def packed(name: str, picture: np.ndarray) -> np.ndarray:
    """One picture as bytes."""
    if name == "colour":
        return cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].ravel()
    return cv2.imencode(".png", picture)[1].ravel()


def write_episode(path: Path, anatomy: Anatomy, wanted: Wanted = Wanted()) -> Path:
    """Write one, and its anatomy to `bodies` beside it."""
    frames, nodes = wanted.frames, anatomy.tumour_nodes
    rest = anatomy.mesh.nodes[nodes]
    tumour = rest + np.linspace(0.0, 2e-3, frames)[:, None, None] * [1.0, 0.5, -1.0]
    solved = np.arange(frames) if not wanted.every else np.arange(0, frames, wanted.every)
    camera, tool = read_episode_camera(anatomy, wanted.width), poses(frames)
    arrays = {
        "time": np.arange(frames) / 30.0, "K": camera.K,
        "T_camera_world": np.tile(camera.T_camera_world, (frames, 1, 1)),
        "T_world_tool": tool, "tip": tool[:, :3, 3], "distance": np.linspace(0.02, np.nan, frames),
        "force": np.linspace([0.0, 0.0, 0.0], [0.0, 0.1, -0.3], frames), "tumour_predicted": tumour,
        "tumour_fem": tumour[solved] + [0.0, 0.0, 1e-4], "tumour_nodes": nodes, "tumour_rest": rest,
        **({"fem_frames": solved} if wanted.every else {}),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values).attrs["unit"] = ARRAYS[name].unit or "1"
        for name, pictures in read_images(anatomy, wanted, tumour).items():
            store = file.create_dataset(f"pictures/{name}", (frames,), h5py.vlen_dtype(np.uint8))
            for frame, picture in enumerate(pictures):
                store[frame] = packed(name, picture)
        texts = file.create_dataset("outcome_fem", data=np.array(["CONVERGED"] * len(solved), h5py.string_dtype()))
        texts.attrs["unit"] = "text"
        file.attrs.update(
            {
                "format": f"sulcus episode {2 if wanted.every else 1}", "scene": wanted.family, "width": wanted.width,
                "height": HEIGHT, "depth_scale_m": SCALE, "anatomy": anatomy.digest, "deformer": "linear",
                "segmentation": "1 cortex, 2 drape, 3 tool, 0 nothing", "date": "2026-11-26T21:00:00+00:00",
                "sulcus_version": "0.1.0", "finite_elements": "finite elements", "answered_by": "linear",
                "tool": "Probe",
                "seed": wanted.seed, "plan": "[press]\ncount = 2", "family": wanted.family,
                "parameters": json.dumps({"force_n": 0.1 + wanted.seed, "site": {"path": "straight"}}),
            }
        )  # fmt: skip
    body = path.parent / "bodies/0000/anatomy.vtu"
    if not body.exists():
        body.parent.mkdir(parents=True)
        write_anatomy(body, anatomy)
    return path


def write_three_episodes(folder, box):
    """Write episodes of 7, 9 and 4 frames, of the second every third frame solved; return the folder."""
    for number, wanted in enumerate((Wanted(7), Wanted(9, every=3, seed=1), Wanted(4, seed=2))):
        write_episode(folder / f"episode_{number:06d}.h5", box, wanted)
    return folder
