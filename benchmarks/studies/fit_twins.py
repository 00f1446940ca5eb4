"""Synthetic patients of known tissue: frames in which a tool presses the cortex, and in which fluid drains."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.accuracy import Accuracy
from sim.anatomy import TUMOUR_LABEL, Anatomy
from sim.bodies.fluid_level import compute_fluid_level
from sim.bodies.open_cortex import open_cortex
from sim.discretisation.space import recommend_element
from sim.effects import Effect, Elasticity, Gravity, Held, ToolForce
from sim.fem import Fem
from sim.geometry.locate import locate
from sim.loads import Loads, Posture, Pushed
from surrogate.data.tool_loads import draw as drawn_loads
from surrogate.model.kept_arrays import get_cache_path, load_cached_arrays

from .locate_twins import LEFT, PROBABLE, RATIO, SKULLS, STIFFNESS, TILT, build_ogden_tissue, check_same_brain

POISSON = (0.45, 0.4945)
"""Range of Poisson's ratio of a patient's brain and tumour; uniform."""
# Number of tool positions in all patients together; range of the mean pressure of a press [Pa], below harm.
PLACES, PRESSURE = 14, (1000.0, 2700.0)
ACCURACY = Accuracy(tolerance=1e-3)


@dataclass(frozen=True)
class Patient:
    """Synthetic patient.

    Parameters
    ----------
    number
        Number of the patient, from 0.
    skull
        Name in `locate_twins.SKULLS`.
    stiffness, ratio, poisson
        Stiffness of the brain over `MATERIALS["minutes"]`, of the tumour over the brain; Poisson's ratio.
    places
        Numbers of the pressed positions, one a frame.
    force
        Force (3,) [N] of each press.
    left
        Remaining share of the fluid in each of the following frames.
    tilt
        Vector (3,) of each such frame, which is added to the opening's axis for the direction of gravity.
    """

    number: int
    skull: str
    stiffness: float
    ratio: float
    poisson: float
    places: tuple[int, ...]
    force: tuple[tuple[float, ...], ...]
    left: tuple[float, ...]
    tilt: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, eq=False)
class PatientMotions:
    """Patient, and motions (frames, V, 3) [m] of the vertices of the mesh for which tissue is estimated."""

    patient: Patient
    motion: np.ndarray


def sample_positions(anatomy: Anatomy, seed: int = 0) -> Pushed:
    """Sample a push at each tool position: point, radius, and a force that gives the direction."""
    found = drawn_loads("palpation", anatomy, PLACES, 1000 + seed).get(Pushed)
    assert found is not None
    return found


def sample_patient(tools: Pushed, seed: int, number: int, press_count: int, drainage_count: int) -> Patient:
    """Sample patient `number`, for some presses and postures; the result depends on their numbers and the seed."""
    random = np.random.default_rng([seed, number, 7])
    stiffness, ratio = (float(np.exp(random.uniform(*np.log(limits)))) for limits in (STIFFNESS, RATIO))
    skull, poisson = str(random.choice(list(SKULLS), p=PROBABLE)), float(random.uniform(*POISSON))
    chosen = random.permutation(PLACES)[:press_count]
    pressure = np.exp(random.uniform(*np.log(PRESSURE), size=press_count))
    # Directions near the sampled force's: within the tool's cone nearly everywhere.
    way = np.stack([_leaning(tools.force[place], random) for place in chosen])
    force = way * (pressure * np.pi * tools.footprint[chosen] ** 2)[:, None]
    left, tilt = random.uniform(LEFT[0], LEFT[1], drainage_count), TILT * random.standard_normal((drainage_count, 3))
    return Patient(
        number=number, skull=skull, stiffness=stiffness, ratio=ratio, poisson=poisson,
        places=tuple(chosen.tolist()), force=tuple(map(tuple, force.tolist())),
        left=tuple(left.tolist()), tilt=tuple(map(tuple, tilt.tolist())),
    )  # fmt: skip


def _leaning(force: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Sample a unit vector (3,) tilted by some degrees from a force (3,)."""
    way = force / np.linalg.norm(force) + 0.25 * random.standard_normal(3)
    return way / np.linalg.norm(way)


def build_effects(patient: Patient) -> tuple[Effect, ...]:
    """Build the effects of a patient's FEM."""
    brain, tumour = (
        build_ogden_tissue(share, patient.poisson) for share in (patient.stiffness, patient.stiffness * patient.ratio)
    )
    return Elasticity(brain, {TUMOUR_LABEL: tumour}), Held(), SKULLS[patient.skull], ToolForce(), Gravity()


def build_loads(anatomy: Anatomy, tools: Pushed, patient: Patient) -> Loads:
    """Build the loads: a press in each of the first frames, at these positions; drained fluid in the others."""
    idle, drained = len(patient.left), np.array(patient.tilt).reshape(-1, 3) + open_cortex(anatomy).axis
    chosen = np.array([*patient.places, *[patient.places[0]] * idle])
    force = np.concatenate([np.array(patient.force), np.zeros((idle, 3))])
    down = np.concatenate([np.tile(Gravity().direction, (len(patient.places), 1)), drained])
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    left = np.append(np.ones(len(patient.places)), patient.left)
    level = np.array([compute_fluid_level(anatomy.mesh.nodes, *each) for each in zip(down, left, strict=True)])
    pushed = Pushed(tools.point[chosen], force, tools.footprint[chosen])
    return Loads((pushed, Posture(down, level, np.ones(len(chosen)))))


def solve_patients(
    anatomy: Anatomy, finer_mesh: Anatomy, count: int, press_count: int, drainage_count: int, seed: int = 0,
    device: str = "auto", folder: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Iterator[PatientMotions | None]:  # fmt: skip
    """Solve patients on `finer_mesh`, interpolated at the vertices of `anatomy`; None for one without equilibrium.

    Patients in `folder`, from an interrupted run, are read. `progress` receives the number done and the total.

    Raises
    ------
    InputError
        Meshes of two brains; meshes without tumour or open cortex.
    """
    check_same_brain(anatomy, finer_mesh)
    place, tools = locate(finer_mesh.mesh, anatomy.mesh.nodes), sample_positions(anatomy)
    for number in range(count):
        one = sample_patient(tools, seed, number, press_count, drainage_count)
        motion = _kept(finer_mesh, build_loads(finer_mesh, tools, one), one, device, folder)
        progress(number + 1, count)
        yield PatientMotions(one, place.interpolate(motion.astype(float))) if len(motion) else None


def _kept(finer: Anatomy, loads: Loads, patient: Patient, device: str, folder: Path | None) -> np.ndarray:
    """Read or solve the motions (frames, V, 3) [m] of a patient's own mesh; (0, V, 3): no equilibrium."""
    stated = finer.digest, recommend_element(finer.mesh), patient, ACCURACY
    path = get_cache_path(folder, f"patient-{patient.number:04d}-", device, *stated)

    def solved() -> dict[str, np.ndarray]:
        answer = Fem(finer, build_effects(patient), ACCURACY, device).deform(loads)
        good = all(outcome.good for outcome in answer.outcome)
        return {"motion": (answer.displacement if good else answer.displacement[:0]).astype(np.float32)}

    return load_cached_arrays(path, "a patient's motions", ["motion"], solved)["motion"]
