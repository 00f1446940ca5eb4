"""Cost and influence of each effect of a scene, from FEM solutions of the frames with and without the effect."""

import gc
import time as clock
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np
import warp as wp

from sim.anatomy import Anatomy
from sim.deformation import Deformer, Outcome
from sim.effects import Bonded, Effect, Elasticity, Held, Slide
from sim.errors import InputError

from ..script.craniotomy_frame import CraniotomyFrame
from ..script.scene import Scene
from .deformers import PatientSetup
from .effect_record import EffectRecord
from .stage import Stage

WARM_UP = 2  # Number of frames that are not timed: kernels are loaded.
UNPHYSICAL = Outcome.INVERTED, Outcome.OVERSTRAINED  # Equilibria that are measured and counted.
ALL = "all"  # Name of the run with all effects.


@dataclass(frozen=True, eq=False)
class AblationRun:
    """FEM solutions of a scene's frames: displacements (F, V, 3) [m], NaN for resected vertices, and their cost.

    `milliseconds`: median time per frame. `memory_bytes`: total size of the Warp arrays that the run keeps.
    `unphysical`: number of frames with inverted or overstrained tetrahedra.
    """

    displacement: np.ndarray
    milliseconds: float
    memory_bytes: int
    unphysical: int


@dataclass(frozen=True)
class AblationRow:
    """Differences between the full scene and the scene without one effect; for `ALL`, values of the full scene.

    Values are time per frame [ms], kept device memory [MB], and the maximum over frames of the mean displacement of
    the vertices of tumour and open cortex [mm]; None if the effect cannot be removed for the reason `refused`.
    `unphysical`: number of frames with inverted or overstrained tetrahedra in the run without the effect.
    """

    effect: str
    milliseconds: float | None = None
    held_mb: float | None = None
    tumour_mm: float | None = None
    cortex_mm: float | None = None
    refused: str = ""
    unphysical: int = 0


def list_switchable_effects(scene: Scene, anatomy: Anatomy) -> list[str]:
    """List the class names of effects that can be disabled: all effects except tissue and constraints."""
    kinds = (type(effect) for effect in scene.get_effects_on(anatomy))
    return [kind.__name__ for kind in kinds if kind not in (Elasticity, Held, Bonded, Slide)]


def remove_effect(scene: Scene, effect: Effect) -> Scene:
    """Return the scene without one of its effects."""
    if effect not in scene.effects:  # it depends on the body
        return replace(scene, surgery=None)
    return replace(scene, effects=tuple(other for other in scene.effects if other != effect))


def measure_effects(
    patient: PatientSetup, scene: Scene, frame_step: int, effect_names: Collection[str] | None = None
) -> Iterator[AblationRow]:
    """Yield the row of the full scene, then the row of each effect; every `frame_step`-th frame is solved.

    `effect_names`: class names of the effects to measure; None: all effects.

    Raises
    ------
    InputError
        A frame of the full scene is not solved.
    """
    whole = solve_frames(patient, scene, frame_step)
    nowhere = replace(whole, displacement=np.zeros_like(whole.displacement), milliseconds=0.0, memory_bytes=0)
    yield _build_row(patient, ALL, whole, nowhere)
    for effect in scene.get_effects_on(patient.anatomy):
        name = type(effect).__name__
        if effect_names is not None and name not in effect_names:
            continue
        if isinstance(effect, Elasticity):
            yield AblationRow(name, refused="nothing else resists deformation")
            continue
        try:
            less = solve_frames(patient, remove_effect(scene, effect), frame_step)
        except InputError as error:
            yield AblationRow(name, refused=str(error))
            continue
        if less.unphysical > whole.unphysical:
            yield AblationRow(name, refused=f"{less.unphysical} frames have inverted or overstrained tetrahedra")
            continue
        yield _build_row(patient, name, whole, less)


def build_record(
    patient: PatientSetup, scene: Scene, rows: Sequence[AblationRow], frame_step: int, machine: str
) -> EffectRecord:
    """Build the record of measured effects from `rows`; every `frame_step`-th frame was solved on `machine`."""
    figures = {row.effect: (row.milliseconds, row.tumour_mm) for row in rows}
    frames = len(scene.times[::frame_step])
    return EffectRecord(
        scene.name, patient.compute_mark(scene), str(date.today()), machine, frames, figures,
        sum(row.unphysical for row in rows), {row.effect: row.refused for row in rows if row.refused},
    )  # fmt: skip


def solve_frames(patient: PatientSetup, scene: Scene, frame_step: int) -> AblationRun:
    """Solve every `frame_step`-th frame of a scene in order; each solve starts from the previous solution.

    Raises
    ------
    InputError
        The mesh has no fixed nodes, or a frame no equilibrium. An unphysical equilibrium is counted, not rejected.
    """
    before = list_arrays()  # arrays that existed before do not belong to the scene
    fem = patient.build_fem(scene, scene.accuracy, live=True)
    times = scene.times[::frame_step].tolist()
    found, seconds, unphysical = _solve_frames(fem, scene, patient.site, times)
    wp.synchronize()
    earlier = {id(array) for array in before}
    held = sum(array.capacity for array in list_arrays() if id(array) not in earlier)
    milliseconds = 1e3 * float(np.median(seconds[min(WARM_UP, len(times) - 1) :]))
    return AblationRun(np.stack(found), milliseconds, held, unphysical)


def _solve_frames(
    fem: Deformer, scene: Scene, site: CraniotomyFrame, times: list[float]
) -> tuple[list[np.ndarray], list[float], int]:
    """Solve the frames; return displacements (V, 3) [m] (NaN where resected) and seconds by frame, unphysical count."""
    last, found, seconds, unphysical, stage = None, [], [], 0, Stage(scene, site)
    for time in times:
        loads = scene.build_loads(site, scene.path(time), time)
        wp.synchronize()
        begun = clock.perf_counter()
        last = fem.deform(loads, start=last)
        seconds.append(clock.perf_counter() - begun)
        found.append(np.where(stage.select_stage(loads).anatomy.orphaned[:, None], np.nan, last.displacement[0]))
        unphysical += last.outcome[0] in UNPHYSICAL
        if not last.outcome[0].good and last.outcome[0] not in UNPHYSICAL:
            raise InputError(f"the frame at {time:.2f} s is not solved: {last.outcome[0].value}")
    return found, seconds, unphysical


def list_arrays() -> list[wp.array]:
    """List all live Warp arrays that own their memory."""
    gc.collect()
    return [thing for thing in gc.get_objects() if type(thing) is wp.array and thing.deleter is not None]


def _build_row(patient: PatientSetup, name: str, full_run: AblationRun, reduced_run: AblationRun) -> AblationRow:
    anatomy = patient.anatomy

    def compute_change(nodes: np.ndarray) -> float:
        difference = (full_run.displacement - reduced_run.displacement)[:, nodes]
        return 1e3 * float(np.nanmean(np.linalg.norm(difference, axis=2), axis=1).max())

    return AblationRow(
        name,
        full_run.milliseconds - reduced_run.milliseconds,
        1e-6 * (full_run.memory_bytes - reduced_run.memory_bytes),
        compute_change(anatomy.tumour_nodes),
        compute_change(np.unique(anatomy.open_surface)),
        unphysical=reduced_run.unphysical,
    )
