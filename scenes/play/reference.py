"""FEM solutions of the frames of a scene, used as the reference for drawn frames."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from sim.accuracy import TRAIN
from sim.deformation import Deformation, Deformer, join_deformations
from sim.fem import Fem
from sim.loads import Loads, stack
from sim.resected_fem import ResectedFem
from sim.runtime.device import find_device

from ..script.scene import Scene
from .deformers import PatientSetup

BATCH_FRAMES = 16  # Number of frames that are solved together: small enough for regular progress reports.


def build_reference_fem(patient: PatientSetup, scene: Scene) -> Fem | ResectedFem:
    """Build FEM for reference solutions of a scene: batches of frames on a GPU, single frames in order on the CPU.

    On the CPU, a frame that starts from the previous solution takes a quarter of the time of an independent solve.
    """
    if find_device(patient.device, TRAIN.precision).name != "cpu":
        return patient.build_fem(scene, TRAIN, BATCH_FRAMES)
    return patient.build_fem(scene, TRAIN, 1, live=True)


def is_history_dependent(deformer: Deformer) -> bool:
    """Return True if FEM must solve a frame after the previous ones.

    FEM needs no history if only forces act on an intact elastic brain. Other deformers need no history.
    """
    return isinstance(deformer, ResectedFem) or (isinstance(deformer, Fem) and not deformer.problem.can_accelerate)


def solve_reference_frames(
    patient: PatientSetup,
    scene: Scene,
    loads: Sequence[Loads],
    progress: Callable[[int], object] = lambda more: None,
    fem: Fem | ResectedFem | None = None,
) -> Deformation:
    """Solve the loads of each frame for all mesh vertices at training accuracy, in order if solutions need a history.

    `progress` receives the number of newly solved frames. `fem` is an existing solver, for example from
    `build_reference_fem`; None: a new solver for batches. Returns one load case per frame.
    """
    fem = fem or patient.build_fem(scene, TRAIN, BATCH_FRAMES)
    apart = not is_history_dependent(fem) and not (isinstance(fem, Fem) and fem.batch == 1)
    size = BATCH_FRAMES if apart else 1
    answers: list[Deformation] = []
    for first in range(0, len(loads), size):
        some = stack(loads[first : first + size])
        answers.append(fem.deform(some, start=None if apart or not answers else answers[-1]))
        progress(len(some))
    return join_deformations([replace(answer, memory={}, warm={}) for answer in answers])
