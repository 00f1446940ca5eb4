"""Shared data of all environments of one task on one body: anatomy, tissue model and possible goals."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from operator import attrgetter
from pathlib import Path

import numpy as np

from sim.accuracy import LIVE
from sim.anatomy import TUMOUR_LABEL
from sim.effects import Held, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Resected
from sim.material import Tissue
from sim.runtime.device import find_device
from sim.skulls import Bonded
from surrogate.model.guarded import has_tool_pressure

from ..play.deformers import PatientSetup, open_theatre
from ..play.learned_regions import find_trained_regions
from ..play.stage import Stage
from ..script.craniotomy_frame import CraniotomyFrame
from ..script.scene import Scene
from ..script.shipped_files import get_gym_model_path
from ..script.tool import Blade, Probe
from .fem_responses import ContactFem, ResectionFem
from .model_responses import Hertz, PoseSurrogate, PushSurrogate
from .tasks import Goal, GymTask
from .tissue_requests import TissueModel

PHYSICS = ("auto", "model", "fem")  # Kinds of deformation models.
TEMPLATE = "template"  # Name of the shipped anatomy.
ARGUMENTS = ("anatomy", "physics", "device", "size", "model")  # Arguments that determine a setting.
BOUND_KEY = attrgetter("bound")  # Key for selecting the model with the smallest error bound.
MAX_GOAL_DISTANCE = 6e-3  # Largest distance of a goal from the point above the tumour's centre [m].
MIN_FLUID_LEVEL = 0.6  # Lowest final fluid level, as a share of the height.
MAX_FLUID_LEVEL = 0.9  # Highest final fluid level, as a share of the height.
PATCH_RADIUS = 8e-3  # Radius of the patch of cortex whose shift is rewarded [m].


@dataclass(frozen=True, eq=False)
class TaskSetting:
    """Setting of environments: a task on a body, with the model of its tissue.

    Parameters
    ----------
    task, scene, patient
        Task, scene and body. Regions have the tissue with which the body's models were trained.
    tissue_model
        Model of the tissue's response to the tool.
    """

    task: GymTask
    scene: Scene
    patient: PatientSetup
    tissue_model: TissueModel

    @property
    def site(self) -> CraniotomyFrame:
        """Coordinate system of the craniotomy of the body."""
        return self.patient.site

    @cached_property
    def stage(self) -> Stage:
        """Rendered parts of the body."""
        return self.patient.build_stage(self.scene)

    def get_stage(self, step: int) -> Stage:
        """Return the rendered parts of the anatomy after `step` resection steps."""
        cut = Loads((Resected(np.array([float(step)])),))
        return self.stage.select_stage(cut) if self.task.resects else self.stage

    @cached_property
    def cortex(self) -> np.ndarray:
        """Mesh vertices (n,) of the open cortex."""
        return np.unique(self.site.anatomy.open_surface)

    @cached_property
    def tumour_centre(self) -> np.ndarray:
        """Mean position (3,) [m] of the tumour's vertices in the scan."""
        return self.site.anatomy.mesh.nodes[self.site.anatomy.tumour_nodes].mean(axis=0)

    @cached_property
    def resection_shares(self) -> tuple[np.ndarray, ...]:
        """Mesh vertices of the tetrahedra of each part of the tumour to resect, in order."""
        surgery = self.task.surgery
        if surgery is None:
            return ()
        mesh = self.site.anatomy.mesh
        return tuple(mesh.tets[list(step)].ravel() for step in surgery.build_resection(self.site.anatomy).steps[1:])

    def find_vertices_near(self, position: np.ndarray) -> np.ndarray:
        """Find the open cortex's vertices (n,) within `PATCH_RADIUS` of a position (3,) [m], or the nearest vertex."""
        away = np.linalg.norm(self.site.anatomy.mesh.nodes[self.cortex] - position, axis=1)
        return self.cortex[away <= max(PATCH_RADIUS, away.min())]

    def sample_goal(self, random: np.random.Generator) -> Goal:
        """Sample a goal; all tasks use the same number of random values."""
        far, angle, turn, amount, more = random.random(5)
        task, site = self.task, self.site
        arm = self.tumour_centre - site.origin
        offset = MAX_GOAL_DISTANCE * np.sqrt(far) * np.array([np.cos(2.0 * np.pi * angle), np.sin(2.0 * np.pi * angle)])
        at = site.find_contact(float(arm @ site.right + offset[0]), float(arm @ site.up + offset[1]), task.tool.radius)
        size = task.amount[0] + amount * (task.amount[1] - task.amount[0])
        if task.resects:
            level = MIN_FLUID_LEVEL + more * (MAX_FLUID_LEVEL - MIN_FLUID_LEVEL)
            return Goal(self.tumour_centre, site.axis, size, level)
        lean, turn = task.max_push_angle * more, 2.0 * np.pi * turn
        sideways = np.cos(turn) * site.right + np.sin(turn) * site.up
        return Goal(at.point, np.cos(lean) * site.axis + np.sin(lean) * sideways, size)


@lru_cache(maxsize=8)
def open_setting(
    task: GymTask,
    anatomy: str,
    physics: str,
    device: str,
    size: tuple[int, int],
    model: str | None = None,
    is_batched: bool | None = None,
) -> TaskSetting:
    """Open a task on an anatomy; the result is cached for all environments of a process.

    Parameters
    ----------
    anatomy
        "template", or the path of a .vtu file.
    physics
        "model": the best trained model of tool poses, or of pushes if the tool is a ball. "fem": FEM. "auto": an
        applicable model, or else FEM; if there are only models that are not applicable, a warning gives the
        reason.
    device
        See `Fem`.
    size
        Width and height of images [pixel].
    model
        File of trained models. None: the file next to the anatomy, or the shipped file for template and spatula.
        Regions have the tissue with which the models were trained.
    is_batched
        True to solve all environments in one batch; None: only on a GPU. On the CPU a batch is several times as fast,
        but the last digits of results depend on the other environments.

    Raises
    ------
    InputError
        A file is unreadable, the anatomy has no tumour or open cortex, the device is unavailable, or a required model
        is missing or not applicable.
    """
    patient = _open_setup(anatomy, _get_shipped_model(task) if model is None and anatomy == TEMPLATE else model, device)
    if not patient.anatomy.in_tumour.any():
        raise InputError(f"{anatomy}: has no tumour, which these tasks aim at: mesh one with region {TUMOUR_LABEL}.")
    scene, tool = task.build_scene(size), task.tool
    scene = scene.replace_regions(find_trained_regions(scene.elasticity, patient.learned_tissue))
    card = find_device(device, LIVE.precision).name != "cpu"
    at_once = card if is_batched is None else is_batched
    ball = Hertz(tool.radius, _find_touched_tissue(task, scene, patient.site)) if isinstance(tool, Probe) else None
    if physics != "fem":
        refused = _list_rejections(task, scene, patient)
        known = [each for name, each in patient.models.items() if refused[name] is None]
        if posed := [each for each in known if each.tool is not None]:
            return TaskSetting(task, scene, patient, PoseSurrogate(min(posed, key=BOUND_KEY), ball))
        if ball is not None and known:
            return TaskSetting(
                task, scene, patient, PushSurrogate(patient.site, min(known, key=BOUND_KEY), ball, at_once)
            )
        _report_no_model(task, anatomy, physics, model, next(iter(refused.values()), None))
    fem = patient.build_fem(scene, LIVE, batch=64 if at_once else 1, live=not at_once)
    if isinstance(fem, Fem):
        return TaskSetting(task, scene, patient, ContactFem(fem, ball, at_once))
    assert ball is not None
    return TaskSetting(task, scene, patient, ResectionFem(patient.site, fem, ball))


def _find_touched_tissue(task: GymTask, scene: Scene, site: CraniotomyFrame) -> Tissue:
    """Return the tissue under a ball, which has the largest volume within the ball's radius around the goals' centre.

    For a task with resection, this is the tissue of the brain.
    """
    mesh, elasticity = site.anatomy.mesh, scene.elasticity
    arm = mesh.nodes[site.anatomy.tumour_nodes].mean(axis=0) - site.origin
    place = site.find_contact(float(arm @ site.right), float(arm @ site.up), task.tool.radius).point
    near = np.linalg.norm(mesh.nodes[mesh.tets].mean(axis=1) - place, axis=1) < task.tool.radius
    labels = [] if task.resects else np.unique(mesh.region[near]).tolist()
    most = max(labels, key=lambda label: mesh.volumes[near & (mesh.region == label)].sum(), default=None)
    tissue = elasticity.default if most is None else elasticity.get_law(most)
    assert tissue is not None
    return tissue


def _list_rejections(task: GymTask, scene: Scene, patient: PatientSetup) -> dict[str, str | None]:
    """Return by name why a trained model is not applicable (None: it is); for a ball, models of pushes apply too."""
    if task.resects:
        return dict.fromkeys(patient.models, "tissue is resected, which no model supports")
    ball = isinstance(task.tool, Probe)
    pushes = replace(scene, effects=(scene.elasticity, Held(), Bonded(), ToolForce()))
    moved, pushed = patient.list_rejections(scene), patient.list_rejections(pushes) if ball else {}
    found = {}
    for name, each in patient.models.items():
        found[name] = pushed.get(name, moved[name]) if each.tool is None else moved[name]
        if (
            found[name] is None
            and each.tool is not None
            and (each.force is None or not (ball or has_tool_pressure(each)))
        ):
            found[name] = f"it does not predict its tool's {'force' if each.force is None else 'pressure'}"
    return found


def _report_no_model(task: GymTask, anatomy: str, physics: str, model: str | None, reason: str | None) -> None:
    """Warn that FEM is used, because no trained model is applicable, unless the task resects tissue.

    Raises
    ------
    InputError
        `physics` or `model` requires a trained model.
    """
    remedy = "Give physics='fem', or train one: docs/gym.md has the commands."
    if model is not None:
        raise InputError(f"{model}: is not applicable to the task {task.name}: {reason}. {remedy}")
    because = f": {reason or 'there is none'}"
    if physics == "model":
        raise InputError(
            f"physics='model': no trained model of {anatomy} is applicable to the task {task.name}{because}. {remedy}"
        )
    if reason is not None and not task.resects:
        said = f"FEM is used for the task {task.name} on {anatomy}: no trained model is applicable{because}. {remedy}"
        warnings.warn(said, stacklevel=2)


@lru_cache(maxsize=4)
def _open_setup(anatomy: str, model: str | None, device: str) -> PatientSetup:
    body = None if anatomy == TEMPLATE else Path(anatomy)
    return open_theatre(body, None if model is None else Path(model), device)


def _get_shipped_model(task: GymTask) -> str | None:
    return str(get_gym_model_path()) if isinstance(task.tool, Blade) else None


def check_arguments(arguments: Mapping[str, object]) -> tuple[str, str, str, tuple[int, int], str | None]:
    """Check and return the values of `ARGUMENTS`, as arguments of `open_setting`.

    Raises
    ------
    InputError
        A value is invalid.
    """
    anatomy, physics, device, size, model = (arguments[name] for name in ARGUMENTS)
    if not isinstance(anatomy, str | Path):
        raise InputError(f"anatomy is {anatomy!r:.80}: give 'template', or the path of a .vtu file.")
    if not isinstance(model, str | Path | None):
        raise InputError(f"model is {model!r:.80}: give the path of a .model.npz file, or None.")
    if physics not in PHYSICS:
        raise InputError(f"physics is {physics!r:.80}: choose one of {', '.join(PHYSICS)}.")
    if not isinstance(device, str):
        raise InputError(f"device is {device!r:.80}: give auto, cpu, cuda or cuda:1.")
    sides = tuple(size) if isinstance(size, tuple | list) else ()
    if len(sides) != 2 or not all(type(side) is int and 16 <= side <= 4096 for side in sides):
        raise InputError(f"size is {size!r:.80}: give width and height in pixels, each from 16 to 4096.")
    return str(anatomy), str(physics), device, (sides[0], sides[1]), None if model is None else str(model)
