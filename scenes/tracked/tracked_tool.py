"""Tool that carries the printed cube: contact shape, transform to the cube, and JSON file."""

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ar.tracking.rigid import is_rigid
from ar.tracking.targets import TIP_DISTANCE, build_tool_cube
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import to_path, wrap_errors
from sim.tools import BuiltIn, parse_tool

from ..script.tool import add_shaft

FORMAT = "sulcus tool 1"  # Name and version of the file format.
# Remedy in error messages.
REMEDY = "Give a tool of `sulcus film`, or one with format, shape, T_cube_tool and tip_covariance_mm2."
MAX_FILE_BYTES = 100_000  # Maximum size of a tool's file [bytes].
ROTATION_TOLERANCE = 1e-3  # Tolerance of a rotation's rows from orthonormality.
MAX_TIP_DISTANCE = 1.0  # Largest distance of a tool's tip from its cube [m].


def build_nominal_cube() -> np.ndarray:
    """Build T_cube_tool (4, 4) [m] for a cube that is aligned with the tool, with its centre above the tip."""
    T = np.eye(4)
    T[2, 3] = -TIP_DISTANCE
    return T


@dataclass(frozen=True, eq=False)
class TrackedTool:
    """Tool with the printed cube on its shaft.

    Parameters
    ----------
    shape
        Contact shape of the tool.
    T_cube_tool
        Transform (4, 4) [m] from tool coordinates, whose origin is the tool's lowest point, to cube coordinates.
    tip_covariance
        Calibration covariance (3, 3) [m^2] of this lowest point in cube coordinates.
    """

    shape: BuiltIn
    T_cube_tool: np.ndarray = field(default_factory=build_nominal_cube)
    tip_covariance: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))

    @cached_property
    def bare_mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Surface of the tool without the cube: vertices (n, 3) [m] in tool coordinates, and triangles (m, 3)."""
        return add_shaft(self.shape, np.linalg.inv(self.T_cube_tool)[:3, 3])

    @cached_property
    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Surface of the tool with the cube: vertices (n, 3) [m] in tool coordinates, and triangles (m, 3).

        The cube is a box around its printed faces.
        """
        T_tool_cube, (vertices, triangles) = np.linalg.inv(self.T_cube_tool), self.bare_mesh
        box, sides = _build_cube()
        at = box @ T_tool_cube[:3, :3].T + T_tool_cube[:3, 3]
        return np.concatenate([vertices, at]), np.concatenate([triangles, sides + len(vertices)])

    def build_surface(self, T_scan_tool: np.ndarray, with_cube: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (n, 3) [m] and triangles (m, 3) of the tool at a pose (4, 4), with or without the cube."""
        vertices, triangles = self.mesh if with_cube else self.bare_mesh
        return vertices @ T_scan_tool[:3, :3].T + T_scan_tool[:3, 3], triangles


def _build_cube() -> tuple[np.ndarray, np.ndarray]:
    """Return the printed cube as a box in cube coordinates: corners (8, 3) [m], and triangles (12, 3)."""
    half = float(max(abs(face.T_target_face[:3, 3]).max() for face in build_tool_cube().faces))
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))]
    return half * signs, np.array(triangles)


def read_tool(path: str | Path) -> TrackedTool:
    """Read a tracked tool from a JSON file with lengths in millimetres.

    Raises
    ------
    InputError
        The file is missing or invalid, the shape is invalid, or the transform is not rigid.
    """
    path = to_path(path)
    with wrap_errors(path, "a tracked tool", REMEDY):
        with path.open("rb") as file:
            stored = json.loads(file.read(MAX_FILE_BYTES))
        if stored["format"] != FORMAT:
            raise InputError(f"its format is not {FORMAT!r}. {REMEDY}")
        T, covariance = np.array(stored["T_cube_tool"], float), np.array(stored["tip_covariance_mm2"], float)
        T[:3, 3] *= 1e-3
        _check_rigid(T)
        if (
            covariance.shape != (3, 3)
            or not np.isfinite(covariance).all()
            or np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[0] < -1e-9
        ):
            raise InputError(f"tip_covariance_mm2 is no covariance (3, 3). {REMEDY}")
        return TrackedTool(parse_tool(str(stored["shape"])), T, 1e-6 * covariance)


def _check_rigid(T: np.ndarray) -> None:
    if not is_rigid(T, ROTATION_TOLERANCE):
        raise InputError(f"T_cube_tool is no rigid transform (4, 4). {REMEDY}")
    if np.linalg.norm(T[:3, 3]) > MAX_TIP_DISTANCE:
        raise InputError("T_cube_tool has the tip farther than 1 m from the cube: give millimetres.")


def write_tool(path: Path, tool: TrackedTool) -> None:
    """Write a tracked tool to a JSON file with lengths in millimetres, atomically."""
    T = tool.T_cube_tool.copy()
    T[:3, 3] *= 1e3
    stored = {
        "format": FORMAT,
        "spaces": {"tool": "origin at its lowest point, z up the shaft [mm]", "cube": "the cube's own [mm]"},
        "shape": repr(tool.shape),
        "T_cube_tool": T.tolist(),
        "tip_covariance_mm2": (1e6 * tool.tip_covariance).tolist(),
    }
    with write_atomically(path, ".json") as partial:
        partial.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
