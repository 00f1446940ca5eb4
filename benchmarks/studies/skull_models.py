"""Influence of skull model and mesh: tumour motion, volume that passes the closed skull, traction on its bond."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from scenes.analysis.measurement import time_work
from sim.accuracy import NO_STRAIN_LIMIT
from sim.anatomy import Anatomy
from sim.debonding import TEARING, Debonding, solve_with_debonding
from sim.deformation import Deformation, join_deformations
from sim.effects import Bonded, build_push_effects
from sim.fem import Fem
from sim.loads import Loads
from sim.material import Material

from .elements import compute_tumour_motion

# A bond that fails above its strength, and one without strength: a skull that only presses, without a gap.
TORN = {"tearing": Bonded(), "pressing": Bonded(1e-6, 1e-6)}


@dataclass(frozen=True)
class SkullRow:
    """Results of one skull on one mesh at one Poisson's ratio.

    Parameters
    ----------
    motion
        Volume mean of the tumour's motion, averaged over the loads [mm].
    leaked, bond
        Maximum over the loads, as in `Deformation`. `bond` is None without a bond; `leaked` is None for a skull that
        the brain may leave.
    seconds
        Time of a load [s], without set-up.
    failed
        Number of loads that did not converge, which are excluded from all numbers.
    """

    skull: str
    poisson: float
    vertices: int
    motion: float
    leaked: float | None
    bond: float | None
    seconds: float
    failed: int


def measure_skulls(
    anatomies: Sequence[Anatomy], skulls: Sequence[str], poissons: Sequence[float], loads: Loads, device: str,
    tearing: Debonding = TEARING,
) -> Iterator[SkullRow]:  # fmt: skip
    """Yield a row for each mesh, Poisson's ratio and skull, of the same loads; 3 kPa, neo-Hookean, default element."""
    for poisson in poissons:
        for skull in skulls:
            for anatomy in anatomies:
                yield _measured(anatomy, skull, poisson, loads, device, tearing)


def _measured(anatomy: Anatomy, skull: str, poisson: float, loads: Loads, device: str, tearing: Debonding) -> SkullRow:
    mesh, tissue = anatomy.mesh, Material("neo-hookean", 3000.0, poisson)
    weak = loads.select(slice(0, 1)).scale(1e-3)
    _answered(anatomy, skull, tissue, weak, device, tearing)  # kernels are compiled or loaded
    answer, good, seconds = _answered(anatomy, skull, tissue, loads, device, tearing)
    if not good.any():
        return SkullRow(skull, poisson, len(mesh.nodes), float("nan"), None, None, seconds, len(good))
    moved = compute_tumour_motion(anatomy, answer.displacement[good])
    leaked, bond = (float(values[good].max()) for values in (answer.leaked, answer.bond))
    return SkullRow(
        skull, poisson, len(mesh.nodes), 1e3 * float(np.linalg.norm(moved, axis=1).mean()),
        None if skull in TORN else leaked, bond if np.isfinite(bond) else None, seconds, int((~good).sum()),
    )  # fmt: skip


def _answered(
    anatomy: Anatomy, skull: str, tissue: Material, loads: Loads, device: str, tearing: Debonding
) -> tuple[Deformation, np.ndarray, float]:
    """Solve; return results, mask (B,) of good ones, and time per load [s], with set-up for debonding only."""
    if skull in TORN:
        effects = [TORN[skull] if isinstance(one, Bonded) else one for one in build_push_effects(anatomy, tissue)]
        each = [loads.select(np.array([row])) for row in range(len(loads))]
        found = [
            time_work(solve_with_debonding, anatomy, effects, load, NO_STRAIN_LIMIT, device, tearing=tearing)
            for load in each
        ]
        good = np.array([one.converged and one.deformation.outcome[0].good for one, _ in found])
        return (
            join_deformations([one.deformation for one, _ in found]),
            good,
            float(np.mean([seconds for _, seconds in found])),
        )
    fem = Fem(anatomy, build_push_effects(anatomy, tissue, skull), NO_STRAIN_LIMIT, device)
    answer, seconds = time_work(fem.deform, loads)
    return answer, np.array([outcome.good for outcome in answer.outcome]), seconds / len(loads)
