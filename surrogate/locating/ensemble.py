"""Ensemble of brain motions by all causes, with many tissues and skulls, from which the prior is built."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from sim.accuracy import Accuracy
from sim.anatomy import BRAIN_LABEL, PART_LABELS, Anatomy
from sim.deformation import Deformation
from sim.discretisation.space import recommend_element
from sim.effects import SKULLS
from sim.errors import InputError
from sim.fem import Fem

from ..model.kept_arrays import get_cache_path, load_cached_arrays
from .causes import (
    DRAINAGE,
    OEDEMA,
    SWELLING,
    TOOL,
    TUMOUR_SWELLING,
    USUAL_CAUSES,
    Causes,
    Group,
    build_drainages,
    build_groups,
    build_pushes,
    build_swellings,
)

ACCURACY = Accuracy(tolerance=3e-3)  # Relative solver tolerance far below observation errors.
MIN_MOTION = 2e-5  # Smallest RMS motion of the open cortex [m]: below it, a member is mainly round-off.


def mark_tumour_surroundings(anatomy: Anatomy, distance: float) -> tuple[Anatomy, tuple[int, ...]]:
    """Mark brain within `distance` [m] of the tumour as a new region; return the anatomy and the labels that swell.

    These are the labels of the new region and, if the anatomy has it, of its oedema. The tissue of the new region is
    the brain's, provided that no material law names its label.
    """
    mesh = anatomy.mesh
    tumour = KDTree(mesh.nodes[anatomy.tumour_nodes])
    away, _ = tumour.query(mesh.nodes[mesh.tets].mean(axis=1))
    own = int(mesh.region.max()) + 1
    region = np.where((mesh.region == BRAIN_LABEL) & (away < distance), own, mesh.region)
    swells = np.intersect1d(region, [own, PART_LABELS["oedema"]])
    return replace(anatomy, mesh=replace(mesh, region=region)), tuple(swells.tolist())


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Ensemble of N motions of all vertices of one anatomy.

    Parameters
    ----------
    anatomy
        Anatomy of the ensemble.
    motion
        Displacements (N, V, 3) float32 [m].
    kind, skull, group
        Indices (N,) into `KINDS` and into the names of `sim.effects.SKULLS`, and numbers of the groups.
    """

    anatomy: Anatomy
    motion: np.ndarray
    kind: np.ndarray
    skull: np.ndarray
    group: np.ndarray


def solve_groups(
    anatomy: Anatomy, seed: int = 0, device: str = "auto", causes: Causes = USUAL_CAUSES, folder: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Ensemble:  # fmt: skip
    """Solve an ensemble group by group; finished groups of an interrupted run are read from `folder`.

    `progress` receives the number of groups done and their total.

    Raises
    ------
    InputError
        The anatomy has no open cortex, tumour or skull, or no member of a group has converged.
    """
    if not len(anatomy.tumour_nodes):
        raise InputError("the anatomy has no tumour to locate: make one that has.")
    made = build_groups(anatomy, seed, causes)
    if not made:
        raise InputError("the anatomy has no skull (`slide_normal`) that brackets what it does: make it again.")
    parts = []
    progress(0, len(made))
    for done, group in enumerate(made, start=1):
        parts.append(_get_motions(anatomy, group, seed, device, causes, folder))
        progress(done, len(made))
    motion, kind = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    counts = [len(kinds) for _, kinds in parts]
    number = np.repeat([group.number for group in made], counts)
    skull = np.repeat([list(SKULLS).index(group.skull) for group in made], counts)
    return Ensemble(anatomy, motion, kind, skull, number)


def _get_motions(
    anatomy: Anatomy, group: Group, seed: int, device: str, causes: Causes, folder: Path | None
) -> tuple[np.ndarray, np.ndarray]:
    """Read a group's motions and causes from the folder, or compute and store them; the key has all inputs."""
    stated = anatomy.digest, recommend_element(anatomy.mesh), group, seed, causes, ACCURACY
    path = get_cache_path(folder, f"{group.number:03d}-", device, *stated)
    names = "motion", "kind"
    arrays = load_cached_arrays(
        path,
        "a group of an ensemble",
        names,
        lambda: dict(zip(names, solve_members(anatomy, group, seed, device, causes), strict=True)),
    )
    return arrays["motion"], arrays["kind"]


def solve_members(
    anatomy: Anatomy, group: Group, seed: int = 0, device: str = "auto", causes: Causes = USUAL_CAUSES
) -> tuple[np.ndarray, np.ndarray]:
    """Compute a group's motions (n, V, 3) float32 [m] and causes (n,); unconverged and tiny motions are dropped."""
    fem = Fem(anatomy, group.build_effects(causes.swellings), ACCURACY, device)
    tumour = tuple(np.unique(anatomy.mesh.region[anatomy.in_tumour]).tolist())
    answers = [
        fem.deform(build_pushes(group, anatomy, seed, causes)),
        fem.deform(build_swellings(anatomy, causes.swellings)),
        _solve_swelling(anatomy, group, causes.tumour_swellings, tumour, device, fem),
    ]
    kind = [TOOL, SWELLING, TUMOUR_SWELLING]
    for reach in group.reach:
        body, marked = mark_tumour_surroundings(anatomy, reach)
        answers.append(_solve_swelling(body, group, causes.oedema, marked, device, fem))
        kind.append(OEDEMA)
    last: Deformation | None = None
    for loads in build_drainages(group, anatomy, seed, causes):
        last = fem.deform(loads, start=last)
        answers.append(last)
        kind.append(DRAINAGE)
    motion = np.concatenate([result.displacement for result in answers])
    kind = np.repeat(kind, [len(result) for result in answers])
    good = np.array([outcome.good for result in answers for outcome in result.outcome])
    good &= compute_surface_motion(anatomy, motion) > MIN_MOTION
    if not good.any():
        raise InputError(f"no motion of group {group.number} ({group.skull}, nu {group.poisson:g}) converged.")
    return motion[good].astype(np.float32), kind[good]


def _solve_swelling(
    anatomy: Anatomy, group: Group, shares: tuple[float, ...], regions: tuple[int, ...], device: str, fem: Fem
) -> Deformation:
    """Solve relative volume changes `shares` of some regions; the factorised stiffness of `fem` is used again."""
    swells = Fem(anatomy, group.build_effects(shares, regions), ACCURACY, device, stiff_as=fem)
    return swells.deform(build_swellings(anatomy, shares))


def compute_surface_motion(anatomy: Anatomy, motion: np.ndarray) -> np.ndarray:
    """Compute the root mean square over open-cortex vertices (n,) [m] of each of n motions (n, V, 3) [m]."""
    nodes = np.unique(anatomy.open_surface)
    return np.sqrt((motion[:, nodes] ** 2).sum(axis=2).mean(axis=1))
