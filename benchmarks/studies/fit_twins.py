"""Patients of known tissue, whose cortex is seen while a tool presses here and there and while fluid drains."""

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
from surrogate.model.kept_arrays import find_kept_path, keep_arrays

from .locate_twins import LEFT, PROBABLE, RATIO, SKULLS, STIFFNESS, TILT, check_same, ogden

POISSON = (0.45, 0.4945)
"""Of a twin's brain and tumour, uniform."""
# Places that tools press on in all twins together, and of these in each; mean pressure of a press [Pa], below harm.
PLACES, PRESSURE = 14, (1000.0, 2700.0)
ACCURACY = Accuracy(tolerance=1e-3)


@dataclass(frozen=True)
class Patient:
    """What a twin is.

    Parameters
    ----------
    number
        From 0.
    skull
        A name of `locate_twins.SKULLS`.
    stiffness, ratio, poisson
        Of the tissue over `MATERIALS["minutes"]`, of the tumour over the brain, and Poisson's ratio.
    places
        Numbers of the places that are pressed, one a frame.
    force
        Of each (3,) [N].
    left
        Share of the fluid that is left, in each of the frames that follow.
    tilt
        Of each (3,): gravity pulls along the opening's axis and this.
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
class Seen:
    """A patient, and the motions (frames, V, 3) [m] of the vertices of the mesh that is asked about."""

    patient: Patient
    motion: np.ndarray


def places(anatomy: Anatomy, seed: int = 0) -> Pushed:
    """Where tools may press, how wide they are, and which way their forces lean: one a place."""
    found = drawn_loads("palpation", anatomy, PLACES, 1000 + seed).get(Pushed)
    assert found is not None
    return found


def patient(tools: Pushed, seed: int, number: int, presses: int, drainages: int) -> Patient:
    """The patient of a number, under so many tools and in so many postures; it depends on these and the seed alone."""
    random = np.random.default_rng([seed, number, 7])
    stiffness, ratio = (float(np.exp(random.uniform(*np.log(limits)))) for limits in (STIFFNESS, RATIO))
    skull, poisson = str(random.choice(list(SKULLS), p=PROBABLE)), float(random.uniform(*POISSON))
    chosen = random.permutation(PLACES)[:presses]
    pressure = np.exp(random.uniform(*np.log(PRESSURE), size=presses))
    # The way of some other place's force: within the tool's cone nearly everywhere.
    way = np.stack([_leaning(tools.force[place], random) for place in chosen])
    force = way * (pressure * np.pi * tools.footprint[chosen] ** 2)[:, None]
    left, tilt = random.uniform(LEFT[0], LEFT[1], drainages), TILT * random.standard_normal((drainages, 3))
    return Patient(
        number=number, skull=skull, stiffness=stiffness, ratio=ratio, poisson=poisson,
        places=tuple(chosen.tolist()), force=tuple(map(tuple, force.tolist())),
        left=tuple(left.tolist()), tilt=tuple(map(tuple, tilt.tolist())),
    )  # fmt: skip


def _leaning(force: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A unit vector (3,) that leans by some degrees from a force (3,)."""
    way = force / np.linalg.norm(force) + 0.25 * random.standard_normal(3)
    return way / np.linalg.norm(way)


def effects_of(patient: Patient) -> tuple[Effect, ...]:
    """What a patient's finite elements are made of."""
    brain, tumour = (ogden(share, patient.poisson) for share in (patient.stiffness, patient.stiffness * patient.ratio))
    return Elasticity(brain, {TUMOUR_LABEL: tumour}), Held(), SKULLS[patient.skull], ToolForce(), Gravity()


def loads_of(anatomy: Anatomy, tools: Pushed, patient: Patient) -> Loads:
    """A press in each of the first frames, by tools on these places; in the others fluid has drained."""
    idle, drained = len(patient.left), np.array(patient.tilt).reshape(-1, 3) + open_cortex(anatomy).axis
    chosen = np.array([*patient.places, *[patient.places[0]] * idle])
    force = np.concatenate([np.array(patient.force), np.zeros((idle, 3))])
    down = np.concatenate([np.tile(Gravity().direction, (len(patient.places), 1)), drained])
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    left = np.append(np.ones(len(patient.places)), patient.left)
    level = np.array([compute_fluid_level(anatomy.mesh.nodes, *each) for each in zip(down, left, strict=True)])
    pushed = Pushed(tools.point[chosen], force, tools.footprint[chosen])
    return Loads((pushed, Posture(down, level, np.ones(len(chosen)))))


def patients(
    body: Anatomy,
    finer: Anatomy,
    count: int,
    presses: int,
    drainages: int,
    seed: int = 0,
    device: str = "auto",
    folder: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Iterator[Seen | None]:
    """So many patients of `finer`, read at the vertices of `body`; None for one without an equilibrium.

    Those that a `folder` keeps from a run that was stopped are read. `progress` hears how many are done, and of how
    many.

    Raises
    ------
    InputError
        Bodies of two brains; bodies without tumour or open cortex.
    """
    check_same(body, finer)
    place, tools = locate(finer.mesh, body.mesh.nodes), places(body)
    for number in range(count):
        one = patient(tools, seed, number, presses, drainages)
        motion = _kept(finer, loads_of(finer, tools, one), one, device, folder)
        progress(number + 1, count)
        yield Seen(one, place.read(motion.astype(float))) if len(motion) else None


def _kept(finer: Anatomy, loads: Loads, patient: Patient, device: str, folder: Path | None) -> np.ndarray:
    """Motions (frames, V, 3) [m] of a patient's own mesh, from the folder if they are there; (0, V, 3): none."""
    stated = finer.digest, recommend_element(finer.mesh), patient, ACCURACY
    path = find_kept_path(folder, f"patient-{patient.number:04d}-", device, *stated)

    def solved() -> dict[str, np.ndarray]:
        answer = Fem(finer, effects_of(patient), ACCURACY, device).deform(loads)
        good = all(outcome.good for outcome in answer.outcome)
        return {"motion": (answer.displacement if good else answer.displacement[:0]).astype(np.float32)}

    return keep_arrays(path, "a patient's motions", ["motion"], solved)["motion"]
