"""Deformed anatomy for export: displacement, cause of the displacement, and error bound."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim.accuracy import TRAIN
from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_mesh
from sim.deformation import Deformation
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.closest_point import find_closest_points
from sim.geometry.surface import is_enclosing
from sim.loads import Loads, Pushed
from sim.resected_fem import ResectedFem
from surrogate.locating.calibration import RADIUS_SQUARED

from ..play.deformers import PatientSetup, RestDeformer
from ..play.player import Player
from ..play.reference import is_history_dependent, solve_reference_frames
from ..play.stage import Stage
from ..script.scene import Scene

ENSEMBLE = "registration, segmentation, tissue and skull, as `sulcus uncertainty` has it"
"""Description of the sources of error that the error bound of a scene includes."""
NODE_TOLERANCE = 1e-6  # Largest distance of corresponding nodes in two meshes of one body [m].


@dataclass(frozen=True, eq=False)
class DeformationCause:
    """Cause of a displacement: a description, and a record for JSON with its `kind` and properties."""

    description: str
    record: Mapping[str, Any]


def describe_scene_cause(scene: Scene, number: int) -> DeformationCause:
    """Return frame `number` of a scene as cause of a displacement."""
    time = float(scene.times[number])
    record = {"kind": "scene", "scene": scene.name, "frame": number, "time_s": time}
    return DeformationCause(f"scene {scene.name}, frame {number}, {time:.2f} s", record)


def describe_load_cause(loads: Loads) -> DeformationCause:
    """Return the push in a load case as cause of a displacement; `loads` contain exactly one push."""
    (pushed,) = loads.get_all(Pushed)
    place, force = 1e3 * pushed.point[0], pushed.force[0]
    newton = float(np.linalg.norm(force))
    direction, radius = force / newton, 1e3 * float(pushed.footprint[0])
    record = {
        "kind": "load",
        "place_mm": _round_values(place),
        "direction": _round_values(direction),
        "force_n": round(newton, 6),
        "radius_mm": round(radius, 6),
    }
    x, y, z = (f"{value + 0.0:.1f}" for value in np.round(place, 1))
    right, anterior, superior = (f"{value + 0.0:.2f}" for value in np.round(direction, 2))
    words = f"a load of {newton:g} N at {x}, {y}, {z} mm towards {right}, {anterior}, {superior} (RAS)"
    return DeformationCause(words, record)


def _round_values(values: np.ndarray) -> list[float]:
    return [round(float(value), 6) + 0.0 for value in values]


@dataclass(frozen=True, eq=False)
class DeformedAnatomy:
    """Anatomy with a displacement.

    Parameters
    ----------
    cause
        Cause of the displacement.
    anatomy, remaining
        Complete anatomy, and its remaining part after a resection.
    displacement
        Displacements (V, 3) [m] of the vertices.
    converged
        True if the solution is reliable.
    bound, bound_text
        95 % bound [m] on the error of the tumour's surface (None if not available), and description of this bound.
    tip
        Position (3,) [m] of the tool's tip; None without a tool.
    """

    cause: DeformationCause
    anatomy: Anatomy
    remaining: Anatomy
    displacement: np.ndarray
    converged: bool = True
    bound: float | None = None
    bound_text: str = "no uncertainty was solved for this"
    tip: np.ndarray | None = None

    @property
    def positions(self) -> np.ndarray:
        """Deformed positions (V, 3) [m] of the vertices."""
        return self.anatomy.mesh.nodes + self.displacement

    def find_gap(self) -> tuple[np.ndarray, float] | None:
        """Return the tumour's point (3,) [m] nearest to the tip, and the distance [m] of the tip, which is 0 inside.

        The result is None without a tip or a tumour.
        """
        triangles = self.remaining.tumour_surface
        if self.tip is None or not len(triangles):
            return None
        corners = self.positions[triangles]
        point = find_closest_points(self.tip[None], corners).point[0]
        return point, 0.0 if is_enclosing(corners, self.tip) else float(np.linalg.norm(point - self.tip))


@dataclass(frozen=True, eq=False)
class PlayedScene:
    """Scene of a patient, which is solved by FEM; `is_load` is True if the scene consists of a single load."""

    patient: PatientSetup
    scene: Scene
    is_load: bool = False

    def solve_frames(
        self, frames: Sequence[int], progress: Callable[[int], object] = lambda more: None
    ) -> list[DeformedAnatomy]:
        """Solve some frames, given in ascending order; return the deformed anatomy of each frame."""
        fem = self.patient.build_fem(self.scene, TRAIN, 1, live=True)
        needed = range(frames[-1] + 1) if is_history_dependent(fem) else frames
        answers = solve_reference_frames(
            self.patient, self.scene, [self._build_loads(number) for number in needed], progress, fem
        )
        rows = {number: row for row, number in enumerate(needed)}
        return [self._build_deformed(number, answers.select(np.array([rows[number]])), fem) for number in frames]

    def _build_loads(self, number: int):
        scene, time = self.scene, float(self.scene.times[number])
        return scene.build_loads(self.patient.site, scene.path(time), time)

    def _build_deformed(self, number: int, result: Deformation, fem: Fem | ResectedFem) -> DeformedAnatomy:
        scene, site, time = self.scene, self.patient.site, float(self.scene.times[number])
        moved = result.displacement[0]
        # Nothing is located here, so that no locator is needed.
        stage = Stage(replace(scene, observation_model=None), site)
        player = Player(stage, RestDeformer(site.anatomy))
        now = site.anatomy.mesh.nodes + moved
        tip = None if scene.tool is None else player.place_tool(scene.tool, scene.path(time), now).tip
        known = self.patient.estimate_uncertainty(scene)
        bound = None if known is None else known.evaluate(time).prior
        loads = self._build_loads(number)
        cause = describe_load_cause(loads) if self.is_load else describe_scene_cause(scene, number)
        cause = replace(cause, description=f"{cause.description}, by {result.source}")
        said = {} if bound is None else {"bound_text": ENSEMBLE}
        left = stage.select_stage(loads).anatomy
        return DeformedAnatomy(cause, site.anatomy, left, moved, result.outcome[0].good, bound, tip=tip, **said)


def read_deformed_anatomy(path: Path, anatomy: Anatomy) -> DeformedAnatomy:
    """Read the deformed anatomy from a result of `sulcus locate` or `sulcus solve`.

    Raises
    ------
    InputError
        See `read_mesh`; also if the mesh has no `displacement` (V, 3) or is not that of the anatomy.
    """
    file = read_mesh(path)
    moved = file.point_data.get("displacement")
    if moved is None or moved.shape != file.mesh.nodes.shape or not np.isfinite(moved).all():
        raise InputError(
            f"{path}: has no point data `displacement` (V, 3) of finite numbers. Give a result of `sulcus locate` or "
            "`sulcus solve`."
        )
    mesh = anatomy.mesh
    same = file.mesh.nodes.shape == mesh.nodes.shape and np.array_equal(file.mesh.tets, mesh.tets)
    if not same or np.abs(file.mesh.nodes - mesh.nodes).max() > NODE_TOLERANCE:
        raise InputError(f"{path}: is of another mesh than the anatomy. Give the anatomy that it was made with.")
    cause = DeformationCause(f"displacement of {path.name}", {"kind": "file", "file": path.name})
    if "covariance" not in file.point_data:
        return DeformedAnatomy(cause, anatomy, anatomy, np.asarray(moved, np.float64))
    xx, yy, zz, xy, yz, xz = np.asarray(file.point_data["covariance"])[np.unique(anatomy.tumour_surface)].T
    matrices = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)
    bound = float(np.sqrt(RADIUS_SQUARED * np.linalg.eigvalsh(matrices)[:, -1].max()))
    said = "what was seen of the cortex, as the covariance in the file says, at the tumour's worst vertex"
    return DeformedAnatomy(cause, anatomy, anatomy, np.asarray(moved, np.float64), True, bound, said)
