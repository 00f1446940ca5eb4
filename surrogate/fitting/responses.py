"""FEM responses of linear tissue to drained fluid and to forces, for each candidate tissue."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.bodies.fluid_level import compute_fluid_level
from sim.bodies.open_cortex import open_cortex
from sim.discretisation.space import recommend_element
from sim.effects import SKULLS, Gravity, Held, ToolForce
from sim.fem import Fem
from sim.geometry.tetmesh import compute_digest
from sim.loads import Loads, Posture, Pushed

from ..locating.causes import FORCE_RADIUS, SUPINE, USUAL_CAUSES, build_linear_tissue, sample_gravity_directions
from ..locating.locator import find_observed_nodes
from ..locating.regions import Region, build_tissue
from ..model.kept_arrays import get_cache_path, load_cached_arrays

RATIOS = np.geomspace(0.4, 3.2, 4)
"""Candidate ratios of tumour to brain stiffness for which FEM is solved."""
POISSONS = np.array([0.45, 0.47, 0.4945])
"""Candidate Poisson's ratios of brain and tumour for which FEM is solved."""
SOLVED_SKULLS = ("bonded", "slide")
"""Skull models for which FEM is solved; a separating skull keeps contact under a tool, as `slide` does."""
TOOL_FORCE = 0.01
"""Force of a tool along each axis [N]."""
POSTURE_COUNT = 6  # Number of head positions.
FLUID_LEVELS = (0.7, 0.4, 0.15)  # Shares of the fluid that remain in each head position.
SEED = 5  # Random seed of the head positions.
ACCURACY = Accuracy(tolerance=1e-3)  # Accuracy of the FEM results.


@dataclass(frozen=True, eq=False)
class Responses:
    """Displacements of some vertices under loads of one kind, for each candidate tissue.

    Parameters
    ----------
    nodes
        Sorted mesh vertices (n,).
    motion
        Displacements (poissons, ratios, loads, n, 3) [m] by skull model, for the brain's stiffness `causes.YOUNG`.
    regions
        Regions of known stiffness that were included.
    """

    nodes: np.ndarray
    motion: dict[str, np.ndarray]
    regions: tuple[Region, ...] = ()


def build_drainage_loads(anatomy: Anatomy) -> Loads:
    """Build loads of drained fluid for sampled directions of gravity and several fluid levels."""
    down = sample_gravity_directions(
        np.random.default_rng(SEED), open_cortex(anatomy).axis, replace(USUAL_CAUSES, drainages=POSTURE_COUNT)
    )
    every = [(way, compute_fluid_level(anatomy.mesh.nodes, way, left)) for left in FLUID_LEVELS for way in down]
    way, level = (np.array(each) for each in zip(*every, strict=True))
    middle = np.tile(open_cortex(anatomy).origin, (len(way), 1))
    idle = Pushed(middle, np.zeros_like(middle), np.full(len(way), FORCE_RADIUS))
    return Loads((idle, Posture(way, level, np.ones(len(way)))))


def build_force_loads(
    anatomy: Anatomy, point: np.ndarray, radius: np.ndarray, force: np.ndarray | None = None
) -> Loads:
    """Build forces (n, 3) [N] on discs of radii (k,) [m] round points (k, 3); None: one along each axis, per point."""
    some = TOOL_FORCE * np.tile(np.eye(3), (len(point), 1)) if force is None else force
    each, count = len(some) // len(point), len(some)
    pushed = Pushed(np.repeat(point, each, axis=0), some, np.repeat(radius, each))
    level = compute_fluid_level(anatomy.mesh.nodes, SUPINE, 1.0)
    posture = Posture(np.tile(SUPINE, (count, 1)), np.full(count, level), np.ones(count))
    return Loads((pushed, posture), np.zeros(count))


def solve_responses(
    anatomy: Anatomy, loads: Loads, device: str = "auto", folder: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, total: None, regions: tuple[Region, ...] = (),
) -> Responses:  # fmt: skip
    """Solve the loads for each candidate tissue, with known `regions`; results stored in `folder` are reused.

    `progress` receives the number of candidate tissues done and their total.
    """
    nodes, found = find_observed_nodes(anatomy), []
    every = list(product(SOLVED_SKULLS, POISSONS, RATIOS))
    progress(0, len(every))
    for done, (skull, poisson, ratio) in enumerate(every, start=1):
        found.append(
            _get_motions(anatomy, nodes, loads, (skull, float(poisson), float(ratio), regions), device, folder)
        )
        progress(done, len(every))
    whole = np.array(found).reshape(len(SOLVED_SKULLS), len(POISSONS), len(RATIOS), *found[0].shape)
    return Responses(nodes, dict(zip(SOLVED_SKULLS, whole, strict=True)), regions)


def _get_motions(
    anatomy: Anatomy, nodes: np.ndarray, loads: Loads, tissue: tuple[str, float, float, tuple[Region, ...]],
    device: str, folder: Path | None,
) -> np.ndarray:  # fmt: skip
    """Read the displacements (loads, n, 3) [m] for one tissue from the folder, or compute and store them."""
    numbers = [array for cause in loads.causes for array in vars(cause).values()]
    stated = anatomy.digest, recommend_element(anatomy.mesh), tissue, ACCURACY, compute_digest(*numbers)
    path = get_cache_path(folder, "", device, *stated)
    skull, poisson, ratio, regions = tissue
    law = build_tissue(build_linear_tissue, poisson, ratio, regions)
    effects = (law, Held(), SKULLS[skull], ToolForce(), Gravity())

    def compute_motion() -> dict[str, np.ndarray]:
        result = Fem(anatomy, effects, ACCURACY, device).deform(loads)
        return {"motion": result.displacement[:, nodes].astype(np.float32)}

    return load_cached_arrays(path, "motions of one tissue", ["motion"], compute_motion)["motion"]
