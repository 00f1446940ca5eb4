"""What sensors add to the truth: grey levels of pictures, forces that are read, poses that are tracked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from .draws import random_of

QUANTILES = ndtri((np.arange(256) + 0.5) / 256)


def noisy(colour: np.ndarray, deviation: float, random: np.random.Generator) -> np.ndarray:
    """A picture (H, W, 3) uint8 with normal noise of so many grey levels, alike in every pixel and colour.

    The noise has 256 values, each as probable: quantiles of the normal law. They are quicker to draw by far, and fit
    into a byte up to a deviation of 40.
    """
    if deviation == 0.0:
        return colour
    steps = np.rint(deviation * QUANTILES).astype(np.int8).tobytes()
    added = np.frombuffer(random.bytes(colour.size).translate(steps), np.int8).reshape(colour.shape)
    total = np.add(colour, added, dtype=np.int16)
    return np.clip(total, 0, 255, out=total).astype(np.uint8)


def jittered(poses: np.ndarray, metres: float, radians: float, random: np.random.Generator) -> np.ndarray:
    """Poses (n, 4, 4) as a tracker has them: each apart is off along and about its own axes by such deviations."""
    off = np.tile(np.eye(4), (len(poses), 1, 1))
    off[:, :3, 3] = metres * random.standard_normal((len(poses), 3))
    off[:, :3, :3] = Rotation.from_rotvec(radians * random.standard_normal((len(poses), 3))).as_matrix()
    return poses @ off


def sensed(columns: Mapping[str, Any], noise: Mapping[str, float], seed: int, number: int) -> dict[str, np.ndarray]:
    """What sensors read of an episode's columns: `force_read`, and both poses as tracked."""
    found: dict[str, np.ndarray] = {}
    if "force" in columns:
        force = np.asarray(columns["force"])
        random = random_of(seed, number, "noise.force")
        found["force_read"] = force + noise["force_n"] * random.standard_normal(force.shape)
    for name, whose in (("T_world_tool", "tool"), ("T_camera_world", "camera")):
        if name in columns:
            random = random_of(seed, number, f"noise.{whose}")
            shift, turn = 1e-3 * noise[f"{whose}_mm"], float(np.radians(noise[f"{whose}_deg"]))
            found[f"{name}_tracked"] = jittered(np.asarray(columns[name]), shift, turn, random)
    return found
