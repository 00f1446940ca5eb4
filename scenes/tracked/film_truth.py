"""What is true of a film: where camera, tool and tumour are in each picture, to hold an overlay against."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.runtime.atomic_files import written_whole
from sim.runtime.file_limits import LARGEST_FILM
from sim.runtime.outside_files import path_of, read_as
from surrogate.model.npz_archive import Archive

FORMAT = "sulcus film 1"
WANTED = "Give the truth.npz that `sulcus film` wrote."
COLUMNS = ("T_camera_scan", "T_scan_tool")
SPACES = {"scan": "RAS [m]", "camera": "x right, y down, z forward [m]"}


@dataclass(frozen=True, eq=False)
class Truth:
    """F pictures of a film.

    Parameters
    ----------
    anatomy
        The digest of the body that is filmed.
    times
        (F,) [s].
    T_camera_scan, T_scan_tool
        (F, 4, 4) [m].
    displacement
        (F, n, 3) [m] of the vertices of the tumour's surface, sorted by their numbers in the mesh.
    """

    anatomy: str
    times: np.ndarray
    T_camera_scan: np.ndarray
    T_scan_tool: np.ndarray
    displacement: np.ndarray

    def at(self, time: float) -> int | None:
        """The number of the picture that was taken at a time [s], to a millisecond; None: none was."""
        near = int(np.abs(self.times - time).argmin())
        return near if abs(self.times[near] - time) < 1e-3 else None


def write_truth(path: Path, truth: Truth) -> None:
    """Write a truth as .npz; it appears whole or not at all."""
    with written_whole(path, ".npz") as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            header=np.array(json.dumps({"format": FORMAT, "anatomy": truth.anatomy, "spaces": SPACES})),
            times=truth.times,
            T_camera_scan=truth.T_camera_scan,
            T_scan_tool=truth.T_scan_tool,
            displacement=truth.displacement.astype(np.float32),
        )


def read_truth(path: str | Path, anatomy: str, vertices: int, largest: int = LARGEST_FILM) -> Truth:
    """The truth in a file, of a body with this digest and number of `vertices` on its tumour's surface.

    Its arrays inflate to at most `largest` bytes.

    Raises
    ------
    InputError
        A file that is missing or no such truth, or of another body.
    """
    path = path_of(path)
    with read_as(path, "what is true of a film", WANTED), path.open("rb") as raw:
        archive = Archive(raw, WANTED, largest)
        header = json.loads(archive.text("header"))
        if header["format"] != FORMAT:
            raise InputError(f"its format is not {FORMAT!r}. {WANTED}")
        if header["anatomy"] != anatomy:
            raise InputError("is of another anatomy: give the one that was filmed, by --anatomy.")
        arrays = archive.arrays(("times", "displacement", *COLUMNS))
        times, moved, cameras, tools = (arrays[name].astype(float) for name in ("times", "displacement", *COLUMNS))
    count = len(times)
    shapes = (times.shape, cameras.shape, tools.shape, moved.shape)
    if not count or shapes != ((count,), (count, 4, 4), (count, 4, 4), (count, vertices, 3)):
        raise InputError(f"{path}: has arrays of other shapes. {WANTED}")
    if not all(np.isfinite(each).all() for each in (times, cameras, tools, moved)):
        raise InputError(f"{path}: has numbers that are not finite. {WANTED}")
    return Truth(str(header["anatomy"]), times, cameras, tools, moved)


def write_table(path: Path, truth: Truth, rest: np.ndarray) -> None:
    """Write a truth as a table for people, a row for each picture; rest (n, 3) [m]: the tumour's surface in the scan.

    Poses are rows of 12 numbers, of the matrix from the scan to the camera, and from the tool to the scan [mm].
    """
    names = [f"{what}_{row}{column}" for what in COLUMNS for row in range(3) for column in range(4)]
    with written_whole(path, ".csv") as partial, partial.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("time_s", "tumour_x_mm", "tumour_y_mm", "tumour_z_mm", "moved_mm", *names, "space"))
        for number, time in enumerate(truth.times):
            moved = truth.displacement[number]
            middle = 1e3 * (rest + moved).mean(axis=0)
            poses = np.stack([truth.T_camera_scan[number], truth.T_scan_tool[number]])[:, :3] * [1.0, 1.0, 1.0, 1e3]
            mean = 1e3 * float(np.linalg.norm(moved, axis=1).mean())
            table.writerow((f"{time:.6f}", *(f"{each:.5f}" for each in (*middle, mean, *poses.ravel())), "RAS"))
